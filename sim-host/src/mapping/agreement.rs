//! How well each robot's claims agree with those of cameras and other robots, and the weight that
//! follows.
//!
//! Claims are counted per cell. A claim that a cell is occupied is contradicted by a claim that the
//! cell and all its neighbours are free, and confirmed by a claim that the cell or a neighbour is
//! occupied. Where cameras know a cell, they are right. Elsewhere a robot is wrong if at least two
//! robots contradict it, and more than agree with it, itself included.

use std::collections::BTreeMap;

use ubimap_protocol::{
    tile::{TILE_CELLS, TILE_SIDE, Tile, TileId},
    units::RobotId,
};

use super::mask::Mask;

/// Minimum number of contradictions at which a robot loses weight. People, other robots and pose
/// errors cause fewer.
const MIN_CONTRADICTIONS: u32 = 64;
/// Contradictions as a fraction of all claims, in sixteenths. Each value that is reached costs one
/// grade of weight. The first is one half, because robots also see people, and table legs that
/// cameras see only from above.
const SHARES: [u32; Weight::FULL.0 as usize] = [8, 10, 12, 14];
/// Maximum number of points of distance vectors that count for a robot. Beyond it all counts are
/// halved, so old ones fade out.
const POINTS: u32 = 1_024;
/// Minimum number of robots that contradict a claim for it to be wrong.
const VOTES: u8 = 2;

/// The weight of a robot's claims: zero, or one of four grades.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Weight(pub(super) u8);

impl Weight {
    /// The initial weight of every robot.
    pub const FULL: Self = Self(4);
    /// The robot's claims are ignored.
    pub const NONE: Self = Self(0);

    /// A grade, capped at [`Self::FULL`].
    pub fn grade(grade: u8) -> Self {
        Self(grade.min(Self::FULL.0))
    }

    /// Number of grades below [`Self::FULL`].
    pub fn short_of_full(self) -> u8 {
        Self::FULL.0.saturating_sub(self.0)
    }
}

/// Numbers of agreeing and of contradicting cells or points.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Counts {
    agree: u32,
    contradict: u32,
}

impl Counts {
    fn weight(self) -> Weight {
        let Self { agree, contradict } = self;
        if contradict < MIN_CONTRADICTIONS {
            return Weight::FULL;
        }
        let share = 16 * u64::from(contradict) / (u64::from(agree) + u64::from(contradict));
        let lost = SHARES.iter().filter(|&&limit| share >= u64::from(limit)).count();
        // `SHARES` has four entries, so the cast is lossless.
        Weight::grade(Weight::FULL.0.saturating_sub(lost as u8))
    }
}

/// Counts for each robot, from its layer and from its distance vectors.
#[derive(Debug, Default)]
pub struct Agreements {
    tiles: BTreeMap<(RobotId, TileId), Counts>,
    /// Sums over the tiles.
    layers: BTreeMap<RobotId, Counts>,
    points: BTreeMap<RobotId, Counts>,
}

impl Agreements {
    /// Forgets a robot that has drawn nothing.
    pub fn forget(&mut self, robot: RobotId) {
        self.layers.remove(&robot);
        self.points.remove(&robot);
    }

    /// Recounts a tile from the cameras' knowledge and the layer of each robot that knows any of
    /// it. Cost: a few microseconds per robot.
    pub fn count(&mut self, id: TileId, cameras: &Tile, robots: &[(RobotId, &Tile)]) {
        let camera = Claims::of(cameras);
        let claims: Vec<(RobotId, Claims)> =
            robots.iter().map(|&(robot, tile)| (robot, Claims::of(tile))).collect();
        let (mut occupied, mut near, mut free) = (Votes::NONE, Votes::NONE, Votes::NONE);
        for (_, claims) in &claims {
            occupied.add(&claims.occupied);
            near.add(&claims.near);
            free.add(&claims.free);
        }
        for (robot, claims) in claims {
            let mut counts = Counts::default();
            for y in 0..TILE_SIDE {
                let known = cameras.row(y).known();
                let (there, clear) = (claims.occupied[y], claims.free[y]);
                counts.agree += (there & camera.near[y]).count_ones();
                counts.contradict +=
                    (there & camera.free[y] | clear & camera.occupied[y]).count_ones();
                for x in ones(there & !known) {
                    // `near` includes the robot's own claim, too.
                    counts.settle(near.of(x, y), free.of(x, y));
                }
                for x in ones(clear & !known).filter(|&x| occupied.of(x, y) >= VOTES) {
                    let (with, against) = (free.of(x, y), occupied.of(x, y));
                    counts.contradict += u32::from(against > with);
                }
            }
            let before = self.tiles.insert((robot, id), counts).unwrap_or_default();
            let sum = self.layers.entry(robot).or_default();
            sum.agree = sum.agree - before.agree + counts.agree;
            sum.contradict = sum.contradict - before.contradict + counts.contradict;
        }
    }

    /// Adds a distance vector of a robot: `agree` of its points are on surfaces that the cameras
    /// see, `contradict` are in ground that they see as free.
    pub fn looked(&mut self, robot: RobotId, agree: u32, contradict: u32) {
        let sum = self.points.entry(robot).or_default();
        sum.agree += agree.min(POINTS);
        sum.contradict += contradict.min(POINTS);
        while sum.agree + sum.contradict > POINTS {
            (sum.agree, sum.contradict) = (sum.agree / 2, sum.contradict / 2);
        }
    }

    /// The weight of a robot's claims: the lower of the weights by its layer and by its distance
    /// vectors.
    pub fn weight(&self, robot: RobotId) -> Weight {
        let of =
            |counts: &BTreeMap<RobotId, Counts>| counts.get(&robot).copied().unwrap_or_default();
        of(&self.layers).weight().min(of(&self.points).weight())
    }
}

impl Counts {
    /// Counts a cell that no camera knows and that the robot claims to be occupied. `with` robots
    /// (including this one) claim that the cell or a neighbour is occupied; `against` robots claim
    /// that it and all its neighbours are free.
    fn settle(&mut self, with: u8, against: u8) {
        if against >= VOTES && against > with {
            self.contradict += 1;
        } else if with > 1 {
            self.agree += 1;
        }
    }
}

/// An observer's claims about the cells of a tile. Movable and unknown cells claim nothing.
struct Claims {
    /// The cell is occupied by something fixed.
    occupied: Mask,
    /// The cell or a neighbour is occupied by something fixed.
    near: Mask,
    /// The cell and all its neighbours within the tile are free.
    free: Mask,
}

impl Claims {
    fn of(tile: &Tile) -> Self {
        let rows = |of: fn(u32, u32) -> u32| -> Mask {
            core::array::from_fn(|y| {
                let row = tile.row(y);
                of(row.low, row.high)
            })
        };
        let occupied = rows(|low, high| high & !low);
        let free = rows(|low, high| low & !high);
        let beside = |mask: &Mask, y: usize, outside: u32, of: fn(u32, u32) -> u32| {
            let below = y.checked_sub(1).map_or(outside, |y| mask[y]);
            let above = mask.get(y + 1).copied().unwrap_or(outside);
            let column = of(of(below, mask[y]), above);
            let (west, east) = (column << 1 | outside & 1, column >> 1 | outside & 1 << 31);
            of(of(west, column), east)
        };
        Self {
            near: core::array::from_fn(|y| beside(&occupied, y, 0, |a, b| a | b)),
            // Cells beyond the tile's edge are taken as free.
            free: core::array::from_fn(|y| beside(&free, y, u32::MAX, |a, b| a & b)),
            occupied,
        }
    }
}

/// Number of claims for each cell, up to 255.
struct Votes([u8; TILE_CELLS as usize]);

impl Votes {
    const NONE: Self = Self([0; TILE_CELLS as usize]);

    fn add(&mut self, mask: &Mask) {
        for (y, &row) in mask.iter().enumerate() {
            for x in ones(row) {
                let votes = &mut self.0[y * TILE_SIDE + x];
                *votes = votes.saturating_add(1);
            }
        }
    }

    fn of(&self, x: usize, y: usize) -> u8 {
        self.0[y * TILE_SIDE + x]
    }
}

fn ones(mut row: u32) -> impl Iterator<Item = usize> {
    core::iter::from_fn(move || {
        let x = row.trailing_zeros();
        row &= row.wrapping_sub(1);
        (x < u32::BITS).then_some(x as usize)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use ubimap_protocol::tile::Cell;

    const ID: TileId = TileId { x: 1, y: -2 };

    /// All free except for a wall in these columns.
    fn room(walls: core::ops::Range<usize>) -> Tile {
        let mut tile = Tile { low: [u32::MAX; TILE_SIDE], high: [0; TILE_SIDE] };
        for x in walls {
            (0..TILE_SIDE).for_each(|y| tile.set(x, y, Cell::Occupied));
        }
        tile
    }

    fn weights(cameras: &Tile, robots: &[Tile]) -> Vec<Weight> {
        let mut agreements = Agreements::default();
        let ids = (1..).map(RobotId);
        let robots: Vec<(RobotId, &Tile)> = ids.zip(robots).collect();
        // Recounting changes nothing.
        agreements.count(ID, &room(3..9), &robots);
        agreements.count(ID, cameras, &robots);
        agreements.count(ID, cameras, &robots);
        robots.iter().map(|(robot, _)| agreements.weight(*robot)).collect()
    }

    #[test]
    fn the_cameras_are_right() {
        let robots = [room(10..12), room(9..11), room(10..16), room(20..25), room(0..0)];
        let [same, beside, more, elsewhere, nothing] = weights(&room(10..12), &robots)[..] else {
            panic!()
        };
        assert_eq!((same, beside), (Weight::FULL, Weight::FULL), "a neighbouring cell agrees");
        assert!(Weight::NONE < more && more < Weight::FULL, "{more:?}");
        assert_eq!((elsewhere, nothing), (Weight::NONE, Weight::NONE));
    }

    #[test]
    fn in_blind_ground_the_majority_is_right() {
        let (honest, liar) = (room(10..12), room(20..23));
        let full = Weight::FULL;
        assert_eq!(
            weights(&Tile::UNKNOWN, &[honest, liar]),
            [full, full],
            "one claim against another"
        );
        assert_eq!(weights(&Tile::UNKNOWN, &[honest, liar, honest]), [full, Weight::NONE, full]);
        // The third robot does not see the wall.
        let weights = weights(&Tile::UNKNOWN, &[honest, honest, room(0..0), Tile::UNKNOWN]);
        assert_eq!(weights, [full, full, Weight::NONE, full]);
    }

    #[test]
    fn points_that_contradict_the_cameras_cost_weight_until_others_agree() {
        let mut agreements = Agreements::default();
        let robot = RobotId(3);
        agreements.looked(robot, 2, 40);
        assert_eq!(agreements.weight(robot), Weight::FULL, "a person walks in front of it");
        agreements.looked(robot, 2, 40);
        assert_eq!(agreements.weight(robot), Weight::NONE);
        (0..40).for_each(|_| agreements.looked(robot, 60, 0));
        assert_eq!(agreements.weight(robot), Weight::FULL);
        agreements.looked(robot, 0, u32::MAX);
        let weight = agreements.weight(robot);
        assert!(
            Weight::NONE < weight && weight < Weight::FULL,
            "the effect of one distance vector is limited"
        );
    }
}

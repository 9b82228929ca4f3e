//! How well each robot agrees with the others, and the weight that its word has for it.
//!
//! Cell by cell: somebody who says that something is there, and somebody who says that it and all
//! its neighbours are free, contradict each other; somebody who says that something is there or
//! beside it agrees. The cameras are right about what they know. Elsewhere a robot is wrong if two
//! more contradict it than agree with it: one word against another says nothing.

use std::collections::BTreeMap;

use ubimap_protocol::{
    tile::{TILE_CELLS, TILE_SIDE, Tile, TileId},
    units::RobotId,
};

use super::mask::Mask;

/// Contradictions below this many are what people, and other robots, and poses that err, leave.
const LEAST: u32 = 64;
/// The weight loses a grade at each of these shares of contradictions, in sixteenths: from where a
/// robot is contradicted as often as not. Robots see people, and legs under a table that cameras see
/// from above.
const SHARES: [u32; Weight::FULL.0 as usize] = [8, 10, 12, 14];
/// Of the points of distance vectors so many count, the newest for the most part.
const POINTS: u32 = 1_024;
/// Votes that count: two at least, and one more than those of the others and the robot itself.
const VOTES: u8 = 2;

/// What a robot's word counts for: none, or one of four grades.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Weight(pub(super) u8);

impl Weight {
    /// That of a robot against which nothing is known.
    pub const FULL: Self = Self(4);
    /// Its word does not count.
    pub const NONE: Self = Self(0);

    /// A grade; those above the full one are the full one.
    pub fn grade(grade: u8) -> Self {
        Self(grade.min(Self::FULL.0))
    }

    /// By how many grades it is less than the full one.
    pub fn short_of_full(self) -> u8 {
        Self::FULL.0.saturating_sub(self.0)
    }
}

/// What agrees with the others, and what contradicts them: cells, or points.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Counts {
    agree: u32,
    contradict: u32,
}

impl Counts {
    fn weight(self) -> Weight {
        let Self { agree, contradict } = self;
        if contradict < LEAST {
            return Weight::FULL;
        }
        let share = 16 * u64::from(contradict) / (u64::from(agree) + u64::from(contradict));
        let lost = SHARES.iter().filter(|&&limit| share >= u64::from(limit)).count();
        // There are four of them.
        Weight::grade(Weight::FULL.0.saturating_sub(lost as u8))
    }
}

/// How well the robots agree, by the layers and by what they see.
#[derive(Debug, Default)]
pub struct Agreements {
    tiles: BTreeMap<(RobotId, TileId), Counts>,
    /// The sums over the tiles.
    layers: BTreeMap<RobotId, Counts>,
    points: BTreeMap<RobotId, Counts>,
}

impl Agreements {
    /// Counts a tile anew: what the cameras know of it, and each robot that knows something of it.
    /// Costs a few microseconds for each robot.
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
                    // It is among those near, itself.
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

    /// Takes how many points of a robot's distance vector lie where the cameras see something, and
    /// how many in what they see free.
    pub fn looked(&mut self, robot: RobotId, agree: u32, contradict: u32) {
        let sum = self.points.entry(robot).or_default();
        sum.agree += agree.min(POINTS);
        sum.contradict += contradict.min(POINTS);
        while sum.agree + sum.contradict > POINTS {
            (sum.agree, sum.contradict) = (sum.agree / 2, sum.contradict / 2);
        }
    }

    /// What a robot's word counts for: by its layer, or by what it sees where cameras see it,
    /// whichever is less.
    pub fn weight(&self, robot: RobotId) -> Weight {
        let of =
            |counts: &BTreeMap<RobotId, Counts>| counts.get(&robot).copied().unwrap_or_default();
        of(&self.layers).weight().min(of(&self.points).weight())
    }
}

impl Counts {
    /// A cell in which the robot says that something is, out of the cameras' view: how many say so
    /// too, the robot itself among them, and how many say that it and all beside it are free.
    fn settle(&mut self, with: u8, against: u8) {
        if against >= VOTES && against > with {
            self.contradict += 1;
        } else if with > 1 {
            self.agree += 1;
        }
    }
}

/// What a tile says for certain.
struct Claims {
    /// Something fixed is there.
    occupied: Mask,
    /// Something fixed is there or beside it.
    near: Mask,
    /// It and all its neighbours in the tile are free.
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
            // What lies beyond the tile's edge does not speak against it.
            free: core::array::from_fn(|y| beside(&free, y, u32::MAX, |a, b| a & b)),
            occupied,
        }
    }
}

/// How many say so of each cell; no more than 255.
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

    /// All free but a wall in these columns.
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
        // Counting again changes nothing.
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
        assert_eq!((same, beside), (Weight::FULL, Weight::FULL), "a cell beside is as good");
        assert!(Weight::NONE < more && more < Weight::FULL, "{more:?}");
        assert_eq!((elsewhere, nothing), (Weight::NONE, Weight::NONE));
    }

    #[test]
    fn in_blind_ground_the_others_are_right_if_they_are_more() {
        let (honest, liar) = (room(10..12), room(20..23));
        let full = Weight::FULL;
        assert_eq!(weights(&Tile::UNKNOWN, &[honest, liar]), [full, full], "word against word");
        assert_eq!(weights(&Tile::UNKNOWN, &[honest, liar, honest]), [full, Weight::NONE, full]);
        // One who does not see their wall.
        let weights = weights(&Tile::UNKNOWN, &[honest, honest, room(0..0), Tile::UNKNOWN]);
        assert_eq!(weights, [full, full, Weight::NONE, full]);
    }

    #[test]
    fn what_is_seen_against_the_cameras_counts_and_is_made_good() {
        let mut agreements = Agreements::default();
        let robot = RobotId(3);
        agreements.looked(robot, 2, 40);
        assert_eq!(agreements.weight(robot), Weight::FULL, "a person walks before it");
        agreements.looked(robot, 2, 40);
        assert_eq!(agreements.weight(robot), Weight::NONE);
        (0..40).for_each(|_| agreements.looked(robot, 60, 0));
        assert_eq!(agreements.weight(robot), Weight::FULL);
        agreements.looked(robot, 0, u32::MAX);
        let weight = agreements.weight(robot);
        assert!(Weight::NONE < weight && weight < Weight::FULL, "one look counts for so much");
    }
}

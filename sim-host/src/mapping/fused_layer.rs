//! The fused layer: the map that every robot gets.

use ubimap_protocol::{
    tile::{Cell, TILE_CELLS, TILE_SIDE, Tile},
    time::{Duration, Instant},
};

use super::{
    agreement::Weight,
    mask::Mask,
    prior_layer::{CellLabel, CellPrior, PriorTile},
    robot_layer::SeenTile,
};

/// Step of the map's time in seconds.
const STEP_S: u32 = 10;
/// A camera's claim overrides a robot's claim that is newer by at most this number of seconds:
/// cameras see a cell twice per second, and frames may be late.
const HOLDS_S: u32 = 2;
/// Seconds by which a robot's claim counts as older for each grade that its weight is below the
/// full weight.
const GRADE_S: u32 = 60;
/// Age in seconds at which a robot's movable cell is forgotten. Fixed cells are never forgotten,
/// because a robot reports nothing while it agrees with the map.
const MOVABLE_S: u32 = 300;
/// Minimum number of alternations between free and occupied for a cell to count as movable, among
/// the last claims of all observers, ordered by time.
const CHANGES: usize = 3;

/// The time by which the map ages: seconds of the server's clock, in steps of ten.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct MapTime(u32);

impl MapTime {
    /// The step that contains the given time.
    pub fn at(moment: Instant) -> Self {
        // 32 bits hold 136 years in seconds.
        Self((moment.micros() / 1_000_000) as u32 / STEP_S * STEP_S)
    }

    /// Whether a second is in this step, in the previous one or later.
    pub(super) fn is_recent(self, second: u32) -> bool {
        second.saturating_add(STEP_S) >= self.0
    }

    /// Seconds since an earlier step; 0 if it is later.
    pub(super) fn seconds_since(self, earlier: Self) -> f64 {
        self.0.saturating_sub(earlier.0).into()
    }

    /// When the next step begins.
    pub fn next(self) -> Instant {
        Instant(0) + Duration::from_secs(u64::from(self.0) + u64::from(STEP_S))
    }
}

/// A claim about a cell: its effective second (negative if before the clock's start), whether it is
/// from the cameras, and the cell's code. Within the same second the cameras' claim wins, and among
/// robots occupied wins over free.
type Claim = (i64, bool, u8);

/// Fuses one tile from the cameras' observations and those of the robots, each with the robot's
/// weight; the order of the robots does not matter. A pure function on integers. For each cell:
///
/// | the cameras | the robots | fused |
/// |---|---|---|
/// | have seen it | anything, at most two seconds later | the cameras' code |
/// | have revoked their claim | free, not later | ignored |
/// | have seen it, or never | something new, later than that | the newest claim |
/// | as above | several claims within the same second | occupied if any of them is |
/// | as above | a claim of lower weight | counts as one minute older per grade |
/// | never | only claims of weight none | unknown |
/// | never | movable, at least five minutes ago by the map's time | unknown |
/// | have seen it, or never | occupied, after three alternations with free | movable |
///
/// A label ([`PriorTile`]) changes this. Where something is likely to move, a claim of anyone is
/// forgotten at the label's age, counted from the claim or from the last look of a robot. Where
/// something stays, robots' claims are never forgotten, and no cell is movable because of them. Labels
/// make no cell movable: robots take one beam across a movable cell as proof that it is free, and
/// would wear away the leaf of a door.
///
/// A robot reports nothing while it agrees with the map, so the newest claim is the valid one.
/// Cost: a few nanoseconds per cell and robot.
pub fn fuse(
    cameras: &SeenTile,
    robots: &[(Weight, &SeenTile)],
    priors: Option<&PriorTile>,
    time: MapTime,
) -> Tile {
    let mut fused = Tile::UNKNOWN;
    let mut claims: Vec<Claim> = Vec::new();
    for cell in 0..usize::from(TILE_CELLS) {
        let (x, y) = (cell % TILE_SIDE, cell / TILE_SIDE);
        claims.clear();
        let prior = priors.map_or(CellPrior::default(), |tile| tile.get(cell));
        let camera = cameras.tile.cell(x, y);
        if camera != Cell::Unknown && !is_outdated(prior, cameras.seconds[cell], time) {
            claims.push((
                i64::from(cameras.seconds[cell]) + i64::from(HOLDS_S),
                true,
                camera.code(),
            ));
        }
        for (weight, robot) in robots {
            let (code, second) = (robot.tile.cell(x, y), robot.seconds[cell]);
            let is_forgotten = match code {
                Cell::Movable if prior.label == CellLabel::None => {
                    time.0.saturating_sub(second) >= MOVABLE_S
                }
                Cell::Free if camera == Cell::Unknown => {
                    second <= cameras.seconds[cell] && cameras.seconds[cell] > 0
                }
                _ => false,
            } || is_outdated(prior, second, time);
            if code != Cell::Unknown && *weight != Weight::NONE && !is_forgotten {
                let later = i64::from(weight.short_of_full()) * i64::from(GRADE_S);
                claims.push((i64::from(second) - later, false, code.code()));
            }
        }
        // The order of codes puts free before occupied.
        let Some(&(_, by_cameras, code)) = claims.iter().max() else { continue };
        let code = match (Cell::from_code(code), prior.label) {
            (Cell::Movable, CellLabel::Never) if !by_cameras => Cell::Occupied,
            (Cell::Occupied, CellLabel::None | CellLabel::After(_))
                if !by_cameras && keeps_changing(&mut claims) =>
            {
                Cell::Movable
            }
            (code, _) => code,
        };
        fused.set(x, y, code);
    }
    fused
}

/// Whether a claim of this second about a labelled cell is forgotten.
fn is_outdated(prior: CellPrior, second: u32, time: MapTime) -> bool {
    let CellLabel::After(age) = prior.label else { return false };
    time.0.saturating_sub(second.max(prior.looked)) >= age
}

/// Whether the claims, ordered by time, alternate between free and occupied at least [`CHANGES`]
/// times.
fn keeps_changing(claims: &mut [Claim]) -> bool {
    if claims.len() <= CHANGES {
        return false;
    }
    claims.sort_unstable();
    let is_free = |word: &Claim| Cell::from_code(word.2) == Cell::Free;
    let follow = claims
        .windows(2)
        .filter(|pair| pair[0].0 < pair[1].0 && is_free(&pair[0]) != is_free(&pair[1]));
    follow.count() >= CHANGES
}

/// Makes the occupied and movable cells under a localised robot free. Returns whether there were
/// any.
pub fn clear(fused: &mut Tile, under: &Mask) -> bool {
    let mut cleared = false;
    for (y, &mask) in under.iter().enumerate() {
        let mut row = fused.row(y);
        cleared |= row.high & mask != 0;
        row.low |= row.high & mask;
        row.high &= !mask;
        fused.set_row(y, row);
    }
    cleared
}

#[cfg(test)]
mod tests {
    use super::*;
    use Cell::{Free, Movable, Occupied, Unknown};

    fn seen((cell, second): (Cell, u32)) -> SeenTile {
        let mut tile = Tile::UNKNOWN;
        tile.set(7, 9, cell);
        SeenTile { tile, seconds: [second; TILE_CELLS as usize] }
    }

    /// The fused cell at `second`, from the claims of the cameras and of weighted robots, each made
    /// at its own second.
    fn fused(camera: (Cell, u32), robots: &[(Cell, u32, Weight)], second: u64) -> Cell {
        fused_with(CellPrior::default(), camera, robots, second)
    }

    fn fused_with(
        prior: CellPrior,
        camera: (Cell, u32),
        robots: &[(Cell, u32, Weight)],
        second: u64,
    ) -> Cell {
        let robots: Vec<(Weight, SeenTile)> =
            robots.iter().map(|&(cell, second, weight)| (weight, seen((cell, second)))).collect();
        let mut robots: Vec<(Weight, &SeenTile)> =
            robots.iter().map(|(weight, seen)| (*weight, seen)).collect();
        let time = MapTime::at(Instant(second * 1_000_000));
        let priors = PriorTile::everywhere(prior);
        let there = fuse(&seen(camera), &robots, Some(&priors), time);
        robots.reverse();
        let reversed = fuse(&seen(camera), &robots, Some(&priors), time);
        assert_eq!(there, reversed, "the order of the robots matters");
        let code = there.cell(7, 9);
        assert_eq!(there.counts().0, u32::from(code != Unknown));
        code
    }

    #[test]
    fn the_table_of_cases() {
        let never = (Unknown, 0);
        let cases: [(_, &[_], _); 23] = [
            (never, &[], Unknown),
            (never, &[(Unknown, 3), (Unknown, 4)], Unknown),
            (never, &[(Free, 3), (Unknown, 4)], Free),
            (never, &[(Free, 3), (Occupied, 3)], Occupied),
            (never, &[(Free, 4), (Occupied, 3)], Free),
            (never, &[(Free, 4), (Occupied, 3), (Movable, 4)], Movable),
            // The cell is in view, or out of view without newer claims.
            ((Free, 4), &[(Occupied, 3), (Occupied, 4)], Free),
            ((Free, 4), &[(Occupied, 6)], Free),
            ((Movable, 4), &[(Free, 3)], Movable),
            ((Occupied, 4), &[(Free, 3), (Unknown, 40)], Occupied),
            // The cell is out of view, and a robot claimed it later.
            ((Free, 4), &[(Occupied, 7)], Occupied),
            ((Occupied, 4), &[(Free, 7), (Occupied, 3)], Free),
            // The cameras have revoked their claim.
            ((Unknown, 4), &[(Free, 4)], Unknown),
            ((Unknown, 4), &[(Free, 5)], Free),
            ((Unknown, 4), &[(Free, 3), (Occupied, 2)], Occupied),
            ((Unknown, 4), &[(Free, 3), (Movable, 4)], Movable),
            // The claims alternate.
            (never, &[(Free, 3), (Occupied, 13), (Free, 23), (Occupied, 33)], Movable),
            (never, &[(Occupied, 3), (Free, 13), (Occupied, 23), (Free, 33)], Free),
            (never, &[(Free, 3), (Occupied, 13), (Occupied, 23), (Occupied, 33)], Occupied),
            (never, &[(Free, 3), (Occupied, 3), (Free, 3), (Occupied, 3)], Occupied),
            ((Free, 3), &[(Occupied, 13), (Free, 23), (Occupied, 33)], Movable),
            ((Occupied, 39), &[(Free, 3), (Occupied, 13), (Free, 23), (Occupied, 33)], Occupied),
            ((Occupied, 13), &[(Free, 3), (Free, 23), (Occupied, 33)], Movable),
        ];
        for (camera, robots, expected) in cases {
            let robots: Vec<(Cell, u32, Weight)> =
                robots.iter().map(|&(cell, second)| (cell, second, Weight::FULL)).collect();
            assert_eq!(fused(camera, &robots, 40), expected, "{camera:?} and {robots:?}");
        }
    }

    /// A tile is the fusion of its cells, each by itself.
    #[test]
    fn cells_are_fused_at_their_places() {
        let mut tile = Tile::UNKNOWN;
        tile.set(31, 0, Occupied);
        tile.set(0, 31, Free);
        tile.set(12, 17, Movable);
        let robot = SeenTile { tile, seconds: [5; TILE_CELLS as usize] };
        let fused = fuse(&SeenTile::NOTHING, &[(Weight::FULL, &robot)], None, MapTime::default());
        assert_eq!(fused, tile);
    }

    /// A free claim from the server's first second is no claim that cameras could have revoked.
    #[test]
    fn what_cameras_have_never_seen_is_not_revoked() {
        assert_eq!(fused((Unknown, 0), &[(Free, 0, Weight::FULL)], 40), Free);
        assert_eq!(fused((Unknown, 1), &[(Free, 1, Weight::FULL)], 40), Unknown);
        // A claim of the cameras is no revocation, and three alternations are enough.
        assert_eq!(fused((Occupied, 4), &[(Free, 7, Weight::FULL)], 40), Free);
        let words = [(Free, 3), (Occupied, 3), (Free, 13), (Occupied, 23)];
        let words = words.map(|(cell, second)| (cell, second, Weight::FULL));
        assert_eq!(fused((Unknown, 0), &words, 40), Occupied, "two of them in the same second");
    }

    #[test]
    fn claims_of_lower_weight_count_as_older() {
        let never = (Unknown, 0);
        let free = (Free, 100, Weight::FULL);
        let less = |second| (Occupied, second, Weight::grade(Weight::FULL.0 - 1));
        assert_eq!(fused(never, &[free, less(159)], 200), Free);
        assert_eq!(fused(never, &[free, less(161)], 200), Occupied);
        assert_eq!(fused(never, &[less(3)], 200), Occupied, "there is no other claim");
        assert_eq!(fused(never, &[(Occupied, 190, Weight::NONE)], 200), Unknown);
        assert_eq!(fused((Free, 9), &[(Occupied, 190, Weight::NONE)], 200), Free);
    }

    #[test]
    fn movable_cells_are_forgotten_and_fixed_ones_are_not() {
        let never = (Unknown, 0);
        let robot = |cell, second| (cell, second, Weight::FULL);
        assert_eq!(fused(never, &[robot(Movable, 11)], 309), Movable);
        assert_eq!(fused(never, &[robot(Movable, 10)], 310), Unknown);
        assert_eq!(fused(never, &[robot(Movable, 10), robot(Free, 3)], 310), Free);
        assert_eq!(fused(never, &[robot(Occupied, 10), robot(Unknown, 3)], 100_000), Occupied);
    }

    #[test]
    fn what_is_likely_to_move_is_forgotten_unless_a_robot_looks() {
        let never = (Unknown, 0);
        let robot = |cell, second| (cell, second, Weight::FULL);
        let chair = |looked| CellPrior { label: CellLabel::After(60), looked };
        let at = |looked, camera, robots: &[_], second| {
            fused_with(chair(looked), camera, robots, second)
        };
        assert_eq!(at(0, never, &[robot(Occupied, 11)], 70), Occupied);
        assert_eq!(at(0, never, &[robot(Occupied, 10)], 70), Unknown);
        assert_eq!(at(11, never, &[robot(Occupied, 10)], 70), Occupied, "a robot has looked since");
        assert_eq!(at(0, never, &[robot(Free, 10)], 70), Unknown);
        assert_eq!(at(0, never, &[robot(Occupied, 10), robot(Free, 11)], 70), Free);
        // An older claim does not come back when the newer one is forgotten.
        assert_eq!(at(0, never, &[robot(Occupied, 10), robot(Free, 11)], 80), Unknown);
        // Cameras confirm what they see with every frame.
        assert_eq!(at(0, (Occupied, 69), &[], 70), Occupied);
        assert_eq!(at(0, (Occupied, 9), &[robot(Free, 12)], 70), Free);
        assert_eq!(at(0, (Free, 9), &[], 70), Unknown);
    }

    #[test]
    fn what_stays_is_neither_forgotten_nor_movable() {
        let cabinet = CellPrior { label: CellLabel::Never, looked: 0 };
        let robot = |cell, second| (cell, second, Weight::FULL);
        let changes = [(Free, 3), (Occupied, 13), (Free, 23), (Occupied, 33)]
            .map(|(cell, second)| robot(cell, second));
        assert_eq!(fused((Unknown, 0), &changes, 40), Movable);
        assert_eq!(fused_with(cabinet, (Unknown, 0), &changes, 40), Occupied);
        let movable = [robot(Movable, 10)];
        assert_eq!(fused_with(cabinet, (Unknown, 0), &movable, 10_000), Occupied);
        assert_eq!(fused_with(cabinet, (Movable, 39), &[], 40), Movable, "someone before it");
    }

    #[test]
    fn the_cells_under_a_robot_are_not_occupied() {
        let mut under = [0; TILE_SIDE];
        under[9] = 1 << 7 | 1 << 8;
        for (cell, expected) in
            [(Unknown, Unknown), (Free, Free), (Occupied, Free), (Movable, Free)]
        {
            let mut tile = seen((cell, 0)).tile;
            tile.set(9, 9, Occupied);
            assert_eq!(clear(&mut tile, &under), cell != expected);
            assert_eq!((tile.cell(7, 9), tile.cell(8, 9)), (expected, Unknown));
            assert_eq!(tile.cell(9, 9), Occupied);
        }
    }

    #[test]
    fn map_time_advances_in_steps() {
        let at = |micros| MapTime::at(Instant(micros));
        assert_eq!(at(0), at(9_999_999));
        assert_eq!(at(0).next(), Instant(10_000_000));
        assert_eq!(MapTime::at(at(0).next()).next(), Instant(20_000_000));
        // A second is recent from the step before the current one on.
        let time = at(57_000_000);
        assert_eq!(
            [39, 40, 50, 59, 70].map(|second| time.is_recent(second)),
            [false, true, true, true, true]
        );
    }
}

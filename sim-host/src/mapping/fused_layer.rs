//! The fused layer: what everybody gets.

use ubimap_protocol::{
    tile::{Cell, TILE_CELLS, TILE_SIDE, Tile},
    time::{Duration, Instant},
};

use super::{agreement::Weight, mask::Mask, robot_layer::SeenTile};

/// The map's time goes in steps of so many seconds.
const STEP_S: u32 = 10;
/// What the cameras said of a cell holds against a robot's word that is newer by no more than so
/// many seconds: they look at a cell twice a second, and frames may be late.
const HOLDS_S: u32 = 2;
/// The word of a robot counts as said earlier by so many seconds for each grade that its weight
/// falls short of the full one.
const GRADE_S: u32 = 60;
/// Something movable that a robot saw so many seconds ago is forgotten. What is fixed never is: a
/// robot that agrees with the map is silent.
const MOVABLE_S: u32 = 300;
/// A cell keeps changing if free and occupied have followed each other so often, in the order of
/// time of the last words of all who know it.
const CHANGES: usize = 3;

/// The time by which the map ages: seconds of the server's clock, in steps of ten.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct MapTime(u32);

impl MapTime {
    /// The step that a moment is in.
    pub fn at(moment: Instant) -> Self {
        // The seconds of 136 years fit.
        Self((moment.micros() / 1_000_000) as u32 / STEP_S * STEP_S)
    }

    /// Whether a second is in the step or in the one before it.
    pub(super) fn is_recent(self, second: u32) -> bool {
        second.saturating_add(STEP_S) >= self.0
    }

    /// When the next step begins.
    pub fn next(self) -> Instant {
        Instant(0) + Duration::from_secs(u64::from(self.0) + u64::from(STEP_S))
    }
}

/// What somebody said of a cell: counted as said in that second (those before the clock began are
/// negative), and what. Of two words of one second the cameras' holds, then that of something
/// there.
type Word = (i64, bool, u8);

/// Fuses one tile: what the cameras have seen and when last, and what each robot has, and its
/// weight, in any order of the robots. A pure function, in integers. For each cell:
///
/// | the cameras | the robots | fused |
/// |---|---|---|
/// | have seen it | anything, no later than two seconds after | the cameras' code |
/// | have taken back what they said | one said that it is free, no later than that | does not count |
/// | have seen it, or never | one said something new of it last, and later than that | what it said |
/// | as before | several did, within the same second | occupied if any of them says so |
/// | as before | one of a lesser weight | what it said counts as a minute older for each grade |
/// | never | none but some of no weight | unknown |
/// | never | something movable, five minutes ago by the map's time | unknown |
/// | have seen it, or never | occupied last, after free and occupied took turns three times | movable |
///
/// A robot that agrees with the map is silent, so whoever spoke last has seen it otherwise. Costs
/// some nanoseconds for each cell and robot.
pub fn fuse(cameras: &SeenTile, robots: &[(Weight, &SeenTile)], time: MapTime) -> Tile {
    let mut fused = Tile::UNKNOWN;
    let mut words: Vec<Word> = Vec::new();
    for cell in 0..usize::from(TILE_CELLS) {
        let (x, y) = (cell % TILE_SIDE, cell / TILE_SIDE);
        words.clear();
        let camera = cameras.tile.cell(x, y);
        if camera != Cell::Unknown {
            words.push((
                i64::from(cameras.seconds[cell]) + i64::from(HOLDS_S),
                true,
                camera.code(),
            ));
        }
        for (weight, robot) in robots {
            let (code, second) = (robot.tile.cell(x, y), robot.seconds[cell]);
            let is_forgotten = match code {
                Cell::Movable => time.0.saturating_sub(second) >= MOVABLE_S,
                Cell::Free if camera == Cell::Unknown => {
                    second <= cameras.seconds[cell] && cameras.seconds[cell] > 0
                }
                _ => false,
            };
            if code != Cell::Unknown && *weight != Weight::NONE && !is_forgotten {
                let later = i64::from(weight.short_of_full()) * i64::from(GRADE_S);
                words.push((i64::from(second) - later, false, code.code()));
            }
        }
        // Of the codes, free is the least.
        let Some(&(_, by_cameras, code)) = words.iter().max() else { continue };
        let mut code = Cell::from_code(code);
        if code == Cell::Occupied && !by_cameras && keeps_changing(&mut words) {
            code = Cell::Movable;
        }
        fused.set(x, y, code);
    }
    fused
}

/// Whether free and occupied have followed each other often.
fn keeps_changing(words: &mut [Word]) -> bool {
    if words.len() <= CHANGES {
        return false;
    }
    words.sort_unstable();
    let is_free = |word: &Word| Cell::from_code(word.2) == Cell::Free;
    let follow = words
        .windows(2)
        .filter(|pair| pair[0].0 < pair[1].0 && is_free(&pair[0]) != is_free(&pair[1]));
    follow.count() >= CHANGES
}

/// Cells under a localised robot are not occupied. Whether any was.
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

    /// What is fused of the cameras' word and the robots', each with its weight, in this second.
    fn fused(camera: (Cell, u32), robots: &[(Cell, u32, Weight)], second: u64) -> Cell {
        let robots: Vec<(Weight, SeenTile)> =
            robots.iter().map(|&(cell, second, weight)| (weight, seen((cell, second)))).collect();
        let mut robots: Vec<(Weight, &SeenTile)> =
            robots.iter().map(|(weight, seen)| (*weight, seen)).collect();
        let time = MapTime::at(Instant(second * 1_000_000));
        let there = fuse(&seen(camera), &robots, time);
        robots.reverse();
        assert_eq!(there, fuse(&seen(camera), &robots, time), "the order of the robots matters");
        let code = there.cell(7, 9);
        assert_eq!(there.counts().0, u32::from(code != Unknown));
        code
    }

    #[test]
    fn the_table_of_cases() {
        let never = (Unknown, 0);
        let cases: [(_, &[_], _); 22] = [
            (never, &[], Unknown),
            (never, &[(Unknown, 3), (Unknown, 4)], Unknown),
            (never, &[(Free, 3), (Unknown, 4)], Free),
            (never, &[(Free, 3), (Occupied, 3)], Occupied),
            (never, &[(Free, 4), (Occupied, 3)], Free),
            (never, &[(Free, 4), (Occupied, 3), (Movable, 4)], Movable),
            // In view, or out of it with nothing new.
            ((Free, 4), &[(Occupied, 3), (Occupied, 4)], Free),
            ((Free, 4), &[(Occupied, 6)], Free),
            ((Movable, 4), &[(Free, 3)], Movable),
            ((Occupied, 4), &[(Free, 3), (Unknown, 40)], Occupied),
            // Out of view, and a robot has been there since.
            ((Free, 4), &[(Occupied, 7)], Occupied),
            ((Occupied, 4), &[(Free, 7), (Occupied, 3)], Free),
            // Taken back by the cameras.
            ((Unknown, 4), &[(Free, 4)], Unknown),
            ((Unknown, 4), &[(Free, 5)], Free),
            ((Unknown, 4), &[(Free, 3), (Occupied, 2)], Occupied),
            ((Unknown, 4), &[(Free, 3), (Movable, 4)], Movable),
            // Keeps changing.
            (never, &[(Free, 3), (Occupied, 13), (Free, 23), (Occupied, 33)], Movable),
            (never, &[(Occupied, 3), (Free, 13), (Occupied, 23), (Free, 33)], Free),
            (never, &[(Free, 3), (Occupied, 13), (Occupied, 23), (Occupied, 33)], Occupied),
            (never, &[(Free, 3), (Occupied, 3), (Free, 3), (Occupied, 3)], Occupied),
            ((Free, 3), &[(Occupied, 13), (Free, 23), (Occupied, 33)], Movable),
            ((Occupied, 39), &[(Free, 3), (Occupied, 13), (Free, 23), (Occupied, 33)], Occupied),
        ];
        for (camera, robots, expected) in cases {
            let robots: Vec<(Cell, u32, Weight)> =
                robots.iter().map(|&(cell, second)| (cell, second, Weight::FULL)).collect();
            assert_eq!(fused(camera, &robots, 40), expected, "{camera:?} and {robots:?}");
        }
    }

    #[test]
    fn a_robot_of_less_weight_counts_as_earlier_and_one_of_none_not_at_all() {
        let never = (Unknown, 0);
        let free = (Free, 100, Weight::FULL);
        let less = |second| (Occupied, second, Weight::grade(Weight::FULL.0 - 1));
        assert_eq!(fused(never, &[free, less(159)], 200), Free);
        assert_eq!(fused(never, &[free, less(161)], 200), Occupied);
        assert_eq!(fused(never, &[less(3)], 200), Occupied, "nobody else has been there");
        assert_eq!(fused(never, &[(Occupied, 190, Weight::NONE)], 200), Unknown);
        assert_eq!(fused((Free, 9), &[(Occupied, 190, Weight::NONE)], 200), Free);
    }

    #[test]
    fn what_moves_is_forgotten_and_what_is_fixed_is_not() {
        let never = (Unknown, 0);
        let robot = |cell, second| (cell, second, Weight::FULL);
        assert_eq!(fused(never, &[robot(Movable, 11)], 309), Movable);
        assert_eq!(fused(never, &[robot(Movable, 10)], 310), Unknown);
        assert_eq!(fused(never, &[robot(Movable, 10), robot(Free, 3)], 310), Free);
        assert_eq!(fused(never, &[robot(Occupied, 10), robot(Unknown, 3)], 100_000), Occupied);
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
    fn the_time_of_the_map_goes_in_steps() {
        let at = |micros| MapTime::at(Instant(micros));
        assert_eq!(at(0), at(9_999_999));
        assert_eq!(at(0).next(), Instant(10_000_000));
        assert_eq!(MapTime::at(at(0).next()).next(), Instant(20_000_000));
    }
}

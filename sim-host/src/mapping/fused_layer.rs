//! The fused layer: what everybody gets.

use ubimap_protocol::tile::{Cell, TILE_CELLS, TILE_SIDE, Tile};

use super::robot_layer::SeenTile;

/// Fuses one tile: what the cameras have seen, and what each robot has, in any order. A pure
/// function:
///
/// | the cameras | the robots | fused |
/// |---|---|---|
/// | know the cell | anything | the cameras' code |
/// | don't | none knows it | unknown |
/// | don't | one said something new of it last | what that one said |
/// | don't | several did, within the same second | occupied if any of them says so |
///
/// A robot that agrees with the map is silent, so whoever spoke last has seen it otherwise.
pub fn fuse(cameras: &Tile, robots: &[&SeenTile]) -> Tile {
    let mut fused = *cameras;
    for cell in 0..usize::from(TILE_CELLS) {
        let (x, y) = (cell % TILE_SIDE, cell / TILE_SIDE);
        if cameras.cell(x, y) != Cell::Unknown {
            continue;
        }
        let said = robots.iter().map(|robot| (robot.tile.cell(x, y), robot.seconds[cell]));
        let known = said.filter(|(code, _)| *code != Cell::Unknown);
        // Of the codes, free is the least.
        if let Some((_, code)) = known.map(|(code, second)| (second, code.code())).max() {
            fused.set(x, y, Cell::from_code(code));
        }
    }
    fused
}

#[cfg(test)]
mod tests {
    use super::*;
    use Cell::{Free, Movable, Occupied, Unknown};

    fn of(cell: Cell) -> Tile {
        let mut tile = Tile::UNKNOWN;
        tile.set(7, 9, cell);
        tile
    }

    fn seen(&(cell, second): &(Cell, u32)) -> SeenTile {
        SeenTile { tile: of(cell), seconds: [second; TILE_CELLS as usize] }
    }

    #[test]
    fn the_table_of_cases() {
        let cases: [(_, &[_], _); 9] = [
            (Unknown, &[], Unknown),
            (Unknown, &[(Unknown, 3), (Unknown, 4)], Unknown),
            (Unknown, &[(Free, 3), (Unknown, 4)], Free),
            (Unknown, &[(Free, 3), (Occupied, 3)], Occupied),
            (Unknown, &[(Free, 4), (Occupied, 3)], Free),
            (Unknown, &[(Free, 4), (Occupied, 3), (Movable, 4)], Movable),
            (Free, &[(Occupied, 3), (Occupied, 4)], Free),
            (Movable, &[(Free, 3)], Movable),
            (Occupied, &[(Free, 3), (Unknown, 4)], Occupied),
        ];
        for (camera, robots, expected) in cases {
            let robots: Vec<SeenTile> = robots.iter().map(seen).collect();
            let mut robots: Vec<&SeenTile> = robots.iter().collect();
            for _ in 0..2 {
                let fused = fuse(&of(camera), &robots);
                assert_eq!(fused.cell(7, 9), expected, "{camera:?} and {robots:?}");
                assert_eq!(fused.counts().0, u32::from(expected != Unknown));
                robots.reverse();
            }
        }
    }
}

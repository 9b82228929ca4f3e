//! How often each cell changes: the changes of the fused layer, and what is known beforehand.

use std::collections::BTreeMap;

use ubimap_protocol::tile::{Cell, TILE_CELLS, TILE_SIDE, Tile, TileId};

use super::{fused_layer::MapTime, prior_layer::CellLabel};

/// Mean time between changes in seconds that is assumed of cells without a label, and of those that stay.
const USUAL_S: f64 = 4.0 * 3_600.0;
const STAYS_S: f64 = 30.0 * 86_400.0;

/// Expected time between two changes of a cell in seconds: the mean of the changes' rate after the
/// observation (a Gamma prior that weighs as much as one change, and Poisson changes), inverted.
pub fn interval_s(label: CellLabel, observed_s: f64, changes: u32) -> f64 {
    let prior_s = match label {
        CellLabel::None => USUAL_S,
        CellLabel::After(seconds) => f64::from(seconds),
        CellLabel::Never => STAYS_S,
    };
    (prior_s + observed_s) / (1.0 + f64::from(changes))
}

/// The changes of a tile.
#[derive(Clone, Debug)]
struct Counts {
    /// The last known code of each cell.
    last: Tile,
    /// How often it was free before and occupied then, or the reverse.
    changes: [u16; TILE_CELLS as usize],
    /// The map's time when the tile was first known.
    since: MapTime,
}

/// The changes of all tiles between free and occupied, since the server started.
#[derive(Clone, Debug, Default)]
pub struct Volatility {
    tiles: BTreeMap<TileId, Box<Counts>>,
}

impl Volatility {
    /// Counts the cells of a published tile that have changed. Cells that are forgotten and found again
    /// as they were do not count.
    pub fn note(&mut self, id: TileId, tile: &Tile, time: MapTime) {
        let counts = self.tiles.entry(id).or_insert_with(|| {
            let changes = [0; TILE_CELLS as usize];
            Box::new(Counts { last: Tile::UNKNOWN, changes, since: time })
        });
        for y in 0..TILE_SIDE {
            let (last, new) = (counts.last.row(y), tile.row(y));
            let mut changed = (last.high ^ new.high) & last.known() & new.known();
            while changed != 0 {
                let x = changed.trailing_zeros() as usize;
                let count = &mut counts.changes[y * TILE_SIDE + x];
                *count = count.saturating_add(1);
                changed &= changed - 1;
            }
            // The planes of unknown cells are 0.
            let mut merged = last;
            merged.low = last.low & !new.known() | new.low;
            merged.high = last.high & !new.known() | new.high;
            counts.last.set_row(y, merged);
        }
    }

    /// The last known code of a cell, how often it has changed, and for how many seconds its tile has
    /// been known at a time; unknown and nothing beyond what was ever known.
    pub fn get(&self, id: TileId, cell: usize, time: MapTime) -> (Cell, u32, f64) {
        let Some(counts) = self.tiles.get(&id) else { return (Cell::Unknown, 0, 0.0) };
        let changes = counts.changes.get(cell).copied().unwrap_or_default();
        let code = counts.last.cell(cell % TILE_SIDE, cell / TILE_SIDE % TILE_SIDE);
        (code, changes.into(), time.seconds_since(counts.since))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ubimap_protocol::time::Instant;

    #[test]
    fn changes_count_and_forgetting_does_not() {
        let id = TileId { x: -1, y: 2 };
        let mut volatility = Volatility::default();
        let mut see = |codes: &[Cell]| {
            for &code in codes {
                let mut tile = Tile::UNKNOWN;
                tile.set(31, 3, code);
                volatility.note(id, &tile, MapTime::at(Instant(20_000_000)));
            }
            volatility.get(id, 3 * TILE_SIDE + 31, MapTime::at(Instant(90_000_000)))
        };
        use Cell::{Free, Movable, Occupied, Unknown};
        assert_eq!(see(&[Free, Free]), (Free, 0, 70.0));
        assert_eq!(see(&[Occupied, Movable, Unknown, Movable]), (Movable, 1, 70.0));
        assert_eq!(see(&[Unknown, Free, Unknown]), (Free, 2, 70.0));
        assert_eq!(volatility.get(TileId { x: 0, y: 0 }, 0, MapTime::default()).0, Unknown);
    }

    #[test]
    fn observations_outweigh_the_prior() {
        let chair = CellLabel::After(120);
        assert_eq!(interval_s(chair, 0.0, 0), 120.0);
        assert_eq!(interval_s(chair, 3_480.0, 0), 3_600.0, "a chair that stands for an hour");
        assert_eq!(interval_s(CellLabel::None, 600.0, 24), 600.0, "a passage");
        assert!(interval_s(CellLabel::Never, 600.0, 1) > interval_s(CellLabel::None, 600.0, 1));
    }
}

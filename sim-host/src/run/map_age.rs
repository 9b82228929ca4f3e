//! How soon the map shows that something was moved.

use std::{cell::RefCell, collections::BTreeSet};

use ubimap_protocol::{
    tile::{Cell, TILE_SIDE, TileId},
    time::{Duration, Instant},
    units::Millimetres,
};

use super::{RunError, fleet::Fleet};
use crate::{
    mapping::ServedLayer,
    report::ChangeSummary,
    world::{Scenario, WallGrid, World},
};

/// Interval between two looks at the map.
const INTERVAL: Duration = Duration::from_millis(100);

/// The changes of a room, with the times at which the map showed them.
pub(super) struct MapAge {
    changes: RefCell<Vec<Change>>,
    next: std::cell::Cell<Instant>,
}

struct Change {
    at: Instant,
    /// Cells of surfaces that appear, and those that vanish.
    new: Vec<(i32, i32)>,
    old: Vec<(i32, i32)>,
    drawn: Option<Duration>,
    removed: Option<Duration>,
    freed: Option<Duration>,
}

impl MapAge {
    /// The changes of a scenario's room, of furniture and doors: found by letting it pass alone.
    ///
    /// # Errors
    /// [`RunError::Scenario`].
    pub(super) fn of(
        scenario: &Scenario,
        walls: Option<&WallGrid>,
        resolution: Millimetres,
    ) -> Result<Self, RunError> {
        let mut empty = scenario.clone();
        empty.people.clear();
        let moves = scenario.furniture.iter().flat_map(|furniture| &furniture.moved);
        let doors = scenario.doors.iter().flat_map(|door| door.open_s.iter().flatten().copied());
        let mut times: Vec<f64> = moves.map(|it| it.at_s).chain(doors).collect();
        times.sort_by(f64::total_cmp);
        times.dedup();
        let mut changes = Vec::new();
        if !times.is_empty() {
            empty.cameras.clear();
            let mut world = World::new(&empty, walls, resolution, 1)?;
            let surfaces =
                |world: &World| -> BTreeSet<_> { world.truth().surfaces.iter().copied().collect() };
            for at_s in times {
                let at = Instant(0) + Duration::from_micros((at_s * 1e6) as u64);
                let before = surfaces(&world);
                world.advance(at + Duration::from_millis(100));
                let after = surfaces(&world);
                let new = after.difference(&before).copied().collect();
                let old = before.difference(&after).copied().collect();
                changes.push(Change { at, new, old, drawn: None, removed: None, freed: None });
            }
        }
        Ok(Self { changes: RefCell::new(changes), next: std::cell::Cell::new(Instant(0)) })
    }

    /// Looks at the map, once per [`INTERVAL`].
    pub(super) fn look(&self, fleet: &Fleet<'_>) {
        let now = fleet.now();
        if now < self.next.get() {
            return;
        }
        self.next.set(now + INTERVAL);
        let fused = fleet.server().fused();
        for change in self.changes.borrow_mut().iter_mut().filter(|change| change.at <= now) {
            let since = now.since(change.at);
            let drawn = occupied(fused, &change.new);
            let left = occupied(fused, &change.old);
            let free = count(fused, &change.old, |cell| cell == Cell::Free);
            if change.drawn.is_none() && 2 * drawn >= change.new.len() {
                change.drawn = Some(since);
            }
            if change.removed.is_none() && 10 * left <= change.old.len() {
                change.removed = Some(since);
            }
            if change.freed.is_none() && 2 * free >= change.old.len() {
                change.freed = Some(since);
            }
        }
    }

    pub(super) fn summary(&self) -> Vec<ChangeSummary> {
        let seconds = |time: Duration| time.micros() as f64 / 1e6;
        let summary = |change: &Change| ChangeSummary {
            at_s: change.at.0 as f64 / 1e6,
            cells: [change.new.len() as u64, change.old.len() as u64],
            drawn_s: change.drawn.map(seconds),
            removed_s: change.removed.map(seconds),
            freed_s: change.freed.map(seconds),
        };
        self.changes.borrow().iter().map(summary).collect()
    }
}

/// Number of the cells that are occupied, fixed or movable.
pub(super) fn occupied(fused: &ServedLayer, cells: &[(i32, i32)]) -> usize {
    count(fused, cells, |cell| matches!(cell, Cell::Occupied | Cell::Movable))
}

/// How many cells are of a kind in the fused map.
fn count(fused: &ServedLayer, cells: &[(i32, i32)], is_kind: impl Fn(Cell) -> bool) -> usize {
    let within = |cell: i32| cell.rem_euclid(TILE_SIDE as i32) as usize;
    let is_there = |&&(x, y): &&(i32, i32)| {
        let tile = TileId::of_cell(x, y).and_then(|id| fused.get(id));
        tile.is_some_and(|(_, tile)| is_kind(tile.cell(within(x), within(y))))
    };
    cells.iter().filter(is_there).count()
}

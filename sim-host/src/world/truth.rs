//! The perfect map of the room at slice height.

use std::collections::BTreeSet;

use parry2d_f64::glamx::{DVec2, DVec3};

use super::room::{CellGrid, Room};

/// Distance in front of a surface, in metres, that must be visible.
const AIR: f64 = 0.01;

/// Depth below a surface, in metres, of the point whose cell holds the surface.
const SKIN: f64 = 0.001;

/// The perfect map of the static room at slice height.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Truth {
    /// Cells that contain a surface visible from the reachable floor, sorted. The insides and far sides of
    /// walls are not included.
    pub surfaces: Vec<(i32, i32)>,
    /// Cells without a surface whose centres can be reached from a robot's start at slice height, now or
    /// before the room changed; sorted.
    pub free: Vec<(i32, i32)>,
}

/// The truth as seen from the starts, and from the cells that were free `before` the room changed:
/// a closet that was open once stays known when its door closes. Without starts, as seen from
/// anywhere in the room.
pub(super) fn truth(
    room: &Room,
    cells: CellGrid,
    height: f64,
    starts: &[DVec2],
    before: &Truth,
) -> Truth {
    let reached = reach(room, cells, height, starts, &before.free);
    let surfaces = surfaces(room, cells, height, &reached);
    let free = (0..cells.count())
        .filter(|&index| reached[index])
        .map(|index| cells.cell(index))
        .filter(|cell| !surfaces.contains(cell))
        .collect::<BTreeSet<_>>();
    Truth { surfaces: surfaces.into_iter().collect(), free: free.into_iter().collect() }
}

/// The cells whose centres are connected by free steps to a start, or to a cell that was free before.
fn reach(
    room: &Room,
    cells: CellGrid,
    height: f64,
    starts: &[DVec2],
    before: &[(i32, i32)],
) -> Vec<bool> {
    let open = |cell: (i32, i32)| {
        let centre = cells.centre(cell);
        room.encloses(centre) && !is_solid(room, centre, height)
    };
    let mut reached = vec![false; cells.count()];
    if starts.is_empty() {
        for (index, reached) in reached.iter_mut().enumerate() {
            *reached = open(cells.cell(index));
        }
        return reached;
    }
    let mut queue: Vec<(i32, i32)> = before.iter().copied().filter(|cell| open(*cell)).collect();
    for &start in starts {
        // The centre of the start's cell may be solid although the start is not.
        let (x, y) = cells.cell_at(start);
        for cell in (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| (x + dx, y + dy))) {
            let centre = cells.centre(cell);
            if open(cell) && room.sees(start.extend(height), centre.extend(height)) {
                queue.push(cell);
            }
        }
    }
    while let Some(cell) = queue.pop() {
        let Some(index) = cells.index(cell).filter(|&index| !reached[index]) else {
            continue;
        };
        reached[index] = true;
        let from = cells.centre(cell).extend(height);
        for (dx, dy) in [(1, 0), (0, 1), (-1, 0), (0, -1)] {
            let next = (cell.0 + dx, cell.1 + dy);
            let Some(index) = cells.index(next) else { continue };
            // A wall thinner than a cell may separate two free centres.
            if !reached[index] && open(next) && room.sees(from, cells.centre(next).extend(height)) {
                queue.push(next);
            }
        }
    }
    reached
}

fn surfaces(room: &Room, cells: CellGrid, height: f64, reached: &[bool]) -> BTreeSet<(i32, i32)> {
    let mut surfaces = BTreeSet::new();
    for prism in room.prisms().iter().filter(|prism| prism.spans(height)) {
        for (point, normal) in prism.footprint.boundary(cells.side / 8.0) {
            let cell = cells.cell_at(point - normal * SKIN);
            let air = point + normal * AIR;
            if cells.index(cell).is_some()
                && !surfaces.contains(&cell)
                && is_seen(room, cells, air.extend(height), reached)
            {
                surfaces.insert(cell);
            }
        }
    }
    surfaces
}

/// Whether a point is visible from the centre of a reached cell next to it.
fn is_seen(room: &Room, cells: CellGrid, point: DVec3, reached: &[bool]) -> bool {
    let (x, y) = cells.cell_at(point.truncate());
    (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| (x + dx, y + dy))).any(|cell| {
        cells.index(cell).is_some_and(|index| reached[index])
            && room.sees(cells.centre(cell).extend(point.z), point)
    })
}

fn is_solid(room: &Room, point: DVec2, height: f64) -> bool {
    // A range of no height: selects the prisms that span this height.
    room.is_solid(point, height, height + f64::EPSILON)
}

//! Where robots stand, and what others have drawn of them.

use std::collections::{BTreeMap, BTreeSet};

use ubimap_protocol::{
    tile::TileId,
    time::{Duration, Instant},
};

use crate::mapping::Mask;

/// Time after which a camera's sighting of a robot gives way to the robot's own report.
const SIGHTING_LASTS: Duration = Duration::from_secs(1);

/// Where a robot stands.
#[derive(Debug, Default)]
pub(super) struct Standing {
    pub(super) captured: Instant,
    /// Whether a camera saw it; otherwise it reported its pose.
    pub(super) is_seen: bool,
    /// The cells below the robot.
    pub(super) under: BTreeMap<TileId, Mask>,
    /// These, and those that it touches or almost touches.
    pub(super) around: BTreeMap<TileId, Mask>,
}

impl Standing {
    pub(super) fn new(
        captured: Instant,
        is_seen: bool,
        under: impl Iterator<Item = (i32, i32)>,
        around: impl Iterator<Item = (i32, i32)>,
    ) -> Self {
        Self { captured, is_seen, under: masks(under), around: masks(around) }
    }

    /// Whether this is newer than `last`, and not a report about a robot that a camera sees.
    pub(super) fn replaces(&self, last: &Self) -> bool {
        self.captured >= last.captured
            && (self.is_seen
                || !last.is_seen
                || self.captured.since(last.captured) >= SIGHTING_LASTS)
    }

    /// The cells of a tile that others have drawn of the robot: those around it that are occupied and do not
    /// continue beyond, as a wall would.
    pub(super) fn outline(&self, id: TileId, is_occupied: impl Fn((i32, i32)) -> bool) -> Mask {
        let mut drawn: BTreeSet<(i32, i32)> =
            cells(&self.around).filter(|cell| is_occupied(*cell)).collect();
        let is_around = |(x, y)| {
            TileId::of_cell(x, y).and_then(|id| Some((id, self.around.get(&id)?))).is_some_and(
                |(id, mask)| {
                    let (west, south) = id.first_cell();
                    mask[(y - south) as usize] >> (x - west) & 1 != 0
                },
            )
        };
        let continues = |cell: &(i32, i32)| {
            beside(*cell).any(|beside| !is_around(beside) && is_occupied(beside))
        };
        let mut walls: Vec<(i32, i32)> = drawn.iter().copied().filter(continues).collect();
        while let Some(cell) = walls.pop() {
            drawn.remove(&cell);
            walls.extend(beside(cell).filter(|beside| drawn.remove(beside)));
        }
        masks(drawn.into_iter()).remove(&id).unwrap_or_default()
    }
}

/// The eight cells beside a cell.
fn beside((x, y): (i32, i32)) -> impl Iterator<Item = (i32, i32)> {
    let square = (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| (dx, dy)));
    square.filter(|it| *it != (0, 0)).map(move |(dx, dy)| (x + dx, y + dy))
}

fn cells(masks: &BTreeMap<TileId, Mask>) -> impl Iterator<Item = (i32, i32)> {
    masks.iter().flat_map(|(id, mask)| {
        let (west, south) = id.first_cell();
        (south..).zip(mask).flat_map(move |(y, row)| {
            let columns = (0..32).filter(move |column| row >> column & 1 != 0);
            columns.map(move |column| (west + column, y))
        })
    })
}

/// Cells by tile; those beyond the map's range are left out.
fn masks(cells: impl Iterator<Item = (i32, i32)>) -> BTreeMap<TileId, Mask> {
    let mut masks = BTreeMap::<TileId, Mask>::new();
    for (x, y) in cells {
        if let Some(id) = TileId::of_cell(x, y) {
            let (west, south) = id.first_cell();
            masks.entry(id).or_default()[(y - south) as usize] |= 1 << (x - west);
        }
    }
    masks
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_outline_ends_where_a_wall_continues() {
        // Across the corner of four tiles.
        let square =
            |reach: i32| (-reach..=reach).flat_map(move |y| (-reach..=reach).map(move |x| (x, y)));
        let robot = Standing::new(Instant(0), false, square(2), square(4));
        let arc = [(-3, -1), (-3, 0), (-3, 1), (-2, 2)];
        let wall = |(x, y): (i32, i32)| x == 4 && (-9..9).contains(&y);
        let drawn = |arc: &[(i32, i32)]| {
            let is_occupied = |cell| wall(cell) || arc.contains(&cell);
            let tiles = (-1..1i16).flat_map(|y| (-1..1i16).map(move |x| TileId { x, y }));
            let tiles = tiles.map(|id| (id, robot.outline(id, is_occupied))).collect();
            cells(&tiles).collect::<BTreeSet<_>>()
        };
        assert_eq!(drawn(&arc), BTreeSet::from(arc));
        // What touches a wall, or reaches farther, is not the robot.
        assert_eq!(drawn(&[(3, 0), (2, 1)]), BTreeSet::new());
        assert_eq!(drawn(&[(-4, 0), (-5, 0), (-3, 1)]), BTreeSet::new());
    }

    #[test]
    fn a_report_gives_way_to_a_camera() {
        let at = |millis, is_seen| {
            let (under, around) = ([(0, 0)].into_iter(), [(0, 0)].into_iter());
            Standing::new(Instant(0) + Duration::from_millis(millis), is_seen, under, around)
        };
        assert!(at(2, true).replaces(&at(1, true)) && !at(1, true).replaces(&at(2, true)));
        assert!(at(2, true).replaces(&at(1, false)) && at(2, false).replaces(&at(1, false)));
        assert!(!at(500, false).replaces(&at(1, true)) && at(1_001, false).replaces(&at(1, true)));
    }
}

//! What is known beforehand of each cell: how soon its state is likely to be outdated.

use std::collections::{BTreeMap, BTreeSet};

use ubimap_protocol::{
    message::DistanceVector,
    tile::{TILE_CELLS, TILE_SIDE, TileId},
    units::Millimetres,
};

use crate::grid::{Label, span};

/// The label of a cell, and when a robot last looked at it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CellPrior {
    /// The cell's label.
    pub label: CellLabel,
    /// Second of the server's clock in which a robot last looked at the cell.
    pub looked: u32,
}

/// How soon claims about a cell are forgotten.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum CellLabel {
    /// Nothing is known beforehand.
    #[default]
    None,
    /// At this age in seconds: what stands here is likely to move.
    After(u32),
    /// Never: what stands here stays.
    Never,
}

impl CellLabel {
    /// The label that is forgotten sooner.
    fn sooner(self, other: Self) -> Self {
        match (self, other) {
            (Self::After(a), Self::After(b)) => Self::After(a.min(b)),
            (it @ Self::After(_), _) | (_, it @ Self::After(_)) => it,
            (Self::Never, _) | (_, Self::Never) => Self::Never,
            (Self::None, Self::None) => Self::None,
        }
    }
}

/// The priors of a tile's cells, row by row from the south-west.
#[derive(Clone, Debug)]
pub struct PriorTile {
    labels: [CellLabel; TILE_CELLS as usize],
    looked: [u32; TILE_CELLS as usize],
}

impl PriorTile {
    const NOTHING: Self =
        Self { labels: [CellLabel::None; TILE_CELLS as usize], looked: [0; TILE_CELLS as usize] };

    /// A tile with the same prior in all cells.
    #[cfg(test)]
    pub(super) fn everywhere(prior: CellPrior) -> Self {
        Self {
            labels: [prior.label; TILE_CELLS as usize],
            looked: [prior.looked; TILE_CELLS as usize],
        }
    }

    /// The prior of a cell by its number; none beyond the tile.
    pub fn get(&self, cell: usize) -> CellPrior {
        let label = self.labels.get(cell).copied().unwrap_or_default();
        CellPrior { label, looked: self.looked.get(cell).copied().unwrap_or_default() }
    }
}

/// The tiles with labelled cells.
#[derive(Clone, Debug, Default)]
pub struct PriorLayer {
    tiles: BTreeMap<TileId, Box<PriorTile>>,
}

impl PriorLayer {
    /// The labels on a map with cells of this side. Parts beyond the map's range are left out.
    pub fn new(labels: &[Label], side: Millimetres) -> Self {
        let side_m = Millimetres(side.0.max(1)).metres();
        let mut layer = Self::default();
        for label in labels {
            let kind = label.forget_s.map_or(CellLabel::Never, CellLabel::After);
            let [columns, rows] = [0, 1].map(|axis| span(&label.corners_m, axis, side_m));
            let (columns, rows) = (columns.unwrap_or_default(), rows.unwrap_or_default());
            for (x, y) in rows.flat_map(|y| columns.clone().map(move |x| (x, y))) {
                let middle = [x, y].map(|cell| (f64::from(cell) + 0.5) * side_m);
                if let Some((id, cell)) = place(x, y).filter(|_| label.contains(middle)) {
                    let tile = layer.tiles.entry(id);
                    let tile = tile.or_insert_with(|| Box::new(PriorTile::NOTHING));
                    tile.labels[cell] = tile.labels[cell].sooner(kind);
                }
            }
        }
        layer
    }

    /// The priors of a tile, if any of its cells has a label.
    pub fn get(&self, id: TileId) -> Option<&PriorTile> {
        self.tiles.get(&id).map(|tile| &**tile)
    }

    /// Notes which labelled cells a robot has looked at: those along its distance vector, up to the
    /// surfaces that it saw. A robot reports nothing while it agrees with the map, so what it has looked
    /// at without a word is confirmed. Returns the tiles with such cells. Cost: some 10 microseconds.
    pub fn look(&mut self, vector: &DistanceVector, side: Millimetres) -> BTreeSet<TileId> {
        let mut seen = BTreeSet::new();
        if self.tiles.is_empty() {
            return seen;
        }
        let second = (vector.time.micros() / 1_000_000) as u32;
        let side_mm = f64::from(side.0.max(1));
        let eye = [f64::from(vector.pose.x.0), f64::from(vector.pose.y.0)];
        for (column, &distance) in vector.distances.iter().enumerate() {
            if distance == 0 {
                continue;
            }
            let turn = i32::from(vector.step).wrapping_mul(column as i32) as u16;
            let bearing = vector.pose.heading.0.wrapping_add(vector.first.0).wrapping_add(turn);
            let bearing = f64::from(bearing) * core::f64::consts::TAU / 65_536.0;
            let (sin, cos) = (libm::sin(bearing), libm::cos(bearing));
            let surface = if distance == DistanceVector::BEYOND { 0.0 } else { side_mm };
            let reach_mm = f64::from(i32::from(distance) * DistanceVector::UNIT.0);
            let steps = ((reach_mm + surface) / side_mm) as usize;
            for step in 0..=steps {
                let away = step as f64 * side_mm;
                let at = [eye[0] + away * cos, eye[1] + away * sin];
                let [x, y] = at.map(|it| (it / side_mm).floor() as i32);
                // The robot's own rays are closer than the vector's columns.
                for (x, y) in (x - 1..=x + 1).flat_map(|x| (y - 1..=y + 1).map(move |y| (x, y))) {
                    let Some((id, cell)) = place(x, y) else { continue };
                    if let Some(tile) = self.tiles.get_mut(&id)
                        && matches!(tile.labels[cell], CellLabel::After(_))
                    {
                        tile.looked[cell] = tile.looked[cell].max(second);
                        seen.insert(id);
                    }
                }
            }
        }
        seen
    }
}

/// The tile of a cell and the cell's number in it; `None` beyond the map's range.
fn place(x: i32, y: i32) -> Option<(TileId, usize)> {
    let within = |cell: i32| cell.rem_euclid(TILE_SIDE as i32) as usize;
    Some((TileId::of_cell(x, y)?, within(y) * TILE_SIDE + within(x)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::Class;
    use ubimap_protocol::{
        time::Instant,
        units::{Angle, Pose},
    };

    const SIDE: Millimetres = Millimetres(50);

    fn at(layer: &PriorLayer, x: i32, y: i32) -> CellPrior {
        let (id, cell) = place(x, y).unwrap();
        layer.get(id).map_or(CellPrior::default(), |tile| tile.get(cell))
    }

    #[test]
    fn cells_have_the_label_around_their_middle_that_is_forgotten_soonest() {
        let label = |class, x| Label::rectangle(class, [x, 0.0], [0.2, 0.2], 0.0);
        let labels =
            [label(Class::Cabinet, 0.0), label(Class::Chair, 0.1), label(Class::Door, 0.15)];
        let layer = PriorLayer::new(&labels, SIDE);
        let row: Vec<CellLabel> = (-4..8).map(|x| at(&layer, x, 0).label).collect();
        use CellLabel::{After, Never, None};
        assert_eq!(row[..4], [None, None, Never, Never]);
        assert_eq!(row[4..8], [After(120), After(60), After(60), After(60)]);
        assert_eq!(row[8..], [After(60), None, None, None]);
        assert_eq!(at(&layer, 0, 2), CellPrior::default());
        assert!(PriorLayer::new(&[], SIDE).get(TileId { x: 0, y: 0 }).is_none());
    }

    /// A robot at the origin that looks to the north, at a surface 1 m away.
    #[test]
    fn a_robot_confirms_what_it_looks_at_and_nothing_behind_it() {
        let labels = [Label::rectangle(Class::Chair, [0.0, 1.0], [1.0, 2.0], 0.0)];
        let mut layer = PriorLayer::new(&labels, SIDE);
        let pose = Pose::from_metres(0.0, 0.0, core::f64::consts::FRAC_PI_2);
        let mut vector = DistanceVector {
            time: Instant(7_900_000),
            pose,
            first: Angle(0),
            step: 100,
            distances: [50_u8, 0].into_iter().collect(),
            odometry: None,
        };
        assert_eq!(layer.look(&vector, SIDE).len(), 2, "two tiles meet at the axis");
        let looked = |layer: &PriorLayer| [2, 19, 20, 24, 30].map(|y| at(layer, 0, y).looked);
        assert_eq!(looked(&layer), [7, 7, 7, 0, 0]);
        assert_eq!(at(&layer, 5, 19).looked, 0, "beside the ray");
        // An older vector changes nothing; one beyond the range ends nowhere.
        vector.time = Instant(3_000_000);
        layer.look(&vector, SIDE);
        assert_eq!(looked(&layer), [7, 7, 7, 0, 0]);
        (vector.time, vector.distances[0]) = (Instant(9_000_000), DistanceVector::BEYOND);
        layer.look(&vector, SIDE);
        assert_eq!(looked(&layer), [9; 5]);
    }
}

//! The size of the same map updates in other formats, for comparison.
//!
//! Only the messages' own bytes are counted. The overhead of a link (middleware headers,
//! acknowledgements, retransmissions) is excluded here, but included in the robots' map traffic.

use std::{collections::BTreeMap, io::Write};

use flate2::{Compression, write::ZlibEncoder};
use serde::Serialize;
use ubimap_protocol::tile::{TILE_SIDE, Tile, TileId};

/// Bytes of a `map_msgs/OccupancyGridUpdate` without its cells, as serialised by ROS 2 (CDR): the
/// encapsulation (4), the stamp (8), the `frame_id` "map" (length, 3 letters and a NUL: 8), x, y,
/// width and height (16), and the number of cells (4).
const GRID_UPDATE_LEN: u64 = 40;
/// Bytes of an `OBSTACLE_DISTANCE` message (#330) of MAVLink 2 without a signature: header (10),
/// payload with its extension fields (167) and checksum (2). MAVLink truncates trailing zeros of
/// the payload, but its last byte, the frame of reference, is `MAV_FRAME_BODY_FRD` (12) on a robot.
const OBSTACLE_DISTANCE_LEN: u64 = 179;
/// Number of distances in an `OBSTACLE_DISTANCE` message.
const DISTANCES: u64 = 72;

/// Number of bytes that other formats need for the same scans, or for the same changes of the
/// robots' maps.
///
/// An update is everything that a robot publishes at one time; its changes are the cells whose
/// published state differs from before. Repetitions are not counted, such as a tile that is sent in
/// full after a restart of the server, or a retransmitted frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Comparison {
    /// Updates published by all robots.
    pub updates: u64,
    /// Cost as one ROS 2 `map_msgs/OccupancyGridUpdate` per update, serialised: the smallest
    /// rectangle around its changed cells, one byte per cell.
    pub occupancy_grid_update_bytes: u64,
    /// Cost as `OBSTACLE_DISTANCE` messages of MAVLink 2: every beam of the mapped scans, 72 per
    /// message, in whole centimetres.
    pub obstacle_distance_bytes: u64,
    /// Cost as one zlib stream per update (`flate2` at its best compression; the C library's
    /// streams are 1.5 % shorter on the Intel log): for every changed tile its id (4 bytes) and its
    /// two planes (256).
    pub zlib_tiles_bytes: u64,
}

impl Comparison {
    /// Adds `scans` scans of `beams` beams each.
    pub fn add_scans(&mut self, scans: u64, beams: u64) {
        self.obstacle_distance_bytes += scans * beams.div_ceil(DISTANCES) * OBSTACLE_DISTANCE_LEN;
    }

    /// Adds the figures of another robot.
    pub fn add(&mut self, other: &Self) {
        self.updates += other.updates;
        self.occupancy_grid_update_bytes += other.occupancy_grid_update_bytes;
        self.obstacle_distance_bytes += other.obstacle_distance_bytes;
        self.zlib_tiles_bytes += other.zlib_tiles_bytes;
    }
}

/// The map that one robot has published so far, and the cost of its updates in other formats.
#[derive(Clone, Debug, Default)]
pub struct Published {
    tiles: BTreeMap<TileId, Tile>,
    cost: Comparison,
}

impl Published {
    /// Adds an update with the published state of tiles. Unchanged tiles are skipped; without a
    /// changed one nothing is counted.
    pub fn update<'t>(&mut self, tiles: impl Iterator<Item = (TileId, &'t Tile)>) {
        let mut area = Rectangle::default();
        let mut planes = Vec::new();
        for (id, tile) in tiles {
            let before = self.tiles.entry(id).or_default();
            let mut after = *tile;
            // Cells that were published stay valid when the tile restarts empty.
            after.fill_unknown_from(before);
            if after == *before {
                continue;
            }
            area.take_changes(id, before, &after);
            *before = after;
            planes.extend([id.x, id.y].map(i16::to_le_bytes).as_flattened());
            planes.extend(tile.low.iter().chain(&tile.high).flat_map(|word| word.to_le_bytes()));
        }
        if planes.is_empty() {
            return;
        }
        self.cost.updates += 1;
        self.cost.occupancy_grid_update_bytes += GRID_UPDATE_LEN + area.cells();
        self.cost.zlib_tiles_bytes += zlib_len(&planes);
    }

    /// The cost of the updates so far. Scans are not included.
    pub fn cost(&self) -> Comparison {
        self.cost
    }
}

/// Length of the zlib stream of `bytes`.
fn zlib_len(bytes: &[u8]) -> u64 {
    let mut encoder = ZlibEncoder::new(Vec::new(), Compression::best());
    // Writing to memory can't fail.
    let _ = encoder.write_all(bytes);
    encoder.finish().map_or(0, |stream| stream.len() as u64)
}

/// The smallest rectangle around some cells: its corners in grid coordinates, inclusive.
#[derive(Default)]
struct Rectangle(Option<[(i32, i32); 2]>);

impl Rectangle {
    fn take_changes(&mut self, id: TileId, before: &Tile, after: &Tile) {
        let (x0, y0) = id.first_cell();
        for y in 0..TILE_SIDE {
            let (old, new) = (before.row(y), after.row(y));
            let changed = (old.low ^ new.low) | (old.high ^ new.high);
            if changed != 0 {
                let y = y0 + y as i32;
                self.take((x0 + changed.trailing_zeros() as i32, y));
                self.take((x0 + changed.ilog2() as i32, y));
            }
        }
    }

    fn take(&mut self, (x, y): (i32, i32)) {
        let [low, high] = self.0.unwrap_or([(x, y); 2]);
        self.0 = Some([(low.0.min(x), low.1.min(y)), (high.0.max(x), high.1.max(y))]);
    }

    fn cells(&self) -> u64 {
        let side = |low: i32, high: i32| u64::from(high.abs_diff(low)) + 1;
        self.0.map_or(0, |[low, high]| side(low.0, high.0) * side(low.1, high.1))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ubimap_protocol::tile::Cell;

    const WEST: TileId = TileId { x: -1, y: 0 };
    const EAST: TileId = TileId { x: 0, y: 0 };

    fn tile(cells: &[(usize, usize, Cell)]) -> Tile {
        let mut tile = Tile::UNKNOWN;
        cells.iter().for_each(|&(x, y, cell)| tile.set(x, y, cell));
        tile
    }

    #[test]
    fn an_update_is_the_rectangle_around_its_changes() {
        let mut published = Published::default();
        let west = tile(&[(30, 5, Cell::Free), (31, 5, Cell::Free)]);
        let east = tile(&[(1, 7, Cell::Occupied)]);
        published.update([(WEST, &west), (EAST, &east)].into_iter());
        // Cells -2 to 1 in x and 5 to 7 in y.
        let first = published.cost();
        assert_eq!((first.updates, first.occupancy_grid_update_bytes), (1, 40 + 4 * 3));

        published.update([(WEST, &west), (EAST, &Tile::UNKNOWN)].into_iter());
        assert_eq!(published.cost(), first, "an evicted tile that restarts empty revokes no cells");

        let east = tile(&[(1, 7, Cell::Free)]);
        published.update([(EAST, &east)].into_iter());
        assert_eq!(published.cost().occupancy_grid_update_bytes, 52 + 40 + 1);
    }

    /// Incompressible data is stored: 2 bytes of stream header, 5 of block header, 4 of checksum.
    #[test]
    fn a_stream_holds_the_ids_and_planes_of_the_changed_tiles() {
        let mut noise = 1u32;
        let mut word = || {
            noise = noise.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            noise ^ noise.rotate_left(13)
        };
        let [west, east] = [(); 2].map(|()| Tile {
            low: core::array::from_fn(|_| word()),
            high: core::array::from_fn(|_| word()),
        });
        let mut published = Published::default();
        published.update([(WEST, &west), (EAST, &Tile::UNKNOWN)].into_iter());
        assert_eq!(published.cost().zlib_tiles_bytes, 260 + 11);
        published.update([(WEST, &west), (EAST, &east)].into_iter());
        assert_eq!(published.cost().zlib_tiles_bytes, 2 * (260 + 11));
        // Empty ground compresses to almost nothing, in a single stream.
        let mut empty = Published::default();
        let free = Tile { low: [u32::MAX; TILE_SIDE], ..Tile::UNKNOWN };
        empty.update([(WEST, &free), (EAST, &free)].into_iter());
        assert!(empty.cost().zlib_tiles_bytes < 40, "{:?}", empty.cost());
    }

    #[test]
    fn a_scan_takes_one_message_per_72_beams() {
        let bytes = |beams| {
            let mut comparison = Comparison::default();
            comparison.add_scans(10, beams);
            comparison.obstacle_distance_bytes
        };
        // time_usec, distances, min and max, type, increment; increment_f, angle_offset, frame.
        let payload = 8 + 72 * 2 + 2 + 2 + 1 + 1 + 4 + 4 + 1;
        let message = 10 + payload + 2;
        assert_eq!((bytes(72), bytes(73), bytes(180)), (10 * message, 20 * message, 30 * message));
    }
}

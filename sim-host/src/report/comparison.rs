//! What the same news would have cost in formats that others use.
//!
//! These are bytes of messages alone. What a link adds to them (a middleware's headers,
//! acknowledgements, what is sent again) is left out, where the map traffic of the robots has all
//! of it.

use std::{collections::BTreeMap, io::Write};

use flate2::{Compression, write::ZlibEncoder};
use serde::Serialize;
use ubimap_protocol::tile::{TILE_SIDE, Tile, TileId};

/// Everything of a `map_msgs/OccupancyGridUpdate` but its cells, as ROS 2 serialises it (CDR): the
/// encapsulation (4), the stamp (8), the `frame_id` "map" (its length, 3 letters and a NUL: 8), x,
/// y, width and height (16), and the number of cells (4).
const GRID_UPDATE_LEN: u64 = 40;
/// An `OBSTACLE_DISTANCE` message (#330) of MAVLink 2 without a signature: header (10), payload
/// with its extension fields (167) and checksum (2). MAVLink cuts zeros off the payload's end; its
/// last byte is the frame of reference, which is `MAV_FRAME_BODY_FRD` (12) on a robot.
const OBSTACLE_DISTANCE_LEN: u64 = 179;
/// Distances in one of them.
const DISTANCES: u64 = 72;

/// The bytes that would have told the server of the same scans, or of the same changes of the
/// robots' maps.
///
/// An update is all that a robot publishes at one moment; the changes are the cells of which it
/// says something else than before. What only repeats (a tile sent whole after a reboot of the
/// server, a frame sent again) costs nothing here.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Comparison {
    /// Updates published, by all robots.
    pub updates: u64,
    /// As one `map_msgs/OccupancyGridUpdate` of ROS 2 for each update, serialised: the smallest
    /// rectangle around its changed cells, a byte a cell.
    pub occupancy_grid_update_bytes: u64,
    /// As `OBSTACLE_DISTANCE` messages of MAVLink 2: every beam of the scans that were mapped, 72
    /// in a message, in whole centimetres.
    pub obstacle_distance_bytes: u64,
    /// As one zlib stream (`flate2` at its best; the C library's are 1.5 % shorter on the Intel
    /// log) for each update: of every tile with changed cells its id (4 bytes) and its two planes
    /// (256).
    pub zlib_tiles_bytes: u64,
}

impl Comparison {
    /// So many scans of so many beams.
    pub fn add_scans(&mut self, scans: u64, beams: u64) {
        self.obstacle_distance_bytes += scans * beams.div_ceil(DISTANCES) * OBSTACLE_DISTANCE_LEN;
    }

    /// The figures of another robot.
    pub fn add(&mut self, other: &Self) {
        self.updates += other.updates;
        self.occupancy_grid_update_bytes += other.occupancy_grid_update_bytes;
        self.obstacle_distance_bytes += other.obstacle_distance_bytes;
        self.zlib_tiles_bytes += other.zlib_tiles_bytes;
    }
}

/// What one robot has said of its map so far, and what that would have cost.
#[derive(Clone, Debug, Default)]
pub struct Published {
    tiles: BTreeMap<TileId, Tile>,
    cost: Comparison,
}

impl Published {
    /// The tiles as the robot has published them by now. Those that say nothing new are passed
    /// over.
    pub fn update<'t>(&mut self, tiles: impl Iterator<Item = (TileId, &'t Tile)>) {
        let mut area = Rectangle::default();
        let mut planes = Vec::new();
        for (id, tile) in tiles {
            let before = self.tiles.entry(id).or_default();
            let mut after = *tile;
            // What a robot has said holds until it says otherwise.
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

    /// What it would have cost; of the scans nothing is known here.
    pub fn cost(&self) -> Comparison {
        self.cost
    }
}

/// Bytes of a zlib stream of these.
fn zlib_len(bytes: &[u8]) -> u64 {
    let mut encoder = ZlibEncoder::new(Vec::new(), Compression::best());
    // Nothing can fail in memory.
    let _ = encoder.write_all(bytes);
    encoder.finish().map_or(0, |stream| stream.len() as u64)
}

/// The smallest rectangle around some cells, by grid coordinates, corners included.
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
    fn an_update_is_the_rectangle_around_what_has_changed() {
        let mut published = Published::default();
        let west = tile(&[(30, 5, Cell::Free), (31, 5, Cell::Free)]);
        let east = tile(&[(1, 7, Cell::Occupied)]);
        published.update([(WEST, &west), (EAST, &east)].into_iter());
        // Cells -2 to 1 by 5 to 7.
        let first = published.cost();
        assert_eq!((first.updates, first.occupancy_grid_update_bytes), (1, 40 + 4 * 3));

        published.update([(WEST, &west), (EAST, &Tile::UNKNOWN)].into_iter());
        assert_eq!(published.cost(), first, "an evicted tile that begins anew takes nothing back");

        let east = tile(&[(1, 7, Cell::Free)]);
        published.update([(EAST, &east)].into_iter());
        assert_eq!(published.cost().occupancy_grid_update_bytes, 52 + 40 + 1);
    }

    /// What cannot be compressed is stored: 2 bytes before the block, its head of 5 and 4 behind it.
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
        // Of empty ground next to nothing is left, and that in one stream.
        let mut empty = Published::default();
        let free = Tile { low: [u32::MAX; TILE_SIDE], ..Tile::UNKNOWN };
        empty.update([(WEST, &free), (EAST, &free)].into_iter());
        assert!(empty.cost().zlib_tiles_bytes < 40, "{:?}", empty.cost());
    }

    #[test]
    fn a_scan_is_as_many_messages_as_its_beams_need() {
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

//! Masks for the other robots, which are not mapped (Ahmed 2.2, the "window around other robots").
//!
//! Ahmed leaves out a square around each robot. But robots are not square: the ends of Ahmed's
//! robots appear in his maps, and a square that fits any heading hides walls beside a long robot.
//! Here the mask is the robot's footprint at its heading, with a margin for all uncertainties. If
//! the heading is unknown, the margin grows until the mask covers the square.

use heapless::Vec;
use libm::sqrtf;
use ubimap_protocol::{
    message::{MAX_PEERS, Peer, Peers},
    tile::{TILE_SIDE, TileId},
    time::{Duration, Instant},
    units::{Angle, Millimetres, Pose},
};

use super::scan_window::below;
use crate::{
    locate::Variances,
    timing::PEER_LOST,
    trigonometry::{radians, sin_cos},
};

/// The shape of the mask around another robot.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum PeerMask {
    /// The other robot's footprint, at its heading.
    #[default]
    Footprint,
    /// A square along the axes of `map` that contains the other robot's footprint at any heading
    /// (Ahmed 2.2).
    Square,
    /// None: other robots are drawn like everything else, for comparison.
    None,
}

/// Maximum speed and turn rate assumed since the last report, in mm/s and rad/s.
const SPEED: f32 = 500.0;
const TURN: f32 = 1.0;
/// Distance driven at `SPEED` after which the robot's position counts as unknown, in mm.
const MAX_WAY: u32 = 1_500;
/// Variance of a position measured by cameras, in mm^2 (a deviation of 30 mm), and twice the
/// deviation of a measured heading, in rad.
const SEEN_POSITION: f32 = 900.0;
const SEEN_TURN: f32 = 0.07;
/// The uncertainty of an unknown heading, in rad: larger than any angle.
const ANY_TURN: f32 = 10.0;
/// Variance of a reading, relative to its square: a deviation of 1/64.
const READING: f32 = 1.0 / 4_096.0;

/// The scan in which peers are masked.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ScanContext {
    /// `base_link` in `map` when the scan was taken.
    pub(crate) pose: Pose,
    /// When the scan was taken, by the server's clock.
    pub(crate) moment: Instant,
    /// Maximum range that is mapped, in millimetres.
    pub(crate) range: u16,
    /// The side of a cell.
    pub(crate) resolution: Millimetres,
    /// The shape of the masks.
    pub(crate) mask: PeerMask,
}

/// The masks of the other robots during a scan.
#[derive(Debug)]
pub(crate) struct PeerMasks {
    masks: Vec<Mask, MAX_PEERS>,
    /// Side of a cell, in mm.
    side: i32,
}

impl PeerMasks {
    /// The masks of the robots that may be in view. `unsure` holds the variances of the scan's
    /// pose.
    pub(crate) fn new(peers: Option<&Peers>, scan: &ScanContext, unsure: Variances) -> Self {
        let mut near = Self { masks: Vec::new(), side: scan.resolution.0.clamp(1, 1 << 16) };
        let peers = peers.filter(|_| scan.mask != PeerMask::None);
        for (peers, peer) in
            peers.into_iter().flat_map(|it| it.peers.iter().map(move |peer| (it, peer)))
        {
            let reach = u32::from(scan.range) + u32::from(peer.half_length);
            let reach = reach + u32::from(peer.half_width) + MAX_WAY;
            let off = |here: Millimetres, there: Millimetres| (there - here).0.unsigned_abs();
            let off = off(scan.pose.x, peer.pose.x).max(off(scan.pose.y, peer.pose.y));
            let seen = peers.time - Duration(u64::from(u32::from(peer.age) * 10_000));
            let age = scan.moment.0.abs_diff(seen.0);
            if off <= reach && age <= PEER_LOST.0 {
                // The capacity covers all peers.
                let _ = near.masks.push(Mask::new(peer, age as u32, scan, unsure));
            }
        }
        near
    }

    /// The masked cells of a tile, a word per row: those whose centres are inside a mask. `None` if
    /// no robot is near. About 1,000 instructions for each robot that is near.
    pub(crate) fn cells(&self, id: TileId) -> Option<[u32; TILE_SIDE]> {
        let mut cells = None;
        for mask in &self.masks {
            let (x, y) = id.first_cell();
            // From the mask's centre to the centre of the tile's first cell, along one axis.
            let from = |cell: i32, centre: Millimetres| {
                let middle = cell.wrapping_mul(self.side).wrapping_add(self.side / 2);
                (Millimetres(middle) - centre).0 as f32
            };
            let (x, y) = (from(x, mask.centre.0), from(y, mask.centre.1));
            let last = (self.side * (TILE_SIDE as i32 - 1)) as f32;
            let reach = mask.length + mask.width;
            let near = |first: f32| first < reach && first + last > -reach;
            if near(x) && near(y) {
                mask.mark(x, y, self.side as f32, cells.get_or_insert([0; TILE_SIDE]));
            }
        }
        cells
    }
}

/// The mask of one robot: a rectangle.
#[derive(Clone, Copy, Debug)]
struct Mask {
    centre: (Millimetres, Millimetres),
    /// Cosine and sine of the robot's heading.
    turn: (f32, f32),
    /// Half the rectangle's length and half its width, in mm.
    length: f32,
    width: f32,
}

impl Mask {
    /// The mask of `peer`, whose pose is `age` microseconds older or newer than the scan. `unsure`
    /// holds the variances of the scan's pose.
    fn new(peer: &Peer, age: u32, scan: &ScanContext, unsure: Variances) -> Self {
        let seconds = age as f32 * 1.0e-6;
        let off = |here: Millimetres, there: Millimetres| (there - here).0 as f32;
        let (dx, dy) = (off(scan.pose.x, peer.pose.x), off(scan.pose.y, peer.pose.y));
        let variance = SEEN_POSITION
            + unsure.position / 2.0
            + (unsure.heading + READING) * (dx * dx + dy * dy);
        // Two standard deviations, plus the half diagonal of a cell: a hit at its corner marks the
        // whole cell.
        let room = 2.0 * sqrtf(variance) + SPEED * seconds + scan.resolution.0 as f32 * 0.71;

        let (length, width) = (f32::from(peer.half_length), f32::from(peer.half_width));
        let all_round = sqrtf(length * length + width * width);
        let (heading, turned) = match scan.mask {
            PeerMask::Footprint => (peer.pose.heading, SEEN_TURN + TURN * seconds),
            PeerMask::Square | PeerMask::None => (Angle(0), ANY_TURN),
        };
        let (sin, cos) = sin_cos(radians(heading));
        Self {
            centre: (peer.pose.x, peer.pose.y),
            turn: (away_from_zero(cos), away_from_zero(sin)),
            length: least(length + width * turned, all_round) + room,
            width: least(width + length * turned, all_round) + room,
        }
    }

    /// Marks the cells of a tile that are inside the rectangle. The centre of the tile's first cell
    /// is at (x, y) relative to the rectangle's centre.
    fn mark(&self, x: f32, y: f32, side: f32, cells: &mut [u32; TILE_SIDE]) {
        let (cos, sin) = self.turn;
        // A row of cells crosses both pairs of the rectangle's sides. For each pair the covered
        // interval has a constant half-width, and its centre moves by a constant slope from row to
        // row.
        let (ends, ends_slope) = (self.length / cos.abs(), -sin / cos);
        let (flanks, flanks_slope) = (self.width / sin.abs(), cos / sin);
        let mut y = y;
        for row in cells {
            let (a, b) = (ends_slope * y, flanks_slope * y);
            let low = -least(ends - a, flanks - b);
            let high = least(ends + a, flanks + b);
            *row |= below(column(high, x, side)) & !below(column(low, x, side));
            y += side;
        }
    }
}

/// Replaces values near zero, so that they have an inverse. An angle changes by at most a quarter
/// of a degree.
fn away_from_zero(value: f32) -> f32 {
    const MIN: f32 = 0.002;
    if value.abs() < MIN { MIN } else { value }
}

/// The minimum of two values, neither of which is NaN.
fn least(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

/// The first column whose centre is beyond the coordinate `at`, 0 to 32.
fn column(at: f32, first: f32, side: f32) -> u32 {
    // The cast rounds positive values down, and saturates.
    let cells = ((at - first) / side + 64.0) as i32;
    cells.saturating_sub(63).clamp(0, TILE_SIDE as i32) as u32
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use ubimap_protocol::units::RobotId;

    const SIDE: i32 = 50;

    fn at(x: i32, y: i32, heading: u16) -> Pose {
        Pose { x: Millimetres(x), y: Millimetres(y), heading: Angle(heading) }
    }

    fn peer(pose: Pose, half_length: u16, half_width: u16) -> Peer {
        Peer { robot: RobotId(2), pose, age: 0, half_length, half_width }
    }

    fn scan(mask: PeerMask, moment: u64) -> ScanContext {
        let resolution = Millimetres(SIDE);
        ScanContext {
            pose: Pose::default(),
            moment: Instant(moment),
            range: 4_000,
            resolution,
            mask,
        }
    }

    fn masks(peer: Peer, scan: &ScanContext) -> PeerMasks {
        let peers = Peers { time: Instant(10_000_000), peers: [peer].into_iter().collect() };
        PeerMasks::new(Some(&peers), scan, Variances::default())
    }

    /// Number of masked cells in the tiles around the origin.
    fn count(masks: &PeerMasks) -> u32 {
        let tiles = (-4..4i16).flat_map(|y| (-4..4i16).map(move |x| TileId { x, y }));
        tiles.filter_map(|id| masks.cells(id)).flatten().map(u32::count_ones).sum()
    }

    proptest! {
        /// Checks each cell, except those whose centres lie on a side.
        #[test]
        fn a_mask_is_the_cells_inside_its_rectangle(
            x in -3_000..3_000i32, y in -3_000..3_000i32, heading: u16,
            half_length in 0..900u16, half_width in 0..900u16,
        ) {
            let scan = scan(PeerMask::Footprint, 10_000_000);
            let masks = masks(peer(at(x, y, heading), half_length, half_width), &scan);
            let [mask] = masks.masks[..] else { panic!() };
            let (sin, cos) = libm::sincos(Angle(heading).radians());
            for id in (-3..3i16).flat_map(|y| (-3..3i16).map(move |x| TileId { x, y })) {
                let cells = masks.cells(id).unwrap_or_default();
                for (row, cells) in cells.into_iter().enumerate() {
                    for column in 0..TILE_SIDE {
                        let (first_x, first_y) = id.first_cell();
                        let middle = |first: i32, cell: usize| {
                            f64::from((first + cell as i32) * SIDE + SIDE / 2)
                        };
                        let dx = middle(first_x, column) - f64::from(x);
                        let dy = middle(first_y, row) - f64::from(y);
                        let along = (dx * cos + dy * sin).abs() - f64::from(mask.length);
                        let across = (dy * cos - dx * sin).abs() - f64::from(mask.width);
                        let off = along.max(across);
                        // A mask that is nearly parallel to an axis is rotated by up to a quarter
                        // of a degree.
                        let slack = 1.0 + 0.005 * dx.hypot(dy);
                        let is_in = cells >> column & 1 != 0;
                        prop_assert!(off.abs() < slack || is_in == (off < 0.0), "{off} at {dx}, {dy}");
                    }
                }
            }
        }
    }

    #[test]
    fn a_footprint_is_smaller_than_the_square_and_grows_with_age() {
        let body = peer(at(1_500, 300, 5_000), 600, 150);
        let count = |mask, moment| count(&masks(body, &scan(mask, moment)));
        let (square, footprint) =
            (count(PeerMask::Square, 10_000_000), count(PeerMask::Footprint, 10_000_000));
        assert!(2 * footprint < square, "{footprint} of {square}");
        // The mask grows with age, up to the square plus the distance possibly driven.
        let mut last = footprint;
        for age in [100_000, 500_000, 1_000_000, 3_000_000] {
            let older = count(PeerMask::Footprint, 10_000_000 + age);
            assert!(last < older && older <= count(PeerMask::Square, 10_000_000 + age));
            assert_eq!(
                older,
                count(PeerMask::Footprint, 10_000_000 - age),
                "the same for an earlier scan"
            );
            last = older;
        }
        assert_eq!(count(PeerMask::Footprint, 13_000_001), 0, "it may be anywhere");
    }

    #[test]
    fn robots_out_of_range_have_no_mask() {
        let peers = |x| Peers {
            time: Instant(0),
            peers: [peer(at(x, 0, 0), 300, 200)].into_iter().collect(),
        };
        let unsure = Variances::default();
        for x in [6_001, i32::MAX, i32::MIN] {
            let scan = scan(PeerMask::Footprint, 0);
            assert!(PeerMasks::new(Some(&peers(x)), &scan, unsure).masks.is_empty());
        }
        assert!(PeerMasks::new(None, &scan(PeerMask::Footprint, 0), unsure).masks.is_empty());
    }

    #[test]
    fn an_uncertain_pose_enlarges_the_masks() {
        let room = |variances: Variances| {
            let peers = Peers {
                time: Instant(0),
                peers: [peer(at(2_000, 0, 0), 300, 200)].into_iter().collect(),
            };
            let masks = PeerMasks::new(Some(&peers), &scan(PeerMask::Square, 0), variances);
            masks.masks[0].width
        };
        let sure = room(Variances::default());
        // Deviations: 30 mm of the other robot's position and 31 mm of the reading; `more` adds the
        // uncertainty of the pose, of which one degree is 35 mm at 2 m.
        let expected = |more: f32| 360.56 + 35.5 + 2.0 * (900.0f32 + 976.6 + more).sqrt();
        assert!((sure - expected(0.0)).abs() < 0.1, "{sure}");
        let unsure = room(Variances { position: 5_000.0, heading: 0.000_304_6 });
        assert!((unsure - expected(2_500.0 + 1_218.5)).abs() < 0.1, "{unsure}");
    }
}

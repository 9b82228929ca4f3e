//! Looking around: directions in which blind ground is in sight, and how far to turn to see it all.

use core::f32::consts::TAU;

use ubimap_protocol::{
    tile::{Row, TILE_SIDE},
    units::{Angle, Millimetres, Pose},
};

use super::planning_window::GroundRow;
use crate::trigonometry::{angle, radians, sin_cos};

/// Number of rays.
const RAYS: u32 = 32;
/// Minimum number of consecutive blind cells that count as blind ground; fewer are noise.
const MIN_CELLS: u32 = 3;
/// Maximum side of a cell for which places in it are computed, in millimetres.
const MAX_CELL: i32 = 32_767;
/// Usable part of half the field of view: closer to the edge, ground may be missed.
const SURE: f32 = 0.9;

/// What to look for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gaze {
    /// Half of the sensor's field of view, in radians.
    pub half_view: f32,
    /// Maximum distance of blind ground, in millimetres.
    pub reach: u16,
    /// The robot's radius, in millimetres: the ground below it is ignored.
    pub radius: u16,
}

impl Default for Gaze {
    /// A sensor with a view of 86 degrees, on a robot 30 cm wide.
    fn default() -> Self {
        Self { half_view: 0.75, reach: 2_500, radius: 150 }
    }
}

impl Gaze {
    /// The rays from a pose that meet blind ground behind free ground, one bit each,
    /// counter-clockwise from `map`'s x axis. Up to a thousand map lookups.
    fn blind_rays(
        &self,
        pose: Pose,
        resolution: Millimetres,
        explore_covered: bool,
        ground: &impl Fn(i32, i32) -> GroundRow,
    ) -> u32 {
        let cell = resolution.0.max(1);
        let steps = |millimetres: u16| i32::from(millimetres) / cell;
        // The robot's cell, and its place in it, in 2^-16 cells.
        let part = |from: Millimetres| (from.0.rem_euclid(cell).min(MAX_CELL) << 16) / cell;
        let [(cell_x, part_x), (cell_y, part_y)] =
            [pose.x, pose.y].map(|from| (from.0.div_euclid(cell), part(from)));
        let mut rays = 0;
        for ray in 0..RAYS {
            let (sin, cos) = sin_cos(ray as f32 * (TAU / RAYS as f32));
            // A step is one cell long.
            let [step_x, step_y] = [cos, sin].map(|it| (it * 65_536.0) as i32);
            let mut blind = 0;
            // The last row read, which adjacent cells often share.
            let (mut place, mut read) = ((i32::MIN, i32::MIN), GroundRow::default());
            for step in steps(self.radius) + 1..=steps(self.reach) {
                let along = |cell: i32, part: i32, along: i32| {
                    cell.wrapping_add(part.wrapping_add(along.wrapping_mul(step)) >> 16)
                };
                let x = along(cell_x, part_x, step_x);
                let y = along(cell_y, part_y, step_y);
                let side = TILE_SIDE as i32;
                if place != (x.div_euclid(side), y) {
                    place = (x.div_euclid(side), y);
                    read = ground(place.0, place.1);
                }
                let GroundRow { cells: Row { low, high }, covered } = read;
                let has = |row: u32| row >> x.rem_euclid(side) & 1 != 0;
                if has(high) {
                    break;
                }
                let is_blind = !has(low) && (explore_covered || !has(covered));
                blind = if is_blind { blind + 1 } else { 0 };
                if blind == MIN_CELLS {
                    rays |= 1 << ray;
                    break;
                }
            }
        }
        rays
    }
}

/// State of looking around on the spot.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct LookAround {
    /// First and latest heading; the angle turned since the first, with its minimum and maximum, in
    /// radians to the left.
    first: Angle,
    last: Angle,
    turned: f32,
    least: f32,
    most: f32,
    /// The rays that meet blind ground; none before the first look.
    rays: u32,
}

impl LookAround {
    /// Starts at this heading.
    pub(super) fn new(heading: Angle) -> Self {
        let (turned, least, most) = (0.0, 0.0, 0.0);
        Self { first: heading, last: heading, turned, least, most, rays: 0 }
    }

    /// Updates the rays from the map.
    pub(super) fn look(
        &mut self,
        gaze: &Gaze,
        pose: Pose,
        resolution: Millimetres,
        explore_covered: bool,
        ground: &impl Fn(i32, i32) -> GroundRow,
    ) {
        self.rays = gaze.blind_rays(pose, resolution, explore_covered, ground);
    }

    /// The direction to turn in (`true`: left) so that all remaining rays are seen with the least
    /// turning, on one side or first on one and then on the other; `None` if no rays remain.
    pub(super) fn turn(&mut self, heading: Angle, half_view: f32) -> Option<bool> {
        self.turned += radians(heading - self.last);
        self.last = heading;
        (self.least, self.most) = (self.least.min(self.turned), self.most.max(self.turned));
        let sure = half_view * SURE;
        let (right, left) = (self.least - sure, self.most + sure);
        let gap = TAU - (left - right);
        // The angles from the current heading to the farthest headings so far on either side.
        let (to_left, to_right) = (self.most - self.turned, self.turned - self.least);
        let (mut best, mut is_left) = (f32::MAX, None);
        // Each split of the unseen rays between both sides is tried: turning left sees the rays up
        // to a certain one, turning right the others.
        let mut turn = |on_the_left: Option<f32>, on_the_right: Option<f32>| {
            let left = on_the_left.map_or(0.0, |beyond| to_left + beyond);
            let right = on_the_right.map_or(0.0, |beyond| to_right + gap - beyond);
            let all = left + right + left.min(right);
            if all < best {
                (best, is_left) = (all, Some(left > 0.0 && (right == 0.0 || left <= right)));
            }
        };
        let mut last = None;
        let edge = (self.first + angle(left)).0 >> 11;
        for ray in (1..=RAYS).map(|ray| (u32::from(edge) + ray) % RAYS) {
            let bearing = Angle((ray << 11) as u16) - self.first;
            // At most two turns are taken off; `fmodf` would cost 1 kB of flash for its division.
            let mut beyond = radians(bearing) - left + 2.0 * TAU;
            while beyond >= TAU {
                beyond -= TAU;
            }
            if self.rays >> ray & 1 != 0 && beyond < gap {
                turn(last, Some(beyond));
                last = Some(beyond);
            }
        }
        if last.is_some() {
            turn(last, None);
        }
        is_left
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn turned(known: impl FnMut(f64, f64) -> bool, occupied: impl Fn(f64, f64) -> bool) -> f64 {
        sweep(known, occupied).0
    }

    /// Turns as `LookAround::turn` says until no rays remain. Returns the final angle to the left
    /// and the total angle turned, in degrees.
    fn sweep(
        mut known: impl FnMut(f64, f64) -> bool,
        occupied: impl Fn(f64, f64) -> bool,
    ) -> (f64, f64) {
        let gaze = Gaze::default();
        let mut look = LookAround::new(Angle(0));
        let (mut degrees, mut all) = (0.0, 0.0);
        let known = core::cell::RefCell::new(&mut known);
        loop {
            let heading = Angle::from_degrees(degrees);
            let pose = Pose { heading, ..Pose::default() };
            look.look(&gaze, pose, Millimetres(50), false, &|column, row| {
                let mut cells = Row::default();
                for bit in 0..32 {
                    let middle = |cell: i32| (f64::from(cell) + 0.5) * 0.05;
                    let (x, y) = (middle(column * 32 + bit), middle(row));
                    if occupied(x, y) {
                        cells.high |= 1 << bit;
                    } else if (known.borrow_mut())(x, y) {
                        cells.low |= 1 << bit;
                    }
                }
                GroundRow { cells, covered: 0 }
            });
            match look.turn(heading, gaze.half_view) {
                Some(left) => degrees += if left { 5.0 } else { -5.0 },
                None => return (degrees, all),
            }
            all += 5.0;
            assert!(all < 360.0);
        }
    }

    #[test]
    fn it_turns_no_further_than_there_is_blind_ground() {
        let nowhere = |_, _| false;
        assert_eq!(turned(|_, _| true, nowhere), 0.0, "all is known");
        assert_eq!(turned(|x, y| x.hypot(y) < 2.6, nowhere), 0.0, "or far away");
        // The sensor already looks ahead.
        assert_eq!(turned(|x, y| x < 1.0 || y.abs() > 0.5, nowhere), 0.0);
        let left = turned(|_, y| y < 1.0, nowhere);
        assert!((85.0..=130.0).contains(&left), "{left}");
        let right = turned(|_, y| y > -1.0, nowhere);
        assert!((-130.0..=-85.0).contains(&right), "{right}");
        let round = turned(|x, y| x.hypot(y) < 1.0, nowhere);
        assert!((270.0..300.0).contains(&round.abs()), "{round}");
        // A small area on either side: it turns to the nearer one first.
        let towards = |x: f64, y: f64, degrees: f64| {
            (libm::atan2(y, x).to_degrees() - degrees).abs() < 12.0 && x.hypot(y) > 1.0
        };
        for side in [1.0, -1.0] {
            let (end, all) =
                sweep(|x, y| !towards(x, y, side * 100.0) && !towards(x, y, side * -60.0), nowhere);
            assert!((60.0..90.0).contains(&(side * end)), "{end}");
            assert!((110.0..160.0).contains(&all), "{all}");
        }
        // Ground behind a wall is out of sight, and a speck is noise.
        assert_eq!(turned(|_, y| y < 1.0, |_, y| y > 0.9 && y < 1.0), 0.0);
        assert_eq!(turned(|x, y| !(y > 1.0 && y < 1.1 && x.abs() < 0.05), nowhere), 0.0);
    }
}

//! Boundary following by the distance vector alone, without a map (Ahmed 3: "all the robots were
//! programmed to follow the boundaries"), switched by the ground clearance signal (2.1).

use core::f32::consts::TAU;

use super::follow::DriveCommand;
use crate::sense::{COLUMNS, GroundClearance};

/// Drives with a boundary on one side.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BoundaryFollower {
    /// Decides whether the floor ahead is free.
    pub clearance: GroundClearance,
    /// Whether the boundary is on the left.
    pub is_left: bool,
    /// Free floor to keep in the outermost columns on the boundary's side, in pixels. The paper
    /// gives no value.
    pub aside: u8,
    /// Number of outermost columns evaluated on the boundary's side.
    pub columns: usize,
    /// Speed, in mm/s.
    pub speed: i16,
    /// Maximum turn rate, in mrad/s.
    pub turn: i16,
    /// Distance from the robot's centre to where the outermost columns see the boundary, along its way,
    /// in mm: a boundary that has ended there is not passed yet, and the robot drives on that far
    /// before it turns towards it.
    pub reach: i16,
    /// Distance driven since the boundary was last in sight, in mm.
    passed: f32,
    /// Angle turned so far in search of a boundary that is out of sight, in radians. After a full
    /// turn there is none nearby.
    lost: f32,
}

impl Default for BoundaryFollower {
    /// Keeps the boundary on the right, and evaluates one eighth of the image there.
    fn default() -> Self {
        let clearance = GroundClearance::default();
        let columns = COLUMNS / 8;
        Self {
            clearance,
            is_left: false,
            aside: 70,
            columns,
            speed: 150,
            turn: 600,
            reach: 250,
            passed: 0.0,
            lost: TAU,
        }
    }
}

impl BoundaryFollower {
    /// The turn rate away from the boundary, in mrad/s.
    pub(super) fn away(&self) -> i16 {
        if self.is_left { self.turn.saturating_neg() } else { self.turn }
    }

    /// The next command, from the [`distances`](crate::sense::Floor::distances) of an image,
    /// leftmost column first; `elapsed` is the time since the last call, in seconds. If the floor
    /// ahead is not free, the robot turns away from the boundary on the spot. Otherwise it drives:
    /// towards a boundary that is too far away, and straight on if there is none.
    pub fn step(&mut self, distances: &[u8; COLUMNS], elapsed: f32) -> DriveCommand {
        let away = self.away();
        if !self.clearance.is_clear(distances) {
            (self.passed, self.lost) = (0.0, 0.0);
            return DriveCommand { speed: 0, turn: away };
        }
        let left = distances.iter().take(self.columns).min();
        let right = distances.iter().rev().take(self.columns).min();
        let nearest = if self.is_left { left } else { right };
        let nearest = nearest.copied().unwrap_or(u8::MAX);
        // Turns at the full rate when the distance is off by a quarter of `aside`.
        let off = i32::from(self.aside) - i32::from(nearest);
        let full = i32::from(self.aside / 4).max(1);
        if off > -full {
            (self.passed, self.lost) = (0.0, 0.0);
        } else if self.passed < f32::from(self.reach) && self.lost < TAU {
            self.passed += f32::from(self.speed) * elapsed;
            return DriveCommand { speed: self.speed, turn: 0 };
        } else if self.lost < TAU {
            self.lost += f32::from(self.turn).abs() * 1.0e-3 * elapsed;
        } else {
            return DriveCommand { speed: self.speed, turn: 0 };
        }
        let turn = i32::from(away) * off.min(full).max(-full) / full;
        DriveCommand { speed: self.speed, turn: turn as i16 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_turns_away_from_obstacles_and_keeps_its_distance_to_the_boundary() {
        for is_left in [false, true] {
            let mut follower =
                BoundaryFollower { is_left, reach: 15, ..BoundaryFollower::default() };
            let sign = if is_left { -1 } else { 1 };
            let mut distances = [124; COLUMNS];
            let mut with = |side: u8, ahead: u8, distances: &mut [u8; COLUMNS]| {
                distances.fill(124);
                let columns = if is_left { 0..40 } else { 280..320 };
                distances[columns].fill(side);
                distances[150] = ahead;
                follower.step(distances, 0.05)
            };
            let straight = DriveCommand { speed: 150, turn: 0 };
            assert_eq!(with(124, 124, &mut distances), straight, "no boundary yet");
            let stand = with(70, 61, &mut distances);
            assert_eq!(stand, DriveCommand { speed: 0, turn: 600 * sign });
            let along = with(70, 100, &mut distances);
            assert_eq!(along, straight);
            assert!(with(60, 100, &mut distances).turn * sign > 0, "too near: away");
            assert!(with(80, 100, &mut distances).turn * sign < 0, "too far: towards");
            // It passes the end of the boundary: 15 mm are two steps at 150 mm/s.
            assert_eq!(with(124, 100, &mut distances), straight);
            assert_eq!(with(124, 100, &mut distances), straight);
            assert_eq!(with(124, 100, &mut distances).turn, -600 * sign);
            // A full turn, at 0.6 rad/s.
            let steps = (0..300).take_while(|_| with(124, 100, &mut distances) != straight).count();
            assert!((205..=212).contains(&steps), "{steps}");
            assert_eq!(with(0, 100, &mut distances).turn, 600 * sign);
        }
    }
}

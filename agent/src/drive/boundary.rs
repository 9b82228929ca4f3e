//! Following a boundary by the distance vector alone, without a map (Ahmed 3: "all the robots were
//! programmed to follow the boundaries"), on and off by the ground clearance signal (2.1).

use super::follow::DriveCommand;
use crate::sense::{COLUMNS, GroundClearance};

/// Drives with a boundary on one side.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BoundaryFollower {
    /// What free floor ahead is enough.
    pub clearance: GroundClearance,
    /// Whether the boundary is on the left.
    pub is_left: bool,
    /// Free floor that is kept in the outermost columns of that side, in pixels. The paper does
    /// not say.
    pub aside: u8,
    /// Columns at that side that are looked at.
    pub columns: usize,
    /// The speed, in millimetres a second.
    pub speed: i16,
    /// The fastest turn, in milliradians a second.
    pub turn: i16,
}

impl Default for BoundaryFollower {
    /// A boundary on the right, an eighth of the image.
    fn default() -> Self {
        let clearance = GroundClearance::default();
        Self { clearance, is_left: false, aside: 70, columns: COLUMNS / 8, speed: 150, turn: 600 }
    }
}

impl BoundaryFollower {
    /// The next command, by the [`distances`](crate::sense::Floor::distances) of an image, the
    /// leftmost column first. Without ground clearance it turns away from the boundary on the
    /// spot; with it, it drives, towards the boundary if that is further than it should be.
    pub fn step(&self, distances: &[u8; COLUMNS]) -> DriveCommand {
        let away = if self.is_left { self.turn.saturating_neg() } else { self.turn };
        if !self.clearance.is_clear(distances) {
            return DriveCommand { speed: 0, turn: away };
        }
        let left = distances.iter().take(self.columns).min();
        let right = distances.iter().rev().take(self.columns).min();
        let nearest = if self.is_left { left } else { right };
        let nearest = nearest.copied().unwrap_or(u8::MAX);
        // The full turn at a quarter of the wanted distance off.
        let off = i32::from(self.aside) - i32::from(nearest);
        let full = i32::from(self.aside / 4).max(1);
        let turn = i32::from(away) * off.min(full).max(-full) / full;
        DriveCommand { speed: self.speed, turn: turn as i16 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_turns_away_from_what_is_ahead_and_keeps_what_is_aside() {
        for is_left in [false, true] {
            let follower = BoundaryFollower { is_left, ..BoundaryFollower::default() };
            let sign = if is_left { -1 } else { 1 };
            let mut distances = [124; COLUMNS];
            let with = |side: u8, ahead: u8, distances: &mut [u8; COLUMNS]| {
                distances.fill(124);
                let columns = if is_left { 0..40 } else { 280..320 };
                distances[columns].fill(side);
                distances[150] = ahead;
                follower.step(distances)
            };
            let stand = with(70, 61, &mut distances);
            assert_eq!(stand, DriveCommand { speed: 0, turn: 600 * sign });
            let along = with(70, 100, &mut distances);
            assert_eq!(along, DriveCommand { speed: 150, turn: 0 });
            assert!(with(60, 100, &mut distances).turn * sign > 0, "too near: away");
            assert!(with(80, 100, &mut distances).turn * sign < 0, "too far: towards");
            assert_eq!(with(124, 100, &mut distances).turn, -600 * sign);
            assert_eq!(with(0, 100, &mut distances).turn, 600 * sign);
        }
    }
}

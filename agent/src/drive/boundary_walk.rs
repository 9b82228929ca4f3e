//! Boundary following from stop to stop (Ahmed 3): the robot looks, moves along the boundary, and
//! waits until the ceiling cameras have measured where it stands.

use ubimap_protocol::{
    time::{Duration, Instant},
    units::Pose,
};

use super::{boundary::BoundaryFollower, follow::DriveCommand, stops::Stops};
use crate::{map::Gate, sense::COLUMNS};

/// Age of a picture beyond which the robot stands, as it no longer knows what is ahead.
const BLIND: Duration = Duration::from_millis(500);

/// Driving time without progress after which the robot counts as blocked by something that its picture
/// does not show, and for which it then turns away.
const STALLED: Duration = Duration::from_millis(800);
const ESCAPE: Duration = Duration::from_millis(1_200);

/// A [`BoundaryFollower`] that stops for each picture to be mapped.
#[derive(Clone, Copy, Debug)]
pub struct BoundaryWalk {
    follower: BoundaryFollower,
    stops: Stops,
    /// How far a move goes.
    gate: Gate,
    /// The follower's newest command, and the time of its picture.
    newest: Option<(Instant, DriveCommand)>,
    must_stand: bool,
    /// The newest odometry, and its time.
    odometry: Option<(Instant, Pose)>,
    /// Driving time since the newest picture, and since the odometry last changed.
    driven: Duration,
    stalled: Duration,
    /// Until when the robot turns away.
    escapes: Option<Instant>,
}

impl BoundaryWalk {
    /// Moves that open `gate`, along a boundary; the robot stands at first.
    pub fn new(follower: BoundaryFollower, gate: Gate) -> Self {
        Self {
            follower,
            stops: Stops::default(),
            gate,
            newest: None,
            must_stand: true,
            odometry: None,
            driven: Duration(0),
            stalled: Duration(0),
            escapes: None,
        }
    }

    /// Processes the distance vector of a picture taken at `taken`; `fix` is the time of the newest
    /// fix. Returns whether the picture is to be mapped: only if the robot has been localised since
    /// it stopped.
    pub fn look(
        &mut self,
        distances: &[u8; COLUMNS],
        taken: Instant,
        fix: Option<Instant>,
    ) -> bool {
        let elapsed = core::mem::replace(&mut self.driven, Duration(0));
        let command = self.follower.step(distances, elapsed.micros() as f32 * 1.0e-6);
        self.newest = Some((taken, command));
        self.stops.takes(taken, fix)
    }

    /// Decides between driving and standing. Call it whenever odometry (`base_link` in `odom`) was
    /// read.
    pub fn odometry(&mut self, odometry: Pose, now: Instant) {
        if let Some((before, pose)) = self.odometry
            && !self.must_stand
        {
            let passed = now.since(before);
            self.driven = Duration(self.driven.0.saturating_add(passed.0));
            self.stalled = Duration(self.stalled.0.saturating_add(passed.0));
            if pose != odometry {
                self.stalled = Duration(0);
            }
        }
        if self.stalled >= STALLED {
            self.stalled = Duration(0);
            self.escapes = Some(now + ESCAPE);
        }
        self.escapes = self.escapes.filter(|&end| now < end);
        self.odometry = Some((now, odometry));
        self.must_stand = self.stops.must_stand(self.gate, Some(odometry), now);
    }

    /// The command for the wheels at `now`.
    pub fn command(&self, now: Instant) -> DriveCommand {
        match self.newest {
            _ if self.must_stand => DriveCommand::STAND,
            _ if self.escapes.is_some() => DriveCommand { speed: 0, turn: self.follower.away() },
            Some((taken, command)) if now.since(taken) < BLIND => command,
            _ => DriveCommand::STAND,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_moves_only_between_pictures_that_were_taken_where_it_had_been_localised() {
        let at = |millis: u64| Instant(millis * 1_000);
        let pose = |x| Pose::from_metres(x, 0.0, 0.0);
        let mut walk = BoundaryWalk::new(BoundaryFollower::default(), Gate::default());
        let clear = [124; COLUMNS];
        walk.odometry(pose(0.0), at(0));
        assert!(!walk.look(&clear, at(50), None), "nobody has localised it");
        assert_eq!(walk.command(at(60)), DriveCommand::STAND);
        assert!(walk.look(&clear, at(100), Some(at(90))));
        walk.odometry(pose(0.0), at(110));
        assert_eq!(walk.command(at(120)).speed, 150);
        assert_eq!(walk.command(at(601)), DriveCommand::STAND, "the picture is too old");
        walk.odometry(pose(0.036), at(350));
        assert_eq!(walk.command(at(350)), DriveCommand::STAND, "the move is over");
        walk.odometry(pose(0.036), at(400));
        assert!(!walk.look(&clear, at(450), Some(at(390))), "the fix is from before the stop");
        assert!(walk.look(&clear, at(500), Some(at(420))));
        // Something is right ahead: it turns on the spot.
        assert!(walk.look(&[0; COLUMNS], at(520), Some(at(420))));
        walk.odometry(pose(0.036), at(530));
        assert_eq!(walk.command(at(540)), DriveCommand { speed: 0, turn: 600 });
        // Its wheels are blocked by what it does not see.
        assert!(walk.look(&clear, at(560), Some(at(420))));
        for millis in (580..1_300).step_by(50) {
            walk.odometry(pose(0.036), at(millis));
            walk.look(&clear, at(millis), Some(at(420)));
            assert_eq!(walk.command(at(millis)).speed, 150, "{millis}");
        }
        walk.odometry(pose(0.036), at(1_350));
        assert_eq!(walk.command(at(1_350)), DriveCommand { speed: 0, turn: 600 });
    }
}

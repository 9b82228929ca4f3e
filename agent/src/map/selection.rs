//! Which readings of a scan are to be mapped (Aluckal II.C, "thresholding" and "selective
//! omission").

use core::ops::Range;

use ubimap_protocol::units::Pose;

use super::{change::LastScan, gate::Gate, omission::Sweep, policy::Policy};
use crate::sense::Beam;

/// In so many scans a change in view of a robot that stands still is mapped: they take the evidence of
/// a cell from one end of its scale to the other.
const REPEATS: u8 = 6;

/// Why readings are mapped.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Selected {
    /// None is: the robot stands still and sees what it saw.
    Nothing,
    /// The robot has moved.
    Moved(Range<usize>),
    /// It stands still, and something has changed in view.
    Changed(Range<usize>),
}

/// Chooses from scan to scan.
#[derive(Debug)]
pub struct Selection {
    policy: Policy,
    sweep: Sweep,
    mapped_at: Option<Pose>,
    /// What the odometry said then: `base_link` in `odom`.
    odometry_then: Option<Pose>,
    last: LastScan,
    /// Scans in which a change was mapped that is not known yet.
    repeats: u8,
}

impl Selection {
    /// For a sensor; nothing has been mapped.
    pub fn new(policy: Policy, beams: &[Beam]) -> Self {
        Self {
            policy,
            sweep: Sweep::of(beams),
            mapped_at: None,
            odometry_then: None,
            last: LastScan::NONE,
            repeats: 0,
        }
    }

    /// Nothing of what has been mapped is left.
    pub fn begin_anew(&mut self) {
        self.mapped_at = None;
    }

    /// Whether a scan says nothing, without its pose: the robot stands where it mapped last, by its
    /// odometry and by the newest pose that is known, and it sees what it saw. `odometry` is `None`
    /// if the robot moves.
    pub fn stands(
        &self,
        gate: Gate,
        pose: Option<Pose>,
        odometry: Option<Pose>,
        readings: &[u16],
    ) -> bool {
        let stays = |then: Option<Pose>, now: Option<Pose>| {
            then.is_some() && now.is_some_and(|now| !gate.opens(then, now))
        };
        self.policy == Policy::Full
            && stays(self.odometry_then, odometry)
            && stays(self.mapped_at, pose)
            && self.last.changed(readings).is_none()
    }

    /// Which readings of a scan that was taken at `pose` (`base_link` in `map`) say something new.
    pub fn select(&self, gate: Gate, pose: Pose, readings: &[u16]) -> Selected {
        if self.policy == Policy::Pilot || gate.opens(self.mapped_at, pose) {
            let all = 0..readings.len();
            return Selected::Moved(match (self.policy, self.mapped_at) {
                (Policy::Omission, Some(before)) => {
                    self.sweep.new_in_view(before.heading, pose.heading, readings.len())
                }
                _ => all,
            });
        }
        match self.policy {
            Policy::Full => {
                self.last.changed(readings).map_or(Selected::Nothing, Selected::Changed)
            }
            // As printed: who stands still maps nothing.
            _ => Selected::Nothing,
        }
    }

    /// Takes note that a part of a scan has been mapped, and of the odometry.
    pub fn mapped(
        &mut self,
        pose: Pose,
        odometry: Option<Pose>,
        readings: &[u16],
        part: &Selected,
    ) {
        match part {
            Selected::Nothing => {}
            Selected::Moved(_) => {
                self.mapped_at = Some(pose);
                self.odometry_then = odometry;
                self.last.remember(readings, 0..readings.len());
            }
            Selected::Changed(part) => {
                self.repeats += 1;
                if self.repeats >= REPEATS {
                    self.repeats = 0;
                    self.last.remember(readings, part.clone());
                }
            }
        }
    }
}

//! Selects the readings of a scan to be mapped (Aluckal II.C, "thresholding" and "selective
//! omission").

use core::ops::Range;

use ubimap_protocol::units::Pose;

use super::{change::LastScan, gate::Gate, omission::Sweep, policy::Policy};
use crate::sense::Beam;

/// Number of scans in which a change in the view of a standing robot is mapped: they take a cell's
/// evidence from one end of its scale to the other.
const REPEATS: u8 = 6;

/// The readings to map, and why.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Selected {
    /// No readings: the robot stands still and its view is unchanged.
    Nothing,
    /// These readings: the robot has moved.
    Moved(Range<usize>),
    /// These readings: the robot stands still, but its view has changed.
    Changed(Range<usize>),
}

/// Decides which readings of a scan are mapped, from the scans mapped before it.
#[derive(Debug)]
pub struct Selection {
    policy: Policy,
    sweep: Sweep,
    mapped_at: Option<Pose>,
    /// The odometry at the last mapped scan: `base_link` in `odom`.
    odometry_then: Option<Pose>,
    last: LastScan,
    /// Number of scans in which the current change has been mapped so far.
    repeats: u8,
}

impl Selection {
    /// A selection for the sensor with this table of beams; nothing is mapped yet.
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

    /// Forgets the last mapped scan: the map was discarded.
    pub fn begin_anew(&mut self) {
        self.mapped_at = None;
    }

    /// Whether a scan can be skipped before its pose is known: by its odometry and its newest known
    /// pose the robot stands where it last mapped, and its view is unchanged. `odometry` is `None`
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

    /// Selects the readings to map from a scan taken at `pose` (`base_link` in `map`).
    pub fn select(&self, gate: Gate, pose: Pose, readings: &[u16]) -> Selected {
        if self.policy == Policy::Pilot || gate.opens(self.mapped_at, pose) {
            let all = 0..readings.len();
            return Selected::Moved(match (self.policy, self.mapped_at) {
                (Policy::Omission, Some(before)) => {
                    self.sweep.new_in_view(before.heading, pose.heading, readings.len())
                }
                (Policy::OmissionAsPrinted, Some(before)) => {
                    self.sweep.as_printed(before.heading, pose.heading, readings.len())
                }
                _ => all,
            });
        }
        match self.policy {
            Policy::Full => {
                self.last.changed(readings).map_or(Selected::Nothing, Selected::Changed)
            }
            // As in the paper's listing, a robot at standstill maps nothing.
            _ => Selected::Nothing,
        }
    }

    /// Records that `part` of a scan has been mapped, and the pose and odometry at which the scan
    /// was taken.
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

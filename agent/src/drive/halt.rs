//! Stops by the robot's own hardware or its user.

use ubimap_protocol::{message::EventCode, time::Instant};

/// Why a robot was stopped by its own hardware or its user.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StopReason {
    /// A bumper touches something.
    Bumper,
    /// A wheel has dropped: the robot was lifted, or is on an edge.
    WheelDrop,
    /// A sensor sees an edge below the robot.
    Cliff,
    /// The wheels do not report.
    WheelsSilent,
    /// A motor is blocked, or its driver refuses a command.
    WheelsFaulty,
    /// Somebody pressed a button.
    Button,
}

impl StopReason {
    /// The event code that reports this reason to the server, if there is one.
    pub fn event_code(self) -> Option<EventCode> {
        match self {
            Self::Bumper => Some(EventCode::Collision),
            Self::WheelDrop | Self::Cliff | Self::WheelsSilent | Self::WheelsFaulty => {
                Some(EventCode::DriveFault)
            }
            Self::Button => None,
        }
    }
}

/// A stop in force.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Halt {
    pub(crate) reason: StopReason,
    /// When the stop ends; `None` if only `Robot::resume` ends it.
    pub(crate) until: Option<Instant>,
}

impl Halt {
    /// This stop joined with the one in force before it: this reason, and the later end.
    pub(crate) fn after(self, before: Option<Self>) -> Self {
        let until = match before {
            None => self.until,
            Some(before) => before.until.zip(self.until).map(|(one, other)| one.max(other)),
        };
        Self { until, ..self }
    }

    /// Whether the stop is over at `now`.
    pub(crate) fn is_over(&self, now: Instant) -> bool {
        self.until.is_some_and(|until| until <= now)
    }
}

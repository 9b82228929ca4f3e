//! Why the robot drives or stands.

use ubimap_protocol::message::EventCode;

use super::plan::PlanError;

/// Why the robot does what it does. The driver reports each change once.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Reason {
    /// No task.
    #[default]
    NoTask,
    /// Driving.
    Driving,
    /// At the goal.
    Arrived,
    /// All reachable ground is mapped.
    Explored,
    /// What is left to explore has no room in the pool of tiles, which only a server empties.
    PoolFull,
    /// There is no path.
    NoWay(PlanError),
    /// An obstacle is in the way.
    Blocked,
    /// Waiting for a person.
    Person,
    /// The server has commanded a stop.
    Stopped,
    /// The server has been silent for too long.
    LinkLost,
    /// The pose is unknown or too uncertain.
    PoseLost,
    /// There is no recent scan.
    SensorLost,
    /// Outside the fence, the area that the robot may not leave.
    OutsideMap,
    /// The wheels do not turn as commanded.
    WheelsStuck,
    /// The wheels turn, but the robot does not move as far as they do.
    WheelsSlip,
}

impl Reason {
    /// Why exploring has ended, by the numbers of cells that had been refused when it began and at
    /// the end.
    pub(super) fn explored(refused: Option<[u32; 2]>) -> Self {
        let is_full = refused.is_some_and(|[before, now]| now != before);
        if is_full { Self::PoolFull } else { Self::Explored }
    }

    /// The event code that reports this reason to the server, if there is one.
    pub fn event_code(self) -> Option<EventCode> {
        Some(match self {
            Self::NoTask | Self::Driving | Self::Stopped | Self::LinkLost => return None,
            Self::Arrived | Self::Explored => EventCode::PathDone,
            Self::PoolFull => EventCode::PoolFull,
            Self::NoWay(_) | Self::Blocked | Self::OutsideMap => EventCode::PathBlocked,
            Self::Person => EventCode::StoppedByPerson,
            Self::PoseLost => EventCode::PoseLost,
            Self::SensorLost => EventCode::SensorFault,
            Self::WheelsStuck | Self::WheelsSlip => EventCode::DriveFault,
        })
    }
}

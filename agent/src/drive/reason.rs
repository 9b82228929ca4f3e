//! Why the robot drives, or stands.

use ubimap_protocol::message::EventCode;

use super::plan::PlanError;

/// Why it does what it does. The driver tells each change once.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Reason {
    /// It has nothing to do.
    #[default]
    NoTask,
    /// It is on its way.
    Driving,
    /// It is where it was to go.
    Arrived,
    /// All ground that it can reach is mapped.
    Explored,
    /// There is no way.
    NoWay(PlanError),
    /// Something stands in the way.
    Blocked,
    /// A person is waited for.
    Person,
    /// The server wants it to stand.
    Stopped,
    /// Nothing has been heard for too long.
    LinkLost,
    /// It does not know where it is.
    PoseLost,
    /// It sees nothing.
    SensorLost,
    /// It is outside the map.
    OutsideMap,
    /// The wheels do not do what they should.
    WheelsStuck,
    /// The wheels turn, and the robot does not go where they say.
    WheelsSlip,
}

impl Reason {
    /// The event that tells the server, if it needs one.
    pub fn event_code(self) -> Option<EventCode> {
        Some(match self {
            Self::NoTask | Self::Driving | Self::Stopped | Self::LinkLost => return None,
            Self::Arrived | Self::Explored => EventCode::PathDone,
            Self::NoWay(_) | Self::Blocked | Self::OutsideMap => EventCode::PathBlocked,
            Self::Person => EventCode::StoppedByPerson,
            Self::PoseLost => EventCode::PoseLost,
            Self::SensorLost => EventCode::SensorFault,
            Self::WheelsStuck | Self::WheelsSlip => EventCode::DriveFault,
        })
    }
}

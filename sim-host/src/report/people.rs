//! The people that the server tells robots of, for reports and `ubimap status`.

use std::fmt;

use serde::Serialize;
use ubimap_protocol::message::{Obstacle, ObstacleClass, Posture};

/// A person as tracked by the cameras.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct TrackedPerson {
    /// The number of the track.
    pub number: u16,
    /// "standing", "sitting" or "lying", by height; `None` if unknown.
    pub posture: Option<&'static str>,
    /// The centre in `map`, in metres.
    pub position_m: [f64; 2],
}

/// The name of a posture; `None` if it is unknown.
pub fn posture_name(posture: Posture) -> Option<&'static str> {
    match posture {
        Posture::Unknown => None,
        Posture::Standing => Some("standing"),
        Posture::Sitting => Some("sitting"),
        Posture::Lying => Some("lying"),
    }
}

impl TrackedPerson {
    /// The person of an obstacle; `None` if it is none.
    pub fn of((obstacle, posture): (Obstacle, Posture)) -> Option<Self> {
        (obstacle.class == ObstacleClass::Person).then(|| Self {
            number: obstacle.number,
            posture: posture_name(posture),
            position_m: [obstacle.x.metres(), obstacle.y.metres()],
        })
    }
}

/// One line.
impl fmt::Display for TrackedPerson {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ([x, y], posture) = (self.position_m, self.posture.unwrap_or("posture unknown"));
        write!(f, "person {}: {posture}, at ({x:.2}, {y:.2}) m", self.number)
    }
}

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

/// How soon a person was found who had sat or lain there from the beginning, as furniture, and rose.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct RisingSummary {
    /// When the person rose, in seconds.
    pub at_s: f64,
    /// Cells of free ground under the person that were drawn occupied until then.
    pub cells: u64,
    /// Seconds from rising until robots were told of a person there; `None` if never.
    pub told_s: Option<f64>,
    /// Seconds from rising, which includes the time to walk away, until nine of ten of these cells were not
    /// occupied any more; `None` if never.
    pub freed_s: Option<f64>,
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

/// One line.
impl fmt::Display for RisingSummary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let after =
            |time: Option<f64>| time.map_or("never".into(), |it| format!("after {it:.1} s"));
        write!(
            f,
            "a person rises at {:.0} s: told as a person {}, nine of ten of {} cells of the place freed {}",
            self.at_s,
            after(self.told_s),
            self.cells,
            after(self.freed_s)
        )
    }
}

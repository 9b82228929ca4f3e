//! The findings about a robot's wheels.

use std::fmt;

use serde::Serialize;

use super::{
    diagnosis::{Finding, Seen},
    tilt::Verdict,
};

/// What was found.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct WheelsReport {
    /// Always "ubimap-wheels".
    pub schema: &'static str,
    /// Version of the schema.
    pub version: u32,
    /// The robot.
    pub robot: u16,
    /// Each try, in order; the second one only if the first one was good.
    pub tries: Vec<TryReport>,
    /// What a line across the view was, and by how much the sensor looks down, if that could be told.
    pub view: Verdict,
    /// In degrees.
    pub looks_down_deg: Option<f64>,
    /// The same for people; empty if there is nothing to say.
    #[serde(skip)]
    pub about_view: String,
}

/// A try.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TryReport {
    /// What the robot was told to do.
    pub told: &'static str,
    /// By its wheels: metres ahead, and degrees to the left.
    pub counted_m: f64,
    /// The turn.
    pub counted_deg: f64,
    /// By its sensor.
    pub sensed_m: Option<f64>,
    /// By how much that may be wrong.
    pub sensed_error_m: Option<f64>,
    /// The turn.
    pub sensed_deg: Option<f64>,
    /// What was seen, by the sensor or a person.
    pub seen: Option<Seen>,
    /// What the robot reported meanwhile.
    pub events: Vec<String>,
    /// What is wrong.
    #[serde(flatten)]
    pub finding: Finding,
}

impl WheelsReport {
    /// Whether nothing is wrong.
    pub fn is_good(&self) -> bool {
        self.tries.iter().all(|it| it.finding == Finding::Good) && self.view != Verdict::Floor
    }
}

impl fmt::Display for WheelsReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for it in &self.tries {
            let TryReport { told, counted_m, counted_deg, finding, .. } = it;
            write!(f, "told to {told}: by its wheels {counted_m:.3} m, {counted_deg:.0} degrees")?;
            match (it.sensed_m, it.sensed_error_m, it.sensed_deg) {
                (Some(m), Some(error), Some(deg)) => {
                    write!(f, "; by its sensor {m:.3} m (within {error:.3}), {deg:.0} degrees")?;
                }
                _ => f.write_str("; its sensor does not tell")?,
            }
            if let Some(seen) = it.seen {
                write!(f, "; it {seen}")?;
            }
            writeln!(f)?;
            for event in &it.events {
                writeln!(f, "  the robot: {event}")?;
            }
            writeln!(f, "  {finding}")?;
        }
        f.write_str(&self.about_view)
    }
}

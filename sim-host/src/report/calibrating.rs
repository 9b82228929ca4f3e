//! The result of `ubimap calibrate`, as it is printed.

use std::fmt;

use serde::Serialize;

/// The figures of a calibration.
///
/// In the JSON, `schema` and `version` identify the format: within a version, names keep their
/// meaning, and new ones may be added.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CalibrateReport {
    /// Always "ubimap-calibrate".
    pub schema: &'static str,
    /// The version of the schema.
    pub version: u32,
    /// The file of observations.
    pub observations: String,
    /// The reference camera.
    pub reference: String,
    /// "covariance" or "unweighted": how residuals are weighted.
    pub weighting: &'static str,
    /// The ratio of the residuals to their stated noise; the standard deviations are scaled with
    /// it. One if the stated noise is right, or if too few landmarks can tell.
    pub noise_ratio: f64,
    /// Each camera.
    pub cameras: Vec<CameraResult>,
    /// Each pair of cameras that common landmarks tie.
    pub edges: Vec<EdgeResult>,
    /// Each pair of cameras whose common landmarks give no transform.
    pub failures: Vec<FailedPair>,
    /// Each camera of a recording in which no landmarks were found.
    pub unseen: Vec<UnseenCamera>,
}

/// A camera without landmarks.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct UnseenCamera {
    /// The camera's name.
    pub name: String,
    /// The reason and what to do.
    pub reason: String,
}

/// A camera after calibration.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct CameraResult {
    /// The camera's name.
    pub name: String,
    /// Whether overlaps tie it to the reference. Otherwise it has no pose.
    pub is_tied: bool,
    /// Root mean square of the distances between its landmarks and its neighbours', in metres.
    pub residual_m: f64,
    /// Standard deviation of the position relative to the reference, in metres.
    pub position_sigma_m: f64,
    /// Standard deviation of the orientation relative to the reference, in degrees.
    pub angle_sigma_deg: f64,
    /// Number of its landmarks that tie it to a neighbour.
    pub landmarks: u64,
    /// The cameras that share landmarks with it.
    pub neighbours: Vec<String>,
    /// How far its floor is from z = 0.
    pub floor: Option<FloorResult>,
}

/// The difference between a camera's floor and z = 0.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct FloorResult {
    /// Height of the camera less that above its floor, in metres.
    pub height_m: f64,
    /// Angle between its floor and the horizontal, in degrees.
    pub tilt_deg: f64,
}

/// A pair of cameras that common landmarks tie.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct EdgeResult {
    /// The names of both.
    pub cameras: [String; 2],
    /// Number of common landmarks that agree.
    pub landmarks: u64,
    /// Number of landmarks with the same label that do not agree.
    pub rejected: u64,
    /// Whether labels paired the landmarks.
    pub is_labelled: bool,
    /// Root mean square of the distances between the landmarks of both, in metres.
    pub residual_m: f64,
}

/// A pair of cameras without a transform.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct FailedPair {
    /// The names of both.
    pub cameras: [String; 2],
    /// The reason.
    pub reason: String,
}

impl CalibrateReport {
    /// The value of [`CalibrateReport::schema`].
    pub const SCHEMA: &'static str = "ubimap-calibrate";
    /// The version written by this program.
    pub const VERSION: u32 = 1;

    /// Whether every camera has a pose.
    pub fn is_complete(&self) -> bool {
        self.cameras.iter().all(|it| it.is_tied)
    }
}

impl Default for CalibrateReport {
    fn default() -> Self {
        Self {
            schema: Self::SCHEMA,
            version: Self::VERSION,
            observations: String::new(),
            reference: String::new(),
            weighting: "",
            noise_ratio: 1.0,
            cameras: Vec::new(),
            edges: Vec::new(),
            failures: Vec::new(),
            unseen: Vec::new(),
        }
    }
}

impl fmt::Display for CalibrateReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let tied = self.cameras.iter().filter(|it| it.is_tied).count();
        writeln!(
            f,
            "{}: {tied} of {} cameras calibrated against {} ({}); residuals are {:.2} times the stated noise",
            self.observations,
            self.cameras.len(),
            self.reference,
            self.weighting,
            self.noise_ratio,
        )?;
        let width = self.cameras.iter().map(|it| it.name.chars().count()).max().unwrap_or(0).max(6);
        writeln!(
            f,
            "{:width$}  {:>11}  {:>22}  {:>9}  {:>18}  neighbours",
            "camera", "residual", "1 sigma", "landmarks", "floor off by"
        )?;
        for camera in &self.cameras {
            let sigma = match camera.name == self.reference {
                true => "reference".to_owned(),
                false => describe(camera.position_sigma_m, camera.angle_sigma_deg),
            };
            let residual = format!("{:.1} mm", 1000.0 * camera.residual_m);
            let floor = camera.floor.map(|it| describe(it.height_m, it.tilt_deg));
            let [residual, sigma, floor] = match camera.is_tied {
                true => [residual, sigma, floor.unwrap_or_default()],
                false => ["-".to_owned(), "no pose".to_owned(), String::new()],
            };
            let line = format!(
                "{:width$}  {residual:>11}  {sigma:>22}  {:>9}  {floor:>18}  {}",
                camera.name,
                camera.landmarks,
                camera.neighbours.join(", ")
            );
            writeln!(f, "{}", line.trim_end())?;
        }
        for edge in &self.edges {
            let [one, other] = &edge.cameras;
            let how = if edge.is_labelled { "" } else { " without labels" };
            let rejected = match edge.rejected {
                0 => String::new(),
                count => format!(", {count} rejected"),
            };
            writeln!(
                f,
                "{one} - {other}: {} landmarks{how}{rejected}, residual {:.1} mm",
                edge.landmarks,
                1000.0 * edge.residual_m
            )?;
        }
        for FailedPair { cameras: [one, other], reason } in &self.failures {
            writeln!(f, "{one} - {other}: {reason}")?;
        }
        for UnseenCamera { name, reason } in &self.unseen {
            writeln!(f, "{name}: {reason}")?;
        }
        let untied: Vec<&str> =
            self.cameras.iter().filter(|it| !it.is_tied).map(|it| it.name.as_str()).collect();
        if !untied.is_empty() {
            writeln!(
                f,
                "no overlap ties these cameras to {}: {}",
                self.reference,
                untied.join(", ")
            )?;
        }
        Ok(())
    }
}

fn describe(length_m: f64, angle_deg: f64) -> String {
    format!("{:.1} mm, {angle_deg:.3} deg", 1000.0 * length_m)
}

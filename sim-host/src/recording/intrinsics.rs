//! The intrinsics of a recorded camera: `intrinsics.toml` or Open3D's camera file.

use std::path::Path;

use serde::{Deserialize, Serialize};

use super::{error::LogError, numbered_files::files_in};
use crate::{camera, files};

/// Tangent of half the maximum field of view (85 degrees).
const MAX_HALF_FIELD_TAN: f64 = 11.4;

/// The name of the intrinsics file.
pub(super) const INTRINSICS_FILE: &str = "intrinsics.toml";

/// The intrinsics of depth images and pictures, as stated in the file.
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct IntrinsicsFile {
    pub(super) width: u32,
    pub(super) height: u32,
    pub(super) fx: f64,
    pub(super) fy: f64,
    pub(super) cx: f64,
    pub(super) cy: f64,
    #[serde(default)]
    pub(super) distortion: [f64; 5],
    #[serde(default = "millimetres")]
    pub(super) depth_per_metre: f64,
    pub(super) depth_noise: Option<DepthNoiseFile>,
    row: Option<u32>,
}

/// The coefficients of [`camera::DepthNoise`].
#[derive(Clone, Copy, Debug, Deserialize, PartialEq, Serialize)]
#[serde(deny_unknown_fields)]
pub(super) struct DepthNoiseFile {
    pub(super) constant_m: f64,
    pub(super) quadratic_per_m: f64,
}

fn millimetres() -> f64 {
    1000.0
}

/// Open3D's camera file; the matrix is column-major.
#[derive(Deserialize)]
struct Open3dCamera {
    width: u32,
    height: u32,
    intrinsic_matrix: [f64; 9],
}

impl IntrinsicsFile {
    /// The file for a calibrated sensor with depths in millimetres.
    pub(crate) fn of(pinhole: &camera::Intrinsics, noise: Option<&camera::DepthNoise>) -> Self {
        let camera::Intrinsics { width, height, fx, fy, cx, cy, distortion } = *pinhole;
        let depth_per_metre = millimetres();
        let depth_noise = noise.map(|noise| DepthNoiseFile {
            constant_m: noise.constant_m(),
            quadratic_per_m: noise.quadratic_per_m(),
        });
        Self { width, height, fx, fy, cx, cy, distortion, depth_per_metre, depth_noise, row: None }
    }

    /// The pinhole of a sensor whose images have their top row first and depths in millimetres.
    ///
    /// # Errors
    /// The problem as text.
    pub(crate) fn pinhole(&self) -> Result<camera::Intrinsics, String> {
        let checked = self.clone().checked()?;
        if checked.fy < 0.0 || checked.depth_per_metre != millimetres() {
            return Err("needs a positive fy, and depths in millimetres".to_owned());
        }
        let Self { width, height, fx, fy, cx, cy, distortion, .. } = checked;
        Ok(camera::Intrinsics { width, height, fx, fy, cx, cy, distortion })
    }

    /// The stated noise of the depths, or that of a D435.
    ///
    /// # Errors
    /// [`camera::CalibrationError`].
    pub(crate) fn noise(&self) -> Result<camera::DepthNoise, camera::CalibrationError> {
        self.depth_noise.map_or(Ok(camera::DepthNoise::default()), |noise| {
            camera::DepthNoise::new(noise.constant_m, noise.quadratic_per_m)
        })
    }

    /// Checks that the values are plausible. Returns the problem as text if they are not.
    fn checked(self) -> Result<Self, String> {
        let focal = |value: f64| value.is_finite() && value.abs() > 1.0;
        let sees_too_much =
            |side: u32, focal: f64| f64::from(side) > 2.0 * MAX_HALF_FIELD_TAN * focal.abs();
        let sides = 1..=u32::from(u16::MAX);
        if !sides.contains(&self.width) || !sides.contains(&self.height) {
            Err("width and height must be from 1 to 65535".to_owned())
        } else if !(focal(self.fx) && self.fx > 0.0 && focal(self.fy)) {
            Err("fx must be more than one pixel, fy too (or less than minus one)".to_owned())
        } else if sees_too_much(self.width, self.fx) || sees_too_much(self.height, self.fy) {
            Err("fx and fy see more than 170 degrees; they are in pixels".to_owned())
        } else if !(0.0..f64::from(self.width)).contains(&self.cx)
            || !(0.0..f64::from(self.height)).contains(&self.cy)
        {
            Err("cx and cy must lie in the image".to_owned())
        } else if !(1.0..=1e6).contains(&self.depth_per_metre) {
            Err("depth_per_metre must be from 1 to 1000000".to_owned())
        } else if self.row() >= self.height {
            Err("row must lie in the image".to_owned())
        } else {
            Ok(self)
        }
    }

    /// The row to slice: the one stated in the file, or the one on the optical axis.
    pub(super) fn row(&self) -> u32 {
        self.row.unwrap_or_else(|| (self.cy.round() as u32).min(self.height - 1))
    }
}

/// The intrinsics stated in a folder, if any.
pub(super) fn stated(folder: &Path) -> Result<Option<IntrinsicsFile>, LogError> {
    let toml_file = folder.join(INTRINSICS_FILE);
    let text_of = |path: &Path| {
        files::read_settings(path).map_err(|error| LogError::Io { path: path.to_owned(), error })
    };
    let refuse = |path: &Path, reason: String| {
        let reason = reason.lines().next().unwrap_or_default().to_owned();
        LogError::Intrinsics { path: path.to_owned(), reason }
    };
    if toml_file.is_file() {
        let parsed = toml::from_str::<IntrinsicsFile>(&text_of(&toml_file)?)
            .map_err(|error| error.message().to_owned());
        let intrinsics = parsed.and_then(IntrinsicsFile::checked);
        return Ok(Some(intrinsics.map_err(|reason| refuse(&toml_file, reason))?));
    }
    if let Some(json_file) = files_in(folder, &["json"])?.first() {
        let parsed = serde_json::from_str::<Open3dCamera>(&text_of(json_file)?);
        let intrinsics = parsed.map_err(|error| error.to_string()).and_then(|camera| {
            let [fx, _, _, _, fy, _, cx, cy, _] = camera.intrinsic_matrix;
            let Open3dCamera { width, height, .. } = camera;
            let distortion = [0.0; 5];
            let pinhole = camera::Intrinsics { width, height, fx, fy, cx, cy, distortion };
            IntrinsicsFile::of(&pinhole, None).checked()
        });
        return Ok(Some(intrinsics.map_err(|reason| refuse(json_file, reason))?));
    }
    Ok(None)
}

/// The error for a folder without intrinsics.
pub(super) fn missing(folder: &Path) -> LogError {
    let reason = "missing; write width, height, fx, fy, cx, cy and depth_per_metre there";
    LogError::Intrinsics { path: folder.join(INTRINSICS_FILE), reason: reason.to_owned() }
}

/// The intrinsics stated in a folder; an error if there are none. They are never guessed, because
/// wrong intrinsics would give a wrong map without an error.
pub(super) fn required(folder: &Path) -> Result<IntrinsicsFile, LogError> {
    stated(folder)?.ok_or_else(|| missing(folder))
}

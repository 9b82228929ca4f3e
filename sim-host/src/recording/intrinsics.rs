//! The intrinsics of a recorded camera: `intrinsics.toml`, or the camera file of another program.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::{
    camera_forms::{CameraForm, FormFault, WANTED},
    error::LogError,
    image_times::list_of,
    numbered_files::files_in,
};
use crate::{camera, files};

/// Tangent of half the maximum field of view (85 degrees).
const MAX_HALF_FIELD_TAN: f64 = 11.4;

/// The name of the intrinsics file.
pub(super) const INTRINSICS_FILE: &str = "intrinsics.toml";

/// The extensions of the camera files of other programs.
const CAMERA_KINDS: [&str; 3] = ["json", "yaml", "yml"];

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
    pub(super) row: Option<u32>,
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

/// The intrinsics stated in a folder, if any: in an `intrinsics.toml`, or else in a camera file of another
/// program. `depth_per_metre` is used instead of the scale that is stated.
pub(super) fn stated(
    folder: &Path,
    depth_per_metre: Option<f64>,
) -> Result<Option<IntrinsicsFile>, LogError> {
    let toml_file = folder.join(INTRINSICS_FILE);
    let found = if toml_file.is_file() {
        let parsed = toml::from_str::<IntrinsicsFile>(&text_of(&toml_file)?)
            .map_err(|error| error.message().to_owned());
        let file = parsed.map_err(|reason| refused(&toml_file, &reason))?;
        Some((toml_file, file))
    } else {
        of_other_programs(folder, depth_per_metre)?
    };
    let Some((path, file)) = found else { return Ok(None) };
    let scaled =
        IntrinsicsFile { depth_per_metre: depth_per_metre.unwrap_or(file.depth_per_metre), ..file };
    Ok(Some(scaled.checked().map_err(|reason| refused(&path, &reason))?))
}

/// The camera file of another program in a folder, of which there may be only one, and what it states.
fn of_other_programs(
    folder: &Path,
    depth_per_metre: Option<f64>,
) -> Result<Option<(PathBuf, IntrinsicsFile)>, LogError> {
    let paths = files_in(folder, &CAMERA_KINDS)?;
    let mut found: Option<(PathBuf, CameraForm)> = None;
    for path in &paths {
        let is_json = path.extension().is_some_and(|it| it.eq_ignore_ascii_case("json"));
        match CameraForm::parse(&text_of(path)?, is_json) {
            Ok(form) => {
                if let Some((other, _)) = found.as_ref().filter(|(_, it)| *it != form) {
                    let reason =
                        format!("{} states others; keep one of the files", other.display());
                    return Err(refused(path, &reason));
                }
                found = Some((path.clone(), form));
            }
            Err(FormFault::NoCamera) => {}
            Err(FormFault::Wrong(reason)) => return Err(refused(path, &reason)),
        }
    }
    let Some((path, form)) = found else { return Ok(None) };
    let scale = form.depth_per_metre;
    if scale.is_none() && depth_per_metre.is_none() && list_of(&folder.join("depth")).is_file() {
        let reason = "no depth scale; name it with --depth-scale (TUM's benchmark has 5000)";
        return Err(refused(&path, reason));
    }
    let file = IntrinsicsFile {
        depth_per_metre: scale.unwrap_or(millimetres()),
        ..IntrinsicsFile::of(&form.pinhole, None)
    };
    Ok(Some((path, file)))
}

fn text_of(path: &Path) -> Result<String, LogError> {
    files::read_settings(path).map_err(|error| LogError::Io { path: path.to_owned(), error })
}

fn refused(path: &Path, reason: &str) -> LogError {
    let reason = reason.lines().next().unwrap_or_default().to_owned();
    LogError::Intrinsics { path: path.to_owned(), reason }
}

/// The error for a folder without intrinsics.
pub(super) fn missing(folder: &Path) -> LogError {
    let tried = files_in(folder, &CAMERA_KINDS).unwrap_or_default();
    let tried = tried.first().and_then(|path| path.file_name());
    let tried = tried.map_or(String::new(), |it| format!(" ({} has none)", it.display()));
    let reason = format!(
        "missing; write width, height, fx, fy, cx, cy and depth_per_metre there, or add a .yaml or .json \
         file with {WANTED}{tried}"
    );
    refused(&folder.join(INTRINSICS_FILE), &reason)
}

/// The intrinsics stated in a folder; an error if there are none. They are never guessed, because
/// wrong intrinsics would give a wrong map without an error.
pub(super) fn required(
    folder: &Path,
    depth_per_metre: Option<f64>,
) -> Result<IntrinsicsFile, LogError> {
    stated(folder, depth_per_metre)?.ok_or_else(|| missing(folder))
}

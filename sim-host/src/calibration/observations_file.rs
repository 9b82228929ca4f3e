//! A file of observations, in TOML: the input of `ubimap calibrate`.
//!
//! ```toml
//! [noise]               # optional: the standard deviations of one landmark's position
//! lateral_m = 0.004     # across the ray
//! depth_m = 0.001       # of the depth: depth_m + depth_per_m * z^2
//! depth_per_m = 0.00475
//! frames = 100          # each landmark is the mean of this many frames
//!
//! [[cameras]]
//! name = "camera-00"
//! floor = { normal = [0.0, -0.5, -0.866], height_m = 2.9 }
//! landmarks = [
//!     ["red", 0.52, -0.31, 2.74],
//!     ["blue", -0.8, 0.1, 2.9],
//!     [1.2, 0.4, 3.1],
//! ]
//!
//! [[cameras]]
//! name = "camera-01"
//! noise = { lateral_m = 0.002, depth_m = 0.01 }
//! landmarks = [["red", -1.1, 0.2, 2.5], { label = "blue", at_m = [0.3, 0.3, 2.8], depth_m = 0.05 }]
//! ```
//!
//! Coordinates are those of the camera's optical frame in metres: x right in the image, y down, z
//! forward (the depth). A row is `[label, x, y, z]`, or `[x, y, z]` without a label; labels are strings
//! or integers, the same in every camera. A table can state a landmark's own noise. Noise that a
//! camera or a landmark doesn't state is that of the level above; without any it is that of one
//! frame of a D435.
//!
//! `floor` is the plane of the floor: its upward normal in the optical frame, and the height of the
//! optical centre above it; optionally `normal_sigma_deg` (0.2) and `height_sigma_m` (0.01).

use std::fmt::Write as _;

use nalgebra::{Point3, Vector3};
use toml::{Table, Value};

use super::{
    observations::{CameraObservations, Floor, Landmark, Observations, ObservationsError},
    point_noise::PointNoise,
};
use crate::camera::DepthNoise;

/// Why a file of observations can't be used, on one line.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ObservationsFileError {
    /// The text is not TOML.
    #[error("line {line}: {reason}")]
    Syntax {
        /// The line, from 1.
        line: usize,
        /// The reason.
        reason: String,
    },
    /// A key has the wrong form.
    #[error("{key}: {problem}")]
    Key {
        /// The key: `cameras[1].landmarks[3]`.
        key: String,
        /// What is expected.
        problem: String,
    },
    /// The observations can't be used.
    #[error(transparent)]
    Observations(#[from] ObservationsError),
}

impl Observations {
    /// Parses the text of a file.
    ///
    /// # Errors
    /// Every [`ObservationsFileError`].
    pub fn parse(text: &str) -> Result<Self, ObservationsFileError> {
        let file: Table = toml::from_str(text).map_err(|error| {
            let at = error.span().map_or(0, |it| it.start).min(text.len());
            ObservationsFileError::Syntax {
                line: 1 + text.as_bytes()[..at].iter().filter(|it| **it == b'\n').count(),
                reason: error.message().replace('\n', ", "),
            }
        })?;
        known(&file, "", &["noise", "cameras"])?;
        let noise = match file.get("noise") {
            Some(value) => NoiseKeys::default().read(table(value, "noise")?, "noise")?,
            None => NoiseKeys::default(),
        };
        let cameras = match file.get("cameras") {
            Some(value) => list(value, "cameras")?,
            None => &[],
        };
        let cameras = cameras.iter().enumerate().map(|(index, value)| {
            let key = format!("cameras[{index}]");
            camera(table(value, &key)?, &key, &noise)
        });
        let observations = Self { cameras: cameras.collect::<Result<_, _>>()? };
        observations.check()?;
        Ok(observations)
    }

    /// The observations as a text that [`Observations::parse`] reads. Coordinates are written with
    /// all digits, and every camera states the noise of its first landmark.
    pub fn to_toml(&self) -> String {
        let mut text = String::new();
        for camera in &self.cameras {
            // Writing into a string can't fail.
            let _ = writeln!(text, "[[cameras]]\nname = {}", quoted(&camera.name));
            let common = camera.landmarks.first().map_or(PointNoise::D435, |it| it.noise);
            let _ = writeln!(text, "noise = {{ {} }}", noise_keys(&common));
            if let Some(floor) = &camera.floor {
                let [x, y, z] = floor.normal.into_inner().into();
                let _ = writeln!(
                    text,
                    "floor = {{ normal = [{x:?}, {y:?}, {z:?}], height_m = {:?}, normal_sigma_deg = {:?}, \
                     height_sigma_m = {:?} }}",
                    floor.height_m,
                    floor.normal_sigma_rad.to_degrees(),
                    floor.height_sigma_m,
                );
            }
            let _ = writeln!(text, "landmarks = [");
            for landmark in &camera.landmarks {
                let [x, y, z] = landmark.position.coords.into();
                let label = landmark.label.as_deref().map(quoted);
                let _ = if landmark.noise == common {
                    let label = label.map_or(String::new(), |it| format!("{it}, "));
                    writeln!(text, "    [{label}{x:?}, {y:?}, {z:?}],")
                } else {
                    let label = label.map_or(String::new(), |it| format!("label = {it}, "));
                    let noise = noise_keys(&landmark.noise);
                    writeln!(text, "    {{ {label}at_m = [{x:?}, {y:?}, {z:?}], {noise} }},")
                };
            }
            let _ = writeln!(text, "]\n");
        }
        text
    }
}

fn noise_keys(noise: &PointNoise) -> String {
    let depth = noise.depth();
    format!(
        "lateral_m = {:?}, depth_m = {:?}, depth_per_m = {:?}",
        noise.lateral_m(),
        depth.constant_m(),
        depth.quadratic_per_m()
    )
}

fn quoted(text: &str) -> String {
    Value::from(text).to_string()
}

/// The keys of a noise.
#[derive(Clone, Copy)]
struct NoiseKeys {
    lateral_m: f64,
    depth_m: f64,
    depth_per_m: f64,
    frames: u32,
}

impl Default for NoiseKeys {
    fn default() -> Self {
        Self {
            lateral_m: PointNoise::D435.lateral_m(),
            depth_m: DepthNoise::D435.constant_m(),
            depth_per_m: DepthNoise::D435.quadratic_per_m(),
            frames: 1,
        }
    }
}

impl NoiseKeys {
    const NAMES: [&str; 4] = ["lateral_m", "depth_m", "depth_per_m", "frames"];

    /// These keys, replaced by those of a table. A stated depth noise is complete: without
    /// `depth_per_m` it is constant.
    fn read(mut self, table: &Table, key: &str) -> Result<Self, ObservationsFileError> {
        if key.ends_with("noise") {
            known(table, key, &Self::NAMES)?;
        }
        let number = |name: &str| number_of(table, key, name);
        self.lateral_m = number("lateral_m")?.unwrap_or(self.lateral_m);
        if let Some(depth_m) = number("depth_m")? {
            (self.depth_m, self.depth_per_m) = (depth_m, 0.0);
        }
        self.depth_per_m = number("depth_per_m")?.unwrap_or(self.depth_per_m);
        if let Some(frames) = number("frames")? {
            if !(1.0..=1e6).contains(&frames) || frames.fract() != 0.0 {
                return Err(wrong(
                    &join(key, "frames"),
                    "must be a whole number from 1 to 1000000",
                ));
            }
            self.frames = frames as u32;
        }
        self.noise(key)?;
        Ok(self)
    }

    fn noise(&self, key: &str) -> Result<PointNoise, ObservationsFileError> {
        let depth = DepthNoise::new(self.depth_m, self.depth_per_m)
            .map_err(|error| wrong(key, &error.to_string()))?;
        let noise = PointNoise::new(self.lateral_m, depth)
            .map_err(|error| wrong(key, &error.to_string()))?;
        Ok(noise.averaged(self.frames))
    }
}

fn camera(
    table_: &Table,
    key: &str,
    noise: &NoiseKeys,
) -> Result<CameraObservations, ObservationsFileError> {
    known(table_, key, &["name", "noise", "floor", "landmarks"])?;
    let name = match table_.get("name") {
        Some(Value::String(name)) => name.clone(),
        _ => return Err(wrong(&join(key, "name"), "is needed, as a string")),
    };
    let noise = match table_.get("noise") {
        Some(value) => {
            let key = join(key, "noise");
            noise.read(table(value, &key)?, &key)?
        }
        None => *noise,
    };
    let floor = match table_.get("floor") {
        Some(value) => {
            let key = join(key, "floor");
            Some(floor(table(value, &key)?, &key)?)
        }
        None => None,
    };
    let rows = match table_.get("landmarks") {
        Some(value) => list(value, &join(key, "landmarks"))?,
        None => &[],
    };
    let landmarks = rows
        .iter()
        .enumerate()
        .map(|(index, row)| landmark(row, &format!("{key}.landmarks[{index}]"), &noise));
    Ok(CameraObservations { name, landmarks: landmarks.collect::<Result<_, _>>()?, floor })
}

fn landmark(row: &Value, key: &str, noise: &NoiseKeys) -> Result<Landmark, ObservationsFileError> {
    const FORM: &str =
        "must be [label, x, y, z] or [x, y, z], or { label = ..., at_m = [x, y, z] }";
    let (label, coordinates, noise) = match row {
        Value::Array(row) if row.len() == 4 => (Some(&row[0]), &row[1..], *noise),
        Value::Array(row) => (None, &row[..], *noise),
        Value::Table(row) => {
            known(row, key, &[&["label", "at_m"][..], &NoiseKeys::NAMES].concat())?;
            let at = row.get("at_m").and_then(Value::as_array).ok_or_else(|| wrong(key, FORM))?;
            (row.get("label"), &at[..], noise.read(row, key)?)
        }
        _ => return Err(wrong(key, FORM)),
    };
    let label = match label {
        None => None,
        Some(Value::String(text)) => Some(text.clone()),
        Some(Value::Integer(number)) => Some(number.to_string()),
        Some(_) => return Err(wrong(key, "the label must be a string or an integer")),
    };
    let position = Point3::from(vector(coordinates).ok_or_else(|| wrong(key, FORM))?);
    Ok(Landmark { position, label, noise: noise.noise(key)? })
}

fn floor(table: &Table, key: &str) -> Result<Floor, ObservationsFileError> {
    known(table, key, &["normal", "height_m", "normal_sigma_deg", "height_sigma_m"])?;
    let normal = table.get("normal").and_then(Value::as_array).and_then(|it| vector(it));
    let height_m = number_of(table, key, "height_m")?;
    let floor = normal.zip(height_m).and_then(|(normal, height_m)| Floor::new(normal, height_m));
    let Some(mut floor) = floor else {
        return Err(wrong(key, "needs normal = [x, y, z] (upward, optical frame) and height_m"));
    };
    if let Some(sigma) = number_of(table, key, "normal_sigma_deg")? {
        floor.normal_sigma_rad = sigma.to_radians();
    }
    if let Some(sigma) = number_of(table, key, "height_sigma_m")? {
        floor.height_sigma_m = sigma;
    }
    Ok(floor)
}

fn vector(values: &[Value]) -> Option<Vector3<f64>> {
    let numbers: Option<Vec<f64>> = values.iter().map(number).collect();
    let numbers: [f64; 3] = numbers?.try_into().ok()?;
    Some(Vector3::from(numbers))
}

fn number(value: &Value) -> Option<f64> {
    value.as_float().or(value.as_integer().map(|it| it as f64)).filter(|it| it.is_finite())
}

fn number_of(table: &Table, key: &str, name: &str) -> Result<Option<f64>, ObservationsFileError> {
    let Some(value) = table.get(name) else { return Ok(None) };
    number(value).map(Some).ok_or_else(|| wrong(&join(key, name), "must be a number"))
}

fn table<'a>(value: &'a Value, key: &str) -> Result<&'a Table, ObservationsFileError> {
    value.as_table().ok_or_else(|| wrong(key, "must be a table"))
}

fn list<'a>(value: &'a Value, key: &str) -> Result<&'a [Value], ObservationsFileError> {
    value.as_array().map(Vec::as_slice).ok_or_else(|| wrong(key, "must be a list"))
}

fn known(table: &Table, key: &str, names: &[&str]) -> Result<(), ObservationsFileError> {
    match table.keys().find(|it| !names.contains(&it.as_str())) {
        Some(other) => {
            let problem = format!("unknown key; expected one of {}", names.join(", "));
            Err(wrong(&join(key, other), &problem))
        }
        None => Ok(()),
    }
}

fn join(key: &str, name: &str) -> String {
    if key.is_empty() { name.to_owned() } else { format!("{key}.{name}") }
}

fn wrong(key: &str, problem: &str) -> ObservationsFileError {
    ObservationsFileError::Key { key: key.to_owned(), problem: problem.to_owned() }
}

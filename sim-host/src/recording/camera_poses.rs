//! Camera pose files: `pose.txt` and `trajectory.log`.

use std::path::{Path, PathBuf};

use nalgebra::{Matrix3, Quaternion, UnitQuaternion, Vector3};

use super::{
    error::{Field, LineFault, LogError},
    lines::{Lines, coordinate, number},
};

/// A camera's pose in the world.
#[derive(Clone, Debug)]
pub(super) struct CameraPose {
    pub(super) line: usize,
    pub(super) stamp_s: Option<f64>,
    pub(super) position: Vector3<f64>,
    pub(super) rotation: Matrix3<f64>,
}

type ParsePose = fn(&[(usize, Vec<f64>)]) -> Result<CameraPose, LineFault>;

/// The names of pose files, the number of lines for each pose, and the parsers.
const POSE_FILES: [(&str, usize, ParsePose); 2] =
    [("trajectory.log", 5, CameraPose::from_matrix), ("pose.txt", 1, CameraPose::from_quaternion)];

/// Whether a folder contains a pose file.
pub(super) fn has_poses(folder: &Path) -> bool {
    POSE_FILES.iter().any(|(name, ..)| folder.join(name).is_file())
}

/// Reads a folder's pose file. Returns its path and the poses.
pub(super) fn read_poses(folder: &Path) -> Result<(PathBuf, Vec<CameraPose>), LogError> {
    let Some((name, lines_each, parse)) =
        POSE_FILES.into_iter().find(|(name, ..)| folder.join(name).is_file())
    else {
        let path = folder.to_owned();
        return Err(LogError::Empty { path, record: "pose.txt or trajectory.log" });
    };

    let path = folder.join(name);
    let fault_at = |line, fault| LogError::Line { path: path.clone(), line, fault };
    let mut rows = Vec::new();
    let mut lines = Lines::open(&path)?;
    while let Some(line) = lines.next() {
        let (at, text) = line?;
        if text.trim_ascii().is_empty() || text.starts_with('#') {
            continue;
        }
        let numbers: Result<Vec<f64>, _> =
            text.split_ascii_whitespace().map(|word| number(word, Field::Named("pose"))).collect();
        rows.push((at, numbers.map_err(|fault| fault_at(at, fault))?));
    }
    let poses: Result<Vec<_>, _> = rows
        .chunks(lines_each)
        .map(|rows| parse(rows).map_err(|fault| fault_at(rows[0].0, fault)))
        .collect();
    Ok((path.clone(), poses?))
}

impl CameraPose {
    /// A pose that was computed, not read from a line.
    pub(super) fn mounted(position: Vector3<f64>, rotation: Matrix3<f64>) -> Self {
        Self { line: 0, stamp_s: None, position, rotation }
    }

    /// Parses a line `[time] x y z qx qy qz qw`.
    fn from_quaternion(rows: &[(usize, Vec<f64>)]) -> Result<Self, LineFault> {
        let (line, numbers) = &rows[0];
        let (stamp_s, pose) = match numbers.as_slice() {
            [time, pose @ ..] if pose.len() == 7 => (Some(*time), pose),
            pose => (None, pose),
        };
        let &[x, y, z, qx, qy, qz, qw] = pose else {
            return Err(LineFault::Fields { found: numbers.len(), expected: 7 });
        };
        let quaternion = Quaternion::new(qw, qx, qy, qz);
        if !(0.9..1.1).contains(&quaternion.norm()) {
            return Err(LineFault::NoRotation);
        }
        let rotation = UnitQuaternion::from_quaternion(quaternion).to_rotation_matrix();
        Self::new(*line, stamp_s, [x, y, z], *rotation.matrix())
    }

    /// Parses a line of three numbers (frame indices, ignored), followed by the four rows of a
    /// matrix.
    fn from_matrix(rows: &[(usize, Vec<f64>)]) -> Result<Self, LineFault> {
        let [_, matrix @ ..] = rows else { return Err(LineFault::NoRotation) };
        if let Some((_, row)) = matrix.iter().find(|(_, row)| row.len() != 4) {
            return Err(LineFault::Fields { found: row.len(), expected: 4 });
        }
        let [a, b, c, _] = matrix else {
            return Err(LineFault::Fields { found: 4 * matrix.len(), expected: 16 });
        };
        let [a, b, c] = [&a.1, &b.1, &c.1];
        let rotation = Matrix3::new(a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2]);
        let departure = (rotation * rotation.transpose() - Matrix3::identity()).norm();
        if departure > 0.1 || rotation.determinant() < 0.0 {
            return Err(LineFault::NoRotation);
        }
        Self::new(rows[0].0, None, [a[3], b[3], c[3]], rotation)
    }

    fn new(
        line: usize,
        stamp_s: Option<f64>,
        position: [f64; 3],
        rotation: Matrix3<f64>,
    ) -> Result<Self, LineFault> {
        for value in position {
            coordinate(value, Field::Named("position"))?;
        }
        Ok(Self { line, stamp_s, position: Vector3::from(position), rotation })
    }

    /// The direction of the optical axis in the world.
    pub(super) fn forward(&self) -> Vector3<f64> {
        self.rotation.column(2).into_owned()
    }
}

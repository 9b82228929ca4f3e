//! A camera's pose, in the forms in which people write it.

use nalgebra::{Matrix3, Quaternion, Rotation3, UnitQuaternion, Vector3};

use super::{
    error::{Field, LineFault},
    lines::coordinate,
};

/// A camera's pose in the world: that of its optical frame (x right, y down, z forward), in metres.
#[derive(Clone, Debug)]
pub(super) struct CameraPose {
    /// The line in its file, from 1; zero if it was computed.
    pub(super) line: usize,
    /// When it was there, in seconds.
    pub(super) stamp_s: Option<f64>,
    pub(super) position: Vector3<f64>,
    pub(super) rotation: Matrix3<f64>,
}

/// A line of numbers.
pub(super) struct Row {
    /// The line, from 1.
    pub(super) line: usize,
    pub(super) numbers: Vec<f64>,
}

/// How a pose is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Form {
    /// `x y z qx qy qz qw`.
    Quaternion,
    /// The same after a time (TUM).
    Stamped,
    /// A matrix from camera to world in one line, of 3 x 4 or 4 x 4 numbers.
    Line,
    /// A matrix in lines of 4 numbers: three, or four with 0 0 0 1.
    Matrix,
    /// The same after a line of indices (Redwood, Open3D).
    Numbered,
}

/// Parses the poses of a file, all of one form. An error has the line to which it belongs.
pub(super) fn parse(rows: &[Row]) -> Result<Vec<CameraPose>, (usize, LineFault)> {
    let mut poses = Vec::new();
    let mut first_form = None;
    let mut rest = rows;
    while let Some(Row { line, numbers }) = rest.first() {
        let refuse = |fault| (*line, fault);
        let form = form(rest).ok_or(refuse(LineFault::PoseForm { found: numbers.len() }))?;
        if *first_form.get_or_insert(form) != form {
            return Err(refuse(LineFault::OtherPoseForm { found: numbers.len() }));
        }
        let (taken, pose) = match (form, &numbers[..]) {
            (Form::Stamped, [time, pose @ ..]) => (1, of_quaternion(*line, Some(*time), pose)),
            (Form::Quaternion, pose) => (1, of_quaternion(*line, None, pose)),
            (Form::Line, matrix) => {
                let rows: Vec<&[f64]> = matrix.chunks(4).collect();
                (1, of_matrix(*line, &rows))
            }
            _ => {
                let before = usize::from(form == Form::Numbered);
                let rows = block(&rest[before..]);
                (before + rows.len(), of_matrix(*line, &rows))
            }
        };
        poses.push(pose.map_err(refuse)?);
        rest = &rest[taken..];
    }
    Ok(poses)
}

/// The form of the first pose of these rows.
fn form(rows: &[Row]) -> Option<Form> {
    let length = |index: usize| rows.get(index).map_or(0, |row| row.numbers.len());
    match length(0) {
        7 => Some(Form::Quaternion),
        8 => Some(Form::Stamped),
        12 | 16 => Some(Form::Line),
        4 => Some(Form::Matrix),
        1..=3 if length(1) == 4 => Some(Form::Numbered),
        _ => None,
    }
}

/// The rows of the matrix with which these lines begin: up to four of them.
fn block(rows: &[Row]) -> Vec<&[f64]> {
    let rows = rows.iter().map(|row| &row.numbers[..]).take_while(|row| row.len() == 4);
    let block: Vec<&[f64]> = rows.take(4).collect();
    // The fourth line may be the first one of the next matrix of three lines.
    let is_last = |row: &[f64]| row[..3] == [0.0; 3];
    let is_transposed = block.iter().take(3).all(|row| row[3] == 0.0) && block.len() == 4;
    match &block[..] {
        [_, _, _, last] if !is_last(last) && !is_transposed => block[..3].to_vec(),
        _ => block,
    }
}

fn of_quaternion(line: usize, stamp_s: Option<f64>, pose: &[f64]) -> Result<CameraPose, LineFault> {
    let &[x, y, z, qx, qy, qz, qw] = pose else {
        return Err(LineFault::PoseForm { found: pose.len() });
    };
    let quaternion = Quaternion::new(qw, qx, qy, qz);
    if !(0.9..1.1).contains(&quaternion.norm()) {
        return Err(LineFault::NoRotation("its quaternion (qx qy qz qw) is not of length 1"));
    }
    let rotation = UnitQuaternion::from_quaternion(quaternion).to_rotation_matrix();
    CameraPose::new(line, stamp_s, [x, y, z], *rotation.matrix())
}

/// The pose of a matrix of three or four rows of four numbers.
fn of_matrix(line: usize, rows: &[&[f64]]) -> Result<CameraPose, LineFault> {
    let [a, b, c, last @ ..] = rows else {
        return Err(LineFault::Fields { found: 4 * rows.len(), expected: 16 });
    };
    if let Some(last) = last.first() {
        let last_column = [a[3], b[3], c[3]];
        if last[..3] != [0.0; 3] && last_column == [0.0; 3] {
            return Err(LineFault::NoRotation(
                "its last row holds the position: transpose the matrix",
            ));
        }
        if last[..3] != [0.0; 3] || (last[3] - 1.0).abs() > 1e-6 {
            return Err(LineFault::NoRotation("the last row of its matrix is not 0 0 0 1"));
        }
    }
    let matrix = Matrix3::new(a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2]);
    let departure = (matrix * matrix.transpose() - Matrix3::identity()).norm();
    if departure.is_nan() || departure > 0.1 {
        let reason = "the rows of its matrix are not of length 1 and at right angles to each other";
        return Err(LineFault::NoRotation(reason));
    }
    if matrix.determinant() < 0.0 {
        let reason = "its matrix has the determinant -1: an axis is mirrored (wanted are x right, y down, z forward)";
        return Err(LineFault::NoRotation(reason));
    }
    // The nearest rotation, as its numbers may have been written with few digits.
    let svd = matrix.svd(true, true);
    let rotation = svd.u.zip(svd.v_t).map_or(matrix, |(u, v_t)| u * v_t);
    CameraPose::new(line, None, [a[3], b[3], c[3]], rotation)
}

impl CameraPose {
    /// A pose that was computed, not read from a line.
    pub(super) fn computed(position: Vector3<f64>, rotation: Matrix3<f64>) -> Self {
        Self { line: 0, stamp_s: None, position, rotation }
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

    /// The rotation from camera to world.
    pub(super) fn turn(&self) -> UnitQuaternion<f64> {
        UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(self.rotation))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn rows(text: &str) -> Vec<Row> {
        let rows = text.lines().enumerate().map(|(index, line)| Row {
            line: index + 1,
            numbers: line.split_ascii_whitespace().map(|word| word.parse().unwrap()).collect(),
        });
        rows.collect()
    }

    /// A quarter turn to the left about z, at (1, 2, 3), in all forms.
    #[test]
    fn all_forms_of_a_pose_agree() {
        let quarter = "1 2 3 0 0 0.7071067811865476 0.7071067811865476";
        let matrix = "0 -1 0 1\n1 0 0 2\n0 0 1 3\n";
        let line = matrix.replace('\n', " ");
        for text in [
            format!("{quarter}\n{quarter}\n"),
            format!("5.5 {quarter}\n6.5 {quarter}\n"),
            format!("{line}\n{line}\n"),
            format!("{line} 0 0 0 1\n{line} 0 0 0 1\n"),
            format!("{matrix}{matrix}"),
            format!("{matrix}0 0 0 1\n{matrix}0 0 0 1\n"),
            format!("0 0 1\n{matrix}0 0 0 1\n1 1 2\n{matrix}0 0 0 1\n"),
            format!("0\n{matrix}0 0 0 1\n1\n{matrix}0 0 0 1\n"),
        ] {
            let poses = parse(&rows(&text)).unwrap();
            assert_eq!(poses.len(), 2, "{text}");
            let right = Matrix3::new(0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0);
            for pose in &poses {
                assert!((pose.rotation - right).norm() < 1e-12, "{text}");
                assert_eq!(pose.position, Vector3::new(1.0, 2.0, 3.0), "{text}");
            }
            assert_eq!(poses[1].stamp_s, text.starts_with("5.5").then_some(6.5));
        }
    }

    #[test]
    fn what_does_not_fit_is_said() {
        for (text, line, expected) in [
            ("1 2 3 0 0 0 1\n1 2 3 0 1\n", 2, "5 numbers; a pose is 7 (x y z qx qy qz qw), 8"),
            (
                "1 2 3 0 0 0 1\n9 1 2 3 0 0 0 1\n",
                2,
                "8 numbers: another form of a pose than before",
            ),
            ("1 2 3 0 0 0 2\n", 1, "not of length 1"),
            ("1 0 0 1\n0 1 0 2\n", 1, "8 fields where 16"),
            ("1 0 0 1\n0 1 0 2\n0 0 -1 3\n0 0 0 1\n", 1, "determinant -1"),
            ("1 0 0 0\n0 1 0 0\n0 0 1 0\n1 2 3 1\n", 1, "transpose"),
            ("1 0 0 1\n0 2 0 2\n0 0 1 3\n0 0 0 1\n", 1, "at right angles"),
            ("1 0 0 1\n0 1 0 2\n0 0 1 3\n0 0 0 2\n", 1, "not 0 0 0 1"),
            ("0 0 1\n1 2\n", 1, "3 numbers"),
        ] {
            let (at, fault) = parse(&rows(text)).unwrap_err();
            assert_eq!(at, line, "{text}");
            assert!(fault.to_string().contains(expected), "{fault}");
        }
    }

    #[test]
    fn a_rounded_matrix_becomes_a_rotation() {
        let pose = &parse(&rows("0.87 -0.5 0 1\n0.5 0.87 0 2\n0 0 1 3\n0 0 0 1\n")).unwrap()[0];
        let turn = pose.rotation;
        assert!((turn * turn.transpose() - Matrix3::identity()).norm() < 1e-9);
        assert!((turn[(1, 0)].atan2(turn[(0, 0)]).to_degrees() - 29.886).abs() < 1e-3);
    }

    proptest! {
        #[test]
        fn arbitrary_numbers_never_panic(
            lengths in prop::collection::vec(prop::sample::select(vec![0, 1, 3, 4, 4, 4, 7, 8, 12, 16]), 0..12),
            values in prop::collection::vec(prop::sample::select(vec![0.0, 1.0, -1.0, 1e300, 0.5]), 16),
        ) {
            let rows = lengths.iter().enumerate().map(|(index, &length)| {
                let mut numbers = values[..length].to_vec();
                numbers.rotate_left(index.min(length / 2));
                Row { line: index + 1, numbers }
            });
            if let Ok(poses) = parse(&rows.collect::<Vec<_>>()) {
                for pose in poses {
                    prop_assert!((pose.turn().norm() - 1.0).abs() < 1e-6);
                }
            }
        }
    }
}

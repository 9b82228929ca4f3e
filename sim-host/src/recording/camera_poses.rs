//! Files of camera poses, and the poses at the times of images.

use std::path::{Path, PathBuf};

use super::{
    camera_pose::{self, CameraPose, Row},
    error::{Field, LogError},
    lines::{Lines, number},
};

/// The names of pose files; the first that is there is read. Any of them may have any form.
const POSE_FILES: [&str; 5] =
    ["trajectory.log", "pose.txt", "groundtruth.txt", "trajectory.txt", "poses.txt"];

/// Maximum time in seconds between two poses for one in between to be interpolated.
const MAX_GAP_S: f64 = 0.2;
/// Maximum time in seconds to the one pose that is used for an image, as in the TUM benchmark.
const NEAR_S: f64 = 0.02;
/// Maximum displacement of a camera that stands still, in metres and radians.
const STILL: f64 = 1e-3;

/// Whether a folder contains a pose file.
pub(super) fn has_poses(folder: &Path) -> bool {
    POSE_FILES.iter().any(|name| folder.join(name).is_file())
}

/// Reads a folder's pose file. Returns its path and the poses.
pub(super) fn read_poses(folder: &Path) -> Result<(PathBuf, Vec<CameraPose>), LogError> {
    let Some(name) = POSE_FILES.into_iter().find(|name| folder.join(name).is_file()) else {
        let record = "pose.txt, trajectory.log or groundtruth.txt";
        return Err(LogError::Empty { path: folder.to_owned(), record });
    };
    let path = folder.join(name);
    let fault_at = |line, fault| LogError::Line { path: path.clone(), line, fault };
    let mut rows = Vec::new();
    let mut lines = Lines::open(&path)?;
    while let Some(line) = lines.next() {
        let (at, text) = line?;
        let text = text.trim_ascii();
        if text.is_empty() || text.starts_with('#') {
            continue;
        }
        // A matrix may have been printed with brackets and commas.
        let words = text.split(|it: char| it.is_ascii_whitespace() || "[](),;".contains(it));
        let words = words.filter(|word| !word.is_empty());
        let numbers: Result<Vec<f64>, _> =
            words.map(|word| number(word, Field::Named("pose"))).collect();
        rows.push(Row { line: at, numbers: numbers.map_err(|fault| fault_at(at, fault))? });
    }
    let poses = camera_pose::parse(&rows).map_err(|(line, fault)| fault_at(line, fault))?;
    Ok((path.clone(), poses))
}

/// The poses at the times of images, in seconds, if the poses have times: interpolated between two
/// poses, or that of one beside it. `None` for an image without a pose.
///
/// # Errors
/// [`LogError::OtherTimes`] if no image has a pose.
pub(super) fn at_times(
    path: &Path,
    poses: &[CameraPose],
    times: &[f64],
) -> Result<Vec<Option<CameraPose>>, LogError> {
    let mut stamped: Vec<(f64, &CameraPose)> =
        poses.iter().filter_map(|pose| Some((pose.stamp_s?, pose))).collect();
    stamped.sort_by(|a, b| a.0.total_cmp(&b.0));
    let found: Vec<_> = times.iter().map(|&time| at_time(&stamped, time)).collect();
    if found.iter().any(Option::is_some) || times.is_empty() {
        return Ok(found);
    }
    let span = |mut times: Box<dyn Iterator<Item = f64> + '_>| {
        let first = times.next().unwrap_or(0.0);
        [first, times.last().unwrap_or(first)]
    };
    Err(LogError::OtherTimes {
        path: path.to_owned(),
        poses_s: span(Box::new(stamped.iter().map(|(time, _)| *time))),
        images_s: span(Box::new(times.iter().copied())),
    })
}

fn at_time(stamped: &[(f64, &CameraPose)], time: f64) -> Option<CameraPose> {
    let after = stamped.partition_point(|(stamp, _)| *stamp < time);
    let next = stamped.get(after);
    let last = after.checked_sub(1).and_then(|index| stamped.get(index));
    if let (Some((from, a)), Some((to, b))) = (last, next)
        && to - from <= MAX_GAP_S
    {
        let share = (time - from) / (to - from);
        let turn = a.turn().try_slerp(&b.turn(), share, 1e-9).unwrap_or(a.turn());
        let position = a.position.lerp(&b.position, share);
        let rotation = *turn.to_rotation_matrix().matrix();
        return Some(CameraPose { line: b.line, stamp_s: Some(time), position, rotation });
    }
    let nearest = [last, next].into_iter().flatten();
    let nearest = nearest.min_by(|a, b| (a.0 - time).abs().total_cmp(&(b.0 - time).abs()))?;
    let is_near = (nearest.0 - time).abs() <= NEAR_S;
    is_near.then(|| CameraPose { stamp_s: Some(time), ..nearest.1.clone() })
}

/// Whether all these poses are the same, so that the camera stands still.
pub(super) fn is_still(poses: &[CameraPose]) -> bool {
    poses.first().is_some_and(|first| {
        poses.iter().all(|pose| {
            (pose.position - first.position).norm() < STILL
                && pose.turn().angle_to(&first.turn()) < STILL
        })
    })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::testing::{Folder, shared_data};

    #[test]
    fn a_trajectory_is_interpolated_at_the_times_of_images() {
        let folder = Folder::new("camera-poses");
        // TUM's ground truth, with its heading; the camera turns about z.
        let path = folder.file(
            "groundtruth.txt",
            b"# ground truth trajectory\n# file: 'a.bag'\n# timestamp tx ty tz qx qy qz qw\n\
              100.0 0 0 1 0 0 0 1\n100.1 0.2 0 1 0 0 0.09983342 0.99500417\n105.0 5 0 1 0 0 0 1\n",
        );
        let (read, poses) = read_poses(folder.path()).unwrap();
        assert_eq!((read, poses.len()), (path.clone(), 3));
        let times = [99.99, 99.9, 100.05, 102.0, 105.01];
        let found = at_times(&path, &poses, &times).unwrap();
        let places: Vec<_> = found.iter().map(|it| it.as_ref().map(|it| it.position.x)).collect();
        assert_eq!(places, [Some(0.0), None, Some(0.1), None, Some(5.0)]);
        let turned = found[2].as_ref().unwrap().turn();
        assert!((turned.angle() - 0.1).abs() < 1e-6, "{}", turned.angle());
        let error = at_times(&path, &poses, &[5.0]).unwrap_err().to_string();
        assert!(error.contains("from 100 to 105 s") && error.contains("one clock"), "{error}");
    }

    #[test]
    fn a_matrix_that_was_printed_is_read() {
        let folder = Folder::new("camera-matrix");
        folder.file("pose.txt", b"[[1, 0, 0, 1.5],\n [0., 1., 0., 2.],\n [0 0 1 3]\n [0 0 0 1]]\n");
        let (_, poses) = read_poses(folder.path()).unwrap();
        assert_eq!(poses[0].position.as_slice(), [1.5, 2.0, 3.0]);
        assert!(is_still(&[poses[0].clone(), poses[0].clone()]));
    }

    #[test]
    fn recorded_trajectories_are_read_under_any_name() {
        for (name, file) in [
            ("rgbd_redwood", "trajectory.log"),
            ("rgbd_frames/icl_nuim", "pose.txt"),
            ("rgbd_frames/handheld", "pose.txt"),
        ] {
            let Some(path) = shared_data(&format!("{name}/{file}")) else { return };
            let bytes = std::fs::read(path).unwrap();
            let folder = Folder::new("camera-recorded");
            folder.file("poses.txt", &bytes);
            let (_, poses) = read_poses(folder.path()).unwrap();
            assert_eq!((poses.len(), is_still(&poses)), (5, false), "{name}");
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(200))]

        #[test]
        fn arbitrary_files_never_panic(
            bytes in prop::collection::vec(any::<u8>(), 0..200),
            at in any::<prop::sample::Index>(),
            stamps in prop::collection::vec(any::<f64>(), 0..4),
        ) {
            let folder = Folder::new("camera-garbled");
            let whole = b"1 1 2 3 0 0 0 1\n2 1 2 3 0 0 0 1\n3 1 2 3 0 0 0 1\n";
            let at = at.index(whole.len());
            for bytes in [bytes.clone(), [&whole[..at], &bytes[..], &whole[at..]].concat()] {
                folder.file("pose.txt", &bytes);
                match read_poses(folder.path()) {
                    Ok((path, poses)) => {
                        let _ = is_still(&poses);
                        if let Err(error) = at_times(&path, &poses, &stamps) {
                            prop_assert_eq!(error.to_string().lines().count(), 1);
                        }
                    }
                    Err(error) => prop_assert_eq!(error.to_string().lines().count(), 1),
                }
            }
        }
    }
}

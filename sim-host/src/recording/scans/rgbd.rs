//! Reads folders of depth images with camera poses; a slice of each image becomes a scan.
//!
//! ```text
//! depth/*.png, *.pgm    16-bit grey; the images may also lie in the folder itself
//! pose.txt              one pose for each image, in any form of [`frames`](crate::recording::frames)
//! intrinsics.toml       width, height, fx, fy, cx, cy, distortion (k1, k2, p1, p2, k3; default none),
//!                       depth_per_metre (1000), row (cy); depth_noise is ignored
//! *.yaml, *.json        or the camera's file of another program, see there
//! ```
//!
//! Images are ordered by the numbers in their names, and there must be one pose for each; or both have
//! times, and images without a pose are left out. Poses
//! transform from camera to world, with the camera's x to the right and z forward; y points down,
//! or up if `fy` is negative. The up axis of the world is z unless [`Slicing::up`] says otherwise;
//! a warning is issued if the floor in the images contradicts it. A scan's pose in `map` is the
//! camera's position and forward axis seen from above. The x axis of `map` is the world's x (or its
//! y, if x is closer to the vertical).

use std::path::{Path, PathBuf};

use nalgebra::Vector3;

use super::{
    floor,
    scan_log::{Log, LoggedScan},
    slicing::{DepthSlice, Slicing, Stance, UpAxis},
};
use crate::recording::{
    camera_pose::CameraPose,
    camera_poses::{at_times, read_poses},
    error::{LineFault, LogError},
    exposure::{ExposureCounts, ExposureRule},
    format::Format,
    image_times::image_times,
    intrinsics::{self, IntrinsicsFile},
    numbered_files::{PICTURE_KINDS, depth_images, files_in, number_in},
    time_stamps,
};

/// Maximum tilt of a camera in degrees: a steeper one is refused.
const MAX_TILT_DEG: f64 = 75.0;

/// Tilt in degrees above which a note tells the user that a row is not a level slice.
const TILTED_DEG: f64 = 10.0;

/// Angle in degrees between the up axis and the normal of the floor in the images above which a
/// warning is issued.
const FLOOR_DEG: f64 = 5.0;

/// Reads a folder of depth images.
pub(super) fn read(folder: &Path, slicing: Slicing) -> Result<Log, LogError> {
    let mut images = depth_images(folder)?;
    let (pose_file, mut poses) = read_poses(folder)?;
    let mut notes = Vec::new();
    let has_stamps = poses.iter().all(|pose| pose.stamp_s.is_some());
    if let Some(times) = image_times(&images)?.filter(|_| has_stamps) {
        let found = at_times(&pose_file, &poses, &times)?;
        let mut has_pose = found.iter().map(Option::is_some);
        images.retain(|_| has_pose.next().unwrap_or(false));
        poses = found.into_iter().flatten().collect();
        if poses.len() < times.len() {
            let lost = times.len() - poses.len();
            notes.push(format!("{lost} of {} images have no pose and are left out", times.len()));
        }
    }
    if images.len() != poses.len() {
        let (images, poses) = (images.len(), poses.len());
        return Err(LogError::Poses { path: pose_file, images, poses });
    }
    let intrinsics = intrinsics::required(folder, slicing.depth_per_metre)?;
    if intrinsics.distortion != [0.0; 5] {
        notes.push("the distortion of the lens is ignored".to_owned());
    }

    let planar = Plane::under(&poses, intrinsics.fy.signum(), slicing.up)
        .ok_or_else(|| LogError::NoPlane { path: pose_file.clone() })?;
    let mut warnings = Vec::from_iter(planar.floor_warning(&images, &poses, &intrinsics)?);
    let mut steepest_deg = 0.0_f64;
    let mut planar_poses = Vec::new();
    for pose in &poses {
        let tilt_deg = planar.tilt_deg(pose);
        if tilt_deg > MAX_TILT_DEG {
            let fault = LineFault::Steep { tilt_deg };
            return Err(LogError::Line { path: pose_file, line: pose.line, fault });
        }
        steepest_deg = steepest_deg.max(tilt_deg);
        planar_poses.push(planar.pose(pose));
    }
    if steepest_deg > TILTED_DEG && slicing.slice != DepthSlice::Height {
        notes.push(format!(
            "the camera is tilted by up to {steepest_deg:.0} degrees; its rows are no level \
             slices, as --slice height gives"
        ));
    }
    let pictures = match slicing.exposure {
        ExposureRule::Any => vec![None; images.len()],
        _ => pictures(folder, &images)?.into_iter().map(Some).collect(),
    };
    let mut exposure = ExposureCounts::default();
    let files = images.iter().zip(&pictures).zip(planar.stances(&poses));
    let slices: Result<Vec<_>, _> = files
        .map(|((image, picture), stance)| {
            let slice = slicing.slice((image, picture.as_deref()), &intrinsics, &stance);
            slice.map(|(readings, counts)| {
                exposure += counts;
                readings
            })
        })
        .collect();
    let slices = slices?;
    if slicing.exposure != ExposureRule::Any {
        let ExposureCounts { valid, masked } = exposure;
        notes.push(format!("exposure: {masked} of {valid} depths are left out"));
    }

    let stamps: Option<Vec<f64>> = poses.iter().map(|pose| pose.stamp_s).collect();
    let (times, warning) = time_stamps::repair(stamps.as_deref(), poses.len());
    warnings.extend(warning);
    let scans = slices.into_iter().zip(times).zip(planar_poses).enumerate().map(
        |(index, ((readings_mm, time), pose))| LoggedScan {
            time,
            readings_mm,
            pose: Some(pose),
            odometry: None,
            line: index + 1,
        },
    );
    let sensor = slicing.sensor(&intrinsics);
    let exposure = (slicing.exposure != ExposureRule::Any).then_some(exposure);
    Ok(Log { format: Format::Rgbd, sensor, scans: scans.collect(), exposure, warnings, notes })
}

/// The pictures that belong to depth images, by the numbers in their names.
fn pictures(folder: &Path, images: &[PathBuf]) -> Result<Vec<PathBuf>, LogError> {
    let place = ["color", "rgb"].map(|name| folder.join(name)).into_iter().find(|it| it.is_dir());
    let place = place.unwrap_or_else(|| folder.join("color"));
    let all = files_in(&place, &PICTURE_KINDS)?;
    let of = |image: &PathBuf| {
        let picture = all.iter().find(|picture| number_in(picture) == number_in(image));
        let record = "picture with the number of each depth image, which --exposure needs";
        picture.cloned().ok_or(LogError::Empty { path: place.clone(), record })
    };
    images.iter().map(of).collect()
}

/// The horizontal plane of the world, with the axes of `map` in it.
struct Plane {
    up: Vector3<f64>,
    x: Vector3<f64>,
    y: Vector3<f64>,
    down_sign: f64,
}

impl Plane {
    /// The horizontal plane for the up axis `up`. `None` if that is the mean of the cameras' up
    /// axes, and they cancel out. `down_sign` is 1 if the camera's y points down; it is -1 if y
    /// points up, which mirrors the world.
    fn under(poses: &[CameraPose], down_sign: f64, up: UpAxis) -> Option<Self> {
        let up = match up {
            UpAxis::X => Vector3::x(),
            UpAxis::Y => Vector3::y(),
            UpAxis::Z => Vector3::z(),
            UpAxis::MinusX => -Vector3::x(),
            UpAxis::MinusY => -Vector3::y(),
            UpAxis::MinusZ => -Vector3::z(),
            UpAxis::Cameras => {
                let ups = poses.iter().map(|pose| pose.rotation.column(1) * -down_sign);
                let mean = ups.sum::<Vector3<f64>>() / poses.len().max(1) as f64;
                mean.try_normalize(0.2)?
            }
        };
        let seed = if up.x.abs() < 0.7 { Vector3::x() } else { Vector3::y() };
        let x = (seed - up * up.dot(&seed)).normalize();
        let y = up.cross(&x) * down_sign;
        Some(Self { up, x, y, down_sign })
    }

    /// A warning if the floor in the images is not perpendicular to the up axis.
    fn floor_warning(
        &self,
        images: &[PathBuf],
        poses: &[CameraPose],
        intrinsics: &IntrinsicsFile,
    ) -> Result<Option<String>, LogError> {
        let Some(normal) = floor::normal(images, poses, intrinsics)? else { return Ok(None) };
        let off_deg = self.up.dot(&normal).clamp(-1.0, 1.0).acos().to_degrees();
        let axis = |value: f64| (value * 100.0).round() / 100.0 + 0.0;
        let [x, y, z] = [normal.x, normal.y, normal.z].map(axis);
        Ok((off_deg > FLOOR_DEG).then(|| {
            format!(
                "the floor in the images is {off_deg:.0} degrees off: its normal is ({x}, {y}, {z}) \
                 in the world of the poses; name the axis that points up with --up"
            )
        }))
    }

    /// Angle of the optical axis above or below the horizon, in degrees.
    fn tilt_deg(&self, pose: &CameraPose) -> f64 {
        self.up.dot(&pose.forward()).clamp(-1.0, 1.0).asin().to_degrees().abs()
    }

    /// The attitude and height of each camera; heights are relative to their mean.
    fn stances(&self, poses: &[CameraPose]) -> Vec<Stance> {
        let height = |pose: &CameraPose| self.up.dot(&pose.position);
        let mean = poses.iter().map(height).sum::<f64>() / poses.len().max(1) as f64;
        let sinks = |pose: &CameraPose, axis: usize| -self.up.dot(&pose.rotation.column(axis));
        let stance = |pose| Stance {
            pitch: sinks(pose, 2).clamp(-1.0, 1.0).asin(),
            roll: sinks(pose, 0).atan2(sinks(pose, 1) * self.down_sign),
            above_m: height(pose) - mean,
        };
        poses.iter().map(stance).collect()
    }

    fn pose(&self, pose: &CameraPose) -> [f64; 3] {
        let seen = |vector: &Vector3<f64>| (self.x.dot(vector), self.y.dot(vector));
        let (x, y) = seen(&pose.position);
        let (forward_x, forward_y) = seen(&pose.forward());
        [x, y, forward_y.atan2(forward_x)]
    }
}

#[cfg(test)]
mod tests {
    use image::{ImageBuffer, Luma};
    use nalgebra::{Matrix3, UnitQuaternion};

    use super::*;
    use crate::{
        recording::{self, Sensor, scans::odometry::compose},
        testing::{Folder, shared_frames},
    };

    const INTRINSICS: &str = "width = 4\nheight = 3\nfx = 2.0\nfy = 2.0\ncx = 1.5\ncy = 1.0\n";

    fn depth_png(folder: &Folder, name: &str, samples: [u16; 12]) {
        let image: ImageBuffer<Luma<u16>, _> =
            ImageBuffer::from_raw(4, 3, samples.to_vec()).unwrap();
        let mut bytes = std::io::Cursor::new(Vec::new());
        image.write_to(&mut bytes, image::ImageFormat::Png).unwrap();
        folder.file(name, &bytes.into_inner());
    }

    fn two_frames(name: &str) -> Folder {
        let folder = Folder::new(name);
        depth_png(&folder, "depth/10.png", [5; 12]);
        depth_png(&folder, "depth/9.png", [1, 1, 1, 1, 0, 1_000, 2_000, 65_535, 3, 3, 3, 3]);
        folder.file("intrinsics.toml", INTRINSICS.as_bytes());
        // At first the camera's z points along the world's x, and its y along -z. Then the camera
        // turns left by 90 degrees.
        folder.file("pose.txt", b"1 2 0.5 -0.5 0.5 -0.5 0.5\n3 4 0.5 -0.70710678 0 0 0.70710678\n");
        folder
    }

    #[test]
    fn rows_and_poses_follow_the_order_of_the_frames() {
        let log = recording::read(two_frames("rgbd").path(), None, Slicing::default()).unwrap();
        assert_eq!(log.sensor, Sensor::Pinhole { fx: 2.0, cx: 1.5, width: 4 });
        assert_eq!(log.scans[0].readings_mm, [0, 1_000, 2_000, 0]);
        assert_eq!(log.scans[1].readings_mm, [5; 4]);
        let near = |pose: Option<[f64; 3]>, expected: [f64; 3]| {
            let pose = pose.unwrap();
            assert!(pose.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{pose:?}");
        };
        near(log.scans[0].pose, [1.0, 2.0, 0.0]);
        near(log.scans[1].pose, [3.0, 4.0, std::f64::consts::FRAC_PI_2]);
    }

    #[test]
    fn the_row_and_the_scale_can_be_set() {
        let folder = two_frames("rgbd-row");
        let asked = format!("{INTRINSICS}row = 2\ndepth_per_metre = 5000\n");
        folder.file("intrinsics.toml", asked.replace("5000", "100").as_bytes());
        let log = read(folder.path(), Slicing::default()).unwrap();
        assert_eq!(log.scans[0].readings_mm, [30; 4]);
        folder.file("depth/9.pgm", b"P2 4 3 10000 0 0 0 0 0 0 0 0 1 2 9999 10000");
        std::fs::remove_file(folder.path().join("depth/9.png")).unwrap();
        let log = read(folder.path(), Slicing::default()).unwrap();
        assert_eq!(log.scans[0].readings_mm[..2], [10, 20]);
    }

    #[test]
    fn badly_exposed_pixels_are_left_out_by_the_picture_of_the_same_number() {
        let folder = two_frames("rgbd-exposure");
        let read = |exposure| read(folder.path(), Slicing { exposure, ..Slicing::default() });
        assert_eq!(read(ExposureRule::Any).unwrap().exposure, None);
        let error = read(ExposureRule::Mask).unwrap_err().to_string();
        assert!(error.contains("color"), "{error}");
        let picture = |name: &str, row: &str| {
            let text = format!("P2 4 3 255 {row} {row} {row}");
            folder.file(&format!("rgb/{name}.pgm"), text.as_bytes());
        };
        picture("0009", "255 128 128 6");
        let error = read(ExposureRule::Mask).unwrap_err().to_string();
        assert!(error.contains("picture with the number of each depth image"), "{error}");
        picture("0010", "255 12 12 6");
        let masked = read(ExposureRule::Mask).unwrap();
        assert_eq!(masked.scans[0].readings_mm, [0, 1_000, 2_000, 0]);
        assert_eq!(masked.scans[1].readings_mm, [0, 5, 5, 0]);
        // Of the first image, row 0 has 4 depths, row 1 has 2 and row 2 has 4.
        assert_eq!(masked.exposure, Some(ExposureCounts { valid: 22, masked: 10 }));
        let normalised = read(ExposureRule::Normalise).unwrap();
        assert_eq!(normalised.scans[1].readings_mm, [0, 5, 5, 5]);
        folder.file("rgb/0010.pgm", b"P2 1 1 255 7");
        let error = read(ExposureRule::Mask).unwrap_err().to_string();
        assert!(error.contains("0010.pgm") && error.contains("1 x 1 pixels"), "{error}");
    }

    #[test]
    fn faults_name_the_file() {
        let folder = two_frames("rgbd-faults");
        let error = || read(folder.path(), Slicing::default()).unwrap_err().to_string();
        let pose = std::fs::read(folder.path().join("pose.txt")).unwrap();
        for (text, expected) in [
            (&b"1 2 3 0 0 0 1\n"[..], "2 depth images but 1 pose"),
            (b"1 2 3 0 0 0 1\n1 2 3 0 0 nan 1\n", "pose.txt:2: pose: \"nan\""),
            (b"1 2 3 0 0 0 1\n1 2 3 0 0 0 0\n", "pose.txt:2: not a rotation"),
            (b"1 2 3 0 0 0 1\n1 2 3 0 0 0\n", "pose.txt:2: 6 numbers; a pose is 7"),
            (b"1 2 3 0 0 0 1\n1 2 3 1 0 0 0\n", "up"),
            (b"\xff\xfe", "pose.txt:1: not text"),
        ] {
            folder.file("pose.txt", text);
            let error = error();
            assert!(error.contains(expected), "{error}");
        }
        folder.file("pose.txt", &pose);
        for (text, expected) in [
            (INTRINSICS.replace("fx = 2.0\n", ""), "fx"),
            (INTRINSICS.replace("fx = 2.0", "fx = nan"), "fx"),
            (INTRINSICS.replace("cy = 1.0", "cy = 9.0"), "cy"),
            (INTRINSICS.replace("width = 4", "width = 5"), "4 x 3 pixels where 5 x 3"),
        ] {
            folder.file("intrinsics.toml", text.as_bytes());
            let error = error();
            assert!(error.contains(expected), "{error}");
        }
        folder.file("intrinsics.toml", INTRINSICS.as_bytes());
        folder.file("depth/9.png", b"P5 4 3 255\n............");
        assert!(error().contains("9.png"));
        folder.file("depth/9.png", b"");
        assert!(error().contains("9.png"));
    }

    /// The points of a scan in `map`.
    fn points(log: &Log, scan: &LoggedScan) -> Vec<[f64; 2]> {
        let Sensor::Pinhole { fx, cx, .. } = log.sensor else { return Vec::new() };
        let pose = scan.pose.unwrap();
        let measured = scan.readings_mm.iter().enumerate().filter(|(_, depth)| **depth > 0);
        measured
            .map(|(column, depth)| {
                let x = f64::from(*depth) / 1000.0;
                let point = compose(pose, [x, (cx - column as f64) * x / fx, 0.0]);
                [point[0], point[1]]
            })
            .collect()
    }

    #[test]
    fn scans_of_recorded_frames_coincide() {
        // Some of the five frames of each data set look in different directions.
        for (name, share) in
            [("rgbd_redwood", 0.9), ("rgbd_frames/icl_nuim", 0.15), ("rgbd_frames/handheld", 0.4)]
        {
            let Some(frames) = shared_frames(name) else { continue };
            let slicing = Slicing { up: UpAxis::Cameras, ..Slicing::default() };
            let log = recording::read(frames.path(), None, slicing).unwrap();
            assert_eq!((log.scans.len(), log.sensor.readings()), (5, 640), "{name}");
            let mut matched = 0;
            let mut measured = 0;
            for pair in log.scans.windows(2) {
                let (before, after) = (points(&log, &pair[0]), points(&log, &pair[1]));
                let is_near =
                    |p: &&[f64; 2]| before.iter().any(|q| (p[0] - q[0]).hypot(p[1] - q[1]) < 0.1);
                matched += after.iter().filter(is_near).count();
                measured += after.len();
            }
            assert!(matched as f64 > share * measured as f64, "{name}: {matched} of {measured}");
        }
    }

    #[test]
    fn intrinsics_are_never_guessed() {
        let folder = two_frames("rgbd-guess");
        std::fs::remove_file(folder.path().join("intrinsics.toml")).unwrap();
        let error = read(folder.path(), Slicing::default()).unwrap_err().to_string();
        assert!(error.contains("intrinsics.toml: intrinsics: missing; write width"), "{error}");
    }

    #[test]
    fn z_is_up_and_a_floor_that_is_not_level_is_said() {
        let folder = Folder::new("rgbd-floor");
        folder.file(
            "intrinsics.toml",
            b"width = 80\nheight = 60\nfx = 60.0\nfy = 60.0\ncx = 39.5\ncy = 29.5\n",
        );
        // The camera is 1 m above the floor and looks 26 degrees down.
        let (sin, cos) = 26f64.to_radians().sin_cos();
        let image: ImageBuffer<Luma<u16>, _> = ImageBuffer::from_fn(80, 60, |_, row| {
            let sinks = sin + cos * (f64::from(row) - 29.5) / 60.0;
            Luma([if sinks > 0.2 { (1e3 / sinks) as u16 } else { 0 }])
        });
        let mut bytes = std::io::Cursor::new(Vec::new());
        image.write_to(&mut bytes, image::ImageFormat::Png).unwrap();
        folder.file("1.png", &bytes.into_inner());
        let axes = Matrix3::new(0.0, -sin, cos, -1.0, 0.0, 0.0, 0.0, -cos, -sin);
        let turn = UnitQuaternion::from_matrix(&axes).into_inner();
        folder.file(
            "pose.txt",
            format!("0 0 1 {} {} {} {}", turn.i, turn.j, turn.k, turn.w).as_bytes(),
        );
        let notes = |up| {
            let log = read(folder.path(), Slicing { up, ..Slicing::default() }).unwrap();
            log.warnings.into_iter().filter(|it| it.contains("floor")).collect::<Vec<_>>()
        };
        assert!(notes(UpAxis::Z).is_empty(), "{:?}", notes(UpAxis::Z));
        let [note] = &notes(UpAxis::Cameras)[..] else { panic!() };
        assert!(note.contains("is 26 degrees off: its normal is (0, 0, 1)"), "{note}");
        assert!(notes(UpAxis::Y)[0].contains("is 90 degrees off"));
    }
}

//! `cameras.toml`: the poses and fields of view of a room's cameras.
//!
//! All commands use the same form: `ubimap place` and `ubimap calibrate` write it; its `[[cameras]]` can be copied into a
//! scenario of `ubimap simulate`; and `ubimap watch` takes from it the pose of each camera whose
//! folder has no `pose.txt`, by the folder's name.
//!
//! ```toml
//! [[cameras]]
//! name = "camera-00"
//! position_m = [1.25, 0.75, 2.9]  # the optical centre in `map`
//! heading_deg = 90.0              # counter-clockwise from x
//! tilt_deg = 60.0                 # 0 level, 90 straight down
//! horizontal_fov_deg = 87.0
//! vertical_fov_deg = 58.0
//! range_m = 8.0
//! ```
//!
//! Instead of heading and tilt, `look_at_m` can give the point in the centre of the image. With heading
//! and tilt, `roll_deg` can give the angle by which the right side of the image is below the
//! horizontal (see [`Orientation`]). Other keys of a scenario's cameras are allowed, and are kept.

use nalgebra::{Isometry3, Translation3};
use serde::{Deserialize, Serialize};

use super::{Intrinsics, Orientation};

/// The name of the file in the folder of a recording.
pub const CAMERAS_FILE: &str = "cameras.toml";

/// The cameras of a room.
#[derive(Clone, Debug, Default, Deserialize, PartialEq, Serialize)]
pub struct CamerasFile {
    /// Each camera.
    pub cameras: Vec<MountedCamera>,
}

/// A camera at its place.
#[derive(Clone, Debug, Default, Deserialize, PartialEq, Serialize)]
pub struct MountedCamera {
    /// The name, which is also that of the camera's folder in a recording.
    #[serde(default)]
    pub name: String,
    /// The optical centre of the depth sensor in `map`, in metres.
    pub position_m: [f64; 3],
    /// The point in the centre of the image, in `map`, in metres.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub look_at_m: Option<[f64; 3]>,
    /// Direction in which it faces, counter-clockwise from x, in degrees. For a camera that looks
    /// straight down, the top of the image is on this side.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub heading_deg: Option<f64>,
    /// Downward tilt in degrees: 0 is level, 90 straight down.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tilt_deg: Option<f64>,
    /// Angle by which the right side of the image is below the horizontal, in degrees; zero if not
    /// stated.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub roll_deg: Option<f64>,
    /// Angle from the left to the right edge of the depth image, in degrees.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub horizontal_fov_deg: Option<f64>,
    /// Angle from the upper to the lower edge of the depth image, in degrees.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub vertical_fov_deg: Option<f64>,
    /// Maximum range, in metres.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub range_m: Option<f64>,
    /// All other keys.
    #[serde(flatten)]
    pub rest: toml::Table,
}

impl CamerasFile {
    /// Parses the text of a file.
    ///
    /// # Errors The problem with the text, on one line.
    pub fn parse(text: &str) -> Result<Self, String> {
        let file: Self =
            toml::from_str(text).map_err(|error| error.message().replace('\n', ", "))?;
        for (index, camera) in file.cameras.iter().enumerate() {
            if camera.orientation().is_none() {
                let key = format!("cameras[{index}]");
                return Err(format!(
                    "{key} needs either look_at_m, or heading_deg and tilt_deg (with them also roll_deg)"
                ));
            }
        }
        Ok(file)
    }

    /// The cameras as a text that [`CamerasFile::parse`] reads.
    pub fn to_toml(&self) -> String {
        // Plain tables with string keys, so serialising them can't fail.
        toml::to_string(self).unwrap_or_default()
    }

    /// The camera of this name.
    pub fn named(&self, name: &str) -> Option<&MountedCamera> {
        self.cameras.iter().find(|camera| camera.name == name)
    }
}

impl MountedCamera {
    /// The pose of the optical frame (x right, y down, z forward) in `map`, in metres. `None` if no
    /// direction is stated, or two.
    pub fn pose(&self) -> Option<Isometry3<f64>> {
        let rotation = self.orientation()?.rotation();
        Some(Isometry3::from_parts(Translation3::from(self.position_m), rotation))
    }

    /// States the pose of the optical frame in `map` by position, heading, tilt and, if the x axis
    /// of the image is not level, roll.
    pub fn set_pose(&mut self, pose: &Isometry3<f64>) {
        let Orientation { heading_rad, tilt_rad, roll_rad } = Orientation::of(&pose.rotation);
        self.position_m = pose.translation.vector.into();
        self.look_at_m = None;
        self.heading_deg = Some(heading_rad.to_degrees());
        self.tilt_deg = Some(tilt_rad.to_degrees());
        self.roll_deg = Some(roll_rad.to_degrees()).filter(|it| *it != 0.0);
    }

    /// A pinhole with the stated fields of view for an image of this size, in pixels; `None` if they
    /// are not stated.
    pub fn intrinsics(&self, width: u32, height: u32) -> Option<Intrinsics> {
        let focal = |size: u32, fov: f64| f64::from(size) / 2.0 / libm::tan(fov.to_radians() / 2.0);
        let fx = focal(width, self.horizontal_fov_deg?);
        let fy = focal(height, self.vertical_fov_deg?);
        Some(Intrinsics { fx, fy, ..Intrinsics::pinhole(width, height, 1.0) })
    }

    /// The stated orientation.
    fn orientation(&self) -> Option<Orientation> {
        match (self.look_at_m, self.heading_deg, self.tilt_deg, self.roll_deg) {
            (None, Some(heading), Some(tilt), roll) => Some(Orientation {
                heading_rad: heading.to_radians(),
                tilt_rad: tilt.to_radians(),
                roll_rad: roll.unwrap_or(0.0).to_radians(),
            }),
            (Some(look_at), None, None, None) => {
                let [x, y, z] = [0, 1, 2].map(|axis| look_at[axis] - self.position_m[axis]);
                Some(Orientation {
                    heading_rad: libm::atan2(y, x),
                    tilt_rad: libm::atan2(-z, libm::hypot(x, y)),
                    roll_rad: 0.0,
                })
            }
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Lens;

    fn camera(text: &str) -> MountedCamera {
        let text = format!("[[cameras]]\nposition_m = [1.0, 2.0, 3.0]\n{text}");
        CamerasFile::parse(&text).unwrap().cameras.remove(0)
    }

    #[test]
    fn a_camera_looks_where_it_is_said_to() {
        let stated = "horizontal_fov_deg = 90.0\nvertical_fov_deg = 60.0\n";
        for (text, middle, above) in [
            // If a camera looks straight down, the top of its image is towards its heading.
            ("heading_deg = 90.0\ntilt_deg = 90.0", [1.0, 2.0, 0.0], [1.0, 2.5, 0.0]),
            ("heading_deg = 0.0\ntilt_deg = 45.0", [4.0, 2.0, 0.0], [4.5, 2.0, 0.0]),
            ("look_at_m = [1.0, -1.0, 0.0]", [1.0, -1.0, 0.0], [1.0, -1.5, 0.0]),
        ] {
            let camera = camera(&format!("{text}\n{stated}"));
            let intrinsics = camera.intrinsics(640, 480).unwrap();
            let lens = Lens::new(intrinsics, camera.pose().unwrap()).unwrap();
            let [column, row] = lens.project(&middle.into()).unwrap();
            assert!((column - 319.5).abs() < 1e-6 && (row - 239.5).abs() < 1e-6, "{text}");
            let [column, row] = lens.project(&above.into()).unwrap();
            assert!((column - 319.5).abs() < 1e-6 && row < 239.0, "{text}: {row}");
        }
        // The edges of the image are at half the field of view.
        let intrinsics = camera(&format!("look_at_m = [0.0, 0.0, 0.0]\n{stated}"));
        let intrinsics = intrinsics.intrinsics(640, 480).unwrap();
        assert!((intrinsics.fx - 320.0).abs() < 1e-9);
        assert!((intrinsics.fy - 240.0 / 30f64.to_radians().tan()).abs() < 1e-9);
    }

    #[test]
    fn what_is_written_is_read_again_and_other_keys_stay() {
        let text = "[[cameras]]\nname = \"a\"\nposition_m = [0.0, 0.0, 2.0]\nheading_deg = 0.0\n\
                    tilt_deg = 60.0\nrate_hz = 5.0\ndepth = { width = 320 }\n";
        let file = CamerasFile::parse(text).unwrap();
        assert_eq!(file.named("a").unwrap().rest["rate_hz"].as_float(), Some(5.0));
        assert_eq!(CamerasFile::parse(&file.to_toml()), Ok(file));
    }

    #[test]
    fn a_pose_is_written_and_read_again() {
        for turn in [[0.1, -2.0, 0.7], [3.0, 0.2, -0.4], [2.2, 2.2, 0.0]] {
            let pose = Isometry3::new([1.0, -2.0, 2.9].into(), turn.into());
            let mut camera = MountedCamera { name: "a".into(), ..MountedCamera::default() };
            camera.set_pose(&pose);
            let text = CamerasFile { cameras: vec![camera] }.to_toml();
            let again = CamerasFile::parse(&text).unwrap().cameras[0].pose().unwrap();
            assert!((again.to_homogeneous() - pose.to_homogeneous()).norm() < 1e-12, "{text}");
        }
    }

    #[test]
    fn a_direction_is_stated_once() {
        for text in [
            "",
            "heading_deg = 0.0",
            "tilt_deg = 1.0\nlook_at_m = [0.0, 0.0, 0.0]",
            "roll_deg = 1.0\nlook_at_m = [0.0, 0.0, 0.0]",
        ] {
            let text = format!("[[cameras]]\nposition_m = [1.0, 2.0, 3.0]\n{text}");
            assert!(CamerasFile::parse(&text).unwrap_err().contains("cameras[0] needs either"));
        }
        assert!(CamerasFile::parse("[[cameras]]\n").unwrap_err().contains("position_m"));
    }
}

//! A robot's grey camera: what it sees while the robot drives, and what its distances mean.

use libm::{cos, sin};
use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion};
use parry2d_f64::glamx::DVec2;
use rand_chacha::ChaCha8Rng;
use ubimap_protocol::{time::Instant, units::Pose};

use super::{
    plane_pose::PlanePose,
    render::{GreyCamera, Paint, Part, Scene},
    scenario::{Scenario, ScenarioError},
    sensor::RangeSensor,
    shapes::{Footprint, Prism},
    streams::Stream,
};
use crate::camera::Intrinsics;

/// Columns and lines of a picture (Ahmed, equation 1).
const SIZE: (u32, u32) = (320, 240);
/// Lines from the bottom of a picture up to the horizon. There the distances in Ahmed's table 1 tend to
/// infinity: 121 pixels of floor are 3.4 times as far as 62.
const HORIZON: f64 = 144.0;
/// Standard deviation of a pixel, in grey levels.
const NOISE: f64 = 2.5;

/// One picture of a robot's grey camera.
#[derive(Clone, Debug, PartialEq)]
pub struct LookEvent {
    /// The robot's index in [`World::robots`](super::World::robots).
    pub robot: usize,
    /// When it was taken, in the server's clock.
    pub taken: Instant,
    /// Grey levels, top line first.
    pub picture: Vec<u8>,
    /// The depth of the nearest surface at the camera's height in each column, in millimetres; zero if
    /// there is none. For scoring only.
    pub depths_mm: Vec<u16>,
    /// True pose: `base_link` in `map`. For scoring only.
    pub truth: Pose,
}

/// The camera of a robot.
pub(super) struct GreyEye {
    camera: GreyCamera,
    dice: ChaCha8Rng,
}

impl GreyEye {
    /// The camera of a sensor with this field of view.
    pub(super) fn new(sensor: &RangeSensor, mut dice: ChaCha8Rng) -> Option<Self> {
        let level = Intrinsics::pinhole(SIZE.0, SIZE.1, -2.0 * sensor.first_angle_rad());
        let intrinsics = Intrinsics { cy: f64::from(SIZE.1) - HORIZON - 0.5, ..level };
        let camera = GreyCamera::new(intrinsics, NOISE, &mut dice).ok()?;
        Some(Self { camera, dice })
    }

    /// The grey levels of a picture from a pose of the robot, top line first.
    pub(super) fn look(
        &mut self,
        sensor: &RangeSensor,
        robot: PlanePose,
        scene: &Scene,
    ) -> Option<Vec<u8>> {
        let (at, heading, _) = sensor.view(robot);
        let (sin, cos) = (sin(heading), cos(heading));
        // The optical frame: x to the right, y down, z ahead.
        let axes = [[sin, -cos, 0.0], [0.0, 0.0, -1.0], [cos, sin, 0.0]].map(Into::into);
        let turn = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&axes));
        let turn = UnitQuaternion::from_rotation_matrix(&turn);
        let place = Translation3::new(at.x, at.y, sensor.height_m());
        let pose = Isometry3::from_parts(place, turn);
        Some(self.camera.take(scene, pose, &mut self.dice)?.into_raw())
    }
}

/// Reflectance of the board.
const BOARD: f32 = 0.12;

/// An empty hall in which a camera is calibrated.
const HALL: &str = "duration_s = 1.0\nslice_height_m = 0.1\n[room]\noutline_m = [[-9.0, -9.0], [9.0, -9.0], [9.0, 9.0], [-9.0, 9.0]]\nheight_m = 3.0\nseamless = true\n";

/// Pictures of an upright board, one for each of these distances in metres from the sensor along its
/// axis: what a robot's owner takes to measure table 1 ("an object was placed at some distance from
/// the robot").
///
/// # Errors
/// [`ScenarioError`]: never, the hall is built in.
pub fn pictures_of_a_board(
    sensor: &RangeSensor,
    distances_m: &[f64],
    seed: u64,
) -> Result<Vec<Vec<u8>>, ScenarioError> {
    let scenario: Scenario = Scenario::from_toml(HALL, "the hall for calibrating grey cameras")?;
    let room = std::sync::Arc::new(super::changes::Changes::new(&scenario, None).room()?);
    let robot = PlanePose { position: DVec2::ZERO, heading: 0.0 };
    let (eye_at, heading, _) = sensor.view(robot);
    let ahead = DVec2::new(cos(heading), sin(heading));
    let mut eye = GreyEye::new(sensor, Stream::Eye.rng(seed, 0));
    let pictures = distances_m.iter().filter_map(|distance| {
        const THICK: f64 = 0.02;
        let middle = eye_at + ahead * (distance + THICK / 2.0);
        let footprint = Footprint::rectangle(middle, DVec2::new(THICK, 0.5), heading);
        let prism = Prism { footprint, bottom: 0.0, top: 0.4 };
        let board = Part { prism, paint: Paint::grey(BOARD) };
        let scene = Scene { room: room.clone(), moving: vec![board] };
        eye.as_mut()?.look(sensor, robot, &scene)
    });
    Ok(pictures.collect())
}

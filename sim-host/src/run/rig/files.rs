//! The files for the server and the robots of a rig.

use std::{
    fs::{self, OpenOptions},
    io::{self, Write},
    path::Path,
};

use toml::{Table, Value};

use crate::{
    camera::{Calibration, FrameSource, Lens, MountedCamera},
    recording::IntrinsicsFile,
    run::{
        RunError,
        robot::{LIDAR, RobotFile},
        simulate::{RESOLUTION, registry},
    },
    world::{Scenario, SimRobot, World},
};

/// The range within which robots map: that of the images with a lidar.
const FARTHEST_M: f64 = 2.5;

/// The name of a camera's socket.
pub(super) fn socket(camera: usize) -> String {
    format!("camera-{camera:02}.sock")
}

/// The error for a file that can't be made.
pub(super) fn refused(path: &Path, error: &io::Error) -> RunError {
    RunError::Deployment { path: path.to_owned(), reason: error.to_string() }
}

/// Writes the deployment and the robots' configurations, if they are not there yet.
pub(super) fn write(
    folder: &Path,
    scenario: &Scenario,
    world: &World,
    (port, lidars): (u16, &[u16]),
) -> Result<(), RunError> {
    let mut deployment = Table::new();
    deployment.insert("resolution_m".into(), RESOLUTION.metres().into());
    deployment.insert("store".into(), "map.db".into());
    deployment.insert("ports".into(), vec![Value::from(format!("udp:{port}"))].into());
    let cameras = FrameSource::cameras(world).iter().enumerate();
    let cameras = cameras.map(|(index, camera)| Value::from(camera_keys(index, camera)));
    deployment.insert("cameras".into(), cameras.collect::<Vec<_>>().into());
    let robots = registry(scenario).to_toml();
    // Plain structs and tables: serialising them can't fail.
    let mut deployment = Value::Table(deployment);
    round(&mut deployment);
    let text = toml::to_string(&deployment).unwrap_or_default() + "\n" + &robots;
    keep_or_write(&folder.join("deployment.toml"), &text)?;
    for robot in world.robots() {
        let number = robot.id().0;
        let file = robot_file(robot, port, lidars.contains(&number));
        let text = toml::to_string(&file).unwrap_or_default();
        keep_or_write(&folder.join(format!("robot-{number}.toml")), &text)?;
    }
    Ok(())
}

/// Rounds numbers to millionths: of a metre, a degree or a pixel.
fn round(value: &mut Value) {
    match value {
        Value::Float(number) => *number = rounded(*number),
        Value::Array(values) => values.iter_mut().for_each(round),
        Value::Table(table) => table.iter_mut().for_each(|(_, value)| round(value)),
        _ => {}
    }
}

fn rounded(number: f64) -> f64 {
    // Without the sign of a negative zero.
    (number * 1e6).round() / 1e6 + 0.0
}

fn keep_or_write(path: &Path, text: &str) -> Result<(), RunError> {
    if fs::symlink_metadata(path).is_ok() {
        log::info!("{}: kept as it is", path.display());
        return Ok(());
    }
    let opened = OpenOptions::new().write(true).create_new(true).open(path);
    opened
        .and_then(|mut file| file.write_all(text.as_bytes()))
        .map_err(|error| refused(path, &error))
}

fn camera_keys(index: usize, calibration: &Calibration) -> Table {
    let mut mounted =
        MountedCamera { name: format!("camera-{index:02}"), ..MountedCamera::default() };
    if let Some(pose) = calibration.pose() {
        mounted.set_pose(pose);
    }
    let mut keys = Table::try_from(mounted).unwrap_or_default();
    keys.insert("source".into(), format!("stream:{}", socket(index)).into());
    let noise = Some(&calibration.depth_noise).filter(|_| calibration.depth.is_some());
    let sensors = [("depth", &calibration.depth, noise), ("picture", &calibration.picture, None)];
    for (name, lens, noise) in sensors {
        if let Some(lens) = lens {
            let file = IntrinsicsFile::of(lens.intrinsics(), noise);
            keys.extend(Value::try_from(file).ok().map(|file| (name.to_owned(), file)));
        }
    }
    if let (Some(depth), Some(picture)) = (&calibration.depth, &calibration.picture) {
        let offset = depth.pose().inv_mul(Lens::pose(picture)).translation.vector;
        let offset: [f64; 3] = offset.into();
        keys.insert("picture_offset_m".into(), offset.map(Value::from).to_vec().into());
    }
    keys
}

fn robot_file(robot: &SimRobot, port: u16, has_lidar: bool) -> RobotFile {
    let number = robot.id().0;
    let sensor = robot.sensor();
    let mount = sensor.mount();
    RobotFile {
        id: number,
        server: format!("udp:{port}"),
        // A fixed port, so that a robot that was killed is welcomed at once.
        local: Some(([127, 0, 0, 1], port.wrapping_add(number).max(1_024)).into()),
        keys: None,
        sensor: format!("{}robot-{number}-sensor", if has_lidar { LIDAR } else { "" }).into(),
        wheels: format!("robot-{number}-wheels").into(),
        radius_m: rounded(robot.radius_m()),
        speed_m_s: rounded(robot.limits()[0]),
        turn_rad_s: rounded(robot.limits()[1]),
        sensor_at_m: [mount.x.metres(), mount.y.metres()],
        // A lidar sees all around, whatever is stated.
        fov_deg: sensor.focal_px().map_or(RobotFile::FOV_DEG, |focal| {
            rounded(2.0 * (sensor.beams() as f64 / 2.0 / focal).atan().to_degrees())
        }),
        max_range_m: sensor.max_range_m().min(FARTHEST_M),
        resolution_m: RESOLUTION.metres(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_written_short_and_zeros_without_a_sign() {
        let lens: Table =
            [("fx".to_owned(), Value::Float(168.604_820_044_953_98))].into_iter().collect();
        let offset = [-0.015_000_000_000_000_088, -1.2e-17, 0.0].map(Value::from).to_vec();
        let mut file = Table::new();
        file.insert("depth".into(), lens.into());
        file.insert("offset".into(), offset.into());
        file.insert("port".into(), 4_000.into());
        let mut file = Value::Table(file);
        round(&mut file);
        assert_eq!(
            toml::to_string(&file).unwrap(),
            "offset = [-0.015, 0.0, 0.0]\nport = 4000\n\n[depth]\nfx = 168.60482\n"
        );
    }
}

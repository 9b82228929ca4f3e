//! Each kind of range sensor measures what is in front of it.

use super::{seconds, small_room, world};

/// The readings of a robot in the south of the small room that looks north at a wall 1.9 m from its
/// sensor.
fn readings(preset: &str, more: &str) -> Vec<u16> {
    let scenario = small_room(&format!(
        "[[robots]]
        id = 1
        start = {{ x_m = 2.0, y_m = 1.0, heading_deg = 90.0 }}
        sensor = {{ preset = \"{preset}\" }}
        {more}"
    ));
    world(&scenario, 1).poll_scan(seconds(0.0)).unwrap().readings_mm
}

#[test]
fn a_depth_row_measures_the_depth_of_the_wall_in_every_column() {
    let row = readings("depth_row", "");
    assert_eq!(row.len(), 640);
    // With a focal length of 337 pixels, the ends of the wall, 2 m to each side, are out of view.
    let (focal, baseline, depth) = (320.0 / 43.5_f64.to_radians().tan(), 0.05, 1.9);
    let errors: Vec<f64> = row
        .iter()
        .filter(|&&reading| reading > 0)
        .map(|&reading| focal * baseline / (f64::from(reading) / 1000.0) - focal * baseline / depth)
        .collect();
    assert!(errors.len() > 630, "{} columns", errors.len());
    let mean = errors.iter().sum::<f64>() / errors.len() as f64;
    let square = errors.iter().map(|error| error * error).sum::<f64>() / errors.len() as f64;
    assert!(mean.abs() < 0.015, "off by {mean} px");
    // Standard deviation: 0.08 px plus steps of 1/32.
    assert!((square.sqrt() / 0.0805 - 1.0).abs() < 0.12, "{} px", square.sqrt());
}

#[test]
fn time_of_flight_sensors_measure_depths_and_zones_report_the_nearest() {
    let camera = readings("tof100", "");
    assert_eq!(camera.len(), 100);
    // Noise of 2 % of the range: more than five standard deviations.
    assert!(camera.iter().all(|&reading| reading.abs_diff(1900) < 120), "{camera:?}");
    // A board from 0.3 m up, 1.2 m from the sensor, in the left half of the view.
    let board = "
        [[furniture]]
        footprint.box = { centre_m = [1.0, 2.4], size_m = [1.8, 0.2] }
        bottom_m = 0.28
        top_m = 0.6";
    assert!(readings("tof100", board).iter().all(|&reading| reading > 1700));
    let zones = readings("tof8", board);
    assert_eq!(zones.len(), 8);
    let near = |&reading: &u16| reading.abs_diff(1200) < 200;
    assert!(zones[..3].iter().all(near), "{zones:?}");
    assert!(zones[5..].iter().all(|&reading| reading.abs_diff(1900) < 250), "{zones:?}");
}

#[test]
fn a_misaligned_sensor_measures_in_its_actual_direction() {
    let scan = |askew: &str| {
        let scenario = small_room(&format!(
            "[[robots]]
            id = 1
            start = {{ x_m = 2.0, y_m = 1.0, heading_deg = 90.0 }}
            sensor = {{ x_m = 0.0, noise_m = 0.0, noise_ratio = 0.0, fov_deg = 80.0, beams = 81, {askew} }}"
        ));
        let mut world = world(&scenario, 1);
        (world.poll_scan(seconds(0.0)).unwrap().readings_mm, world.robots()[0].sensor().mount())
    };
    let ((straight, mount), (askew, believed)) = (scan("askew_deg = 0.0"), scan("askew_deg = 3.0"));
    assert_eq!(mount, believed);
    // One beam per degree.
    assert_eq!(straight[3..], askew[..78]);
}

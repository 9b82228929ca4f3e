//! Writes CARMEN text logs.

use std::{
    f64::consts::PI,
    io::{self, Write},
};

use ubimap_agent::sense::NOTHING_IN_RANGE;

use super::{
    odometry::{compose, relative},
    scan_log::LoggedScan,
    sensor::Sensor,
};

/// Number of beams of a record: one every half degree from the right to the left, including both
/// edges.
const BEAMS: usize = 361;
/// A range that means no return, as SICK's scanners write it.
const NO_RETURN: &str = "81.83";
/// Time between the last scan of one robot and the first of the next, in seconds.
const PAUSE_S: f64 = 10.0;

/// Writes the scans of several robots as `FLASER` records, each with its pose and odometry. The log
/// looks like that of a single robot that is carried from the end of one robot's scans to the start
/// of the next one's. As all scans of a log must have the same beams, scans are resampled to 361
/// beams over half a turn: each beam gets the reading with the nearest direction, or "no return"
/// outside the sensor's view. Scans without pose or odometry are left out.
///
/// # Errors
/// Every error of the writer.
pub fn write_carmen(out: &mut dyn Write, robots: &[(Sensor, Vec<LoggedScan>)]) -> io::Result<()> {
    writeln!(out, "# Simulated scans. Poses are the true ones of the sensor; odometry drifts.")?;
    writeln!(out, "# FLASER n ranges.. x y theta odom_x odom_y odom_theta time host time")?;
    let mut end_s = 0.0;
    // The last pose and odometry that were written.
    let mut last: Option<[[f64; 3]; 2]> = None;
    for (robot, (sensor, scans)) in robots.iter().enumerate() {
        let beams = nearest_readings(sensor);
        let start_s = if robot == 0 { 0.0 } else { end_s + PAUSE_S };
        // The origin of the current robot's odometry, in the odometry of the single robot.
        let mut origin = None;
        for scan in scans {
            let (Some(pose), Some(odometry)) = (scan.pose, scan.odometry) else { continue };
            let origin = *origin.get_or_insert_with(|| {
                let carried = last.map_or(odometry, |[from, at]| compose(at, relative(from, pose)));
                compose(carried, relative(odometry, [0.0; 3]))
            });
            let odometry = compose(origin, odometry);
            last = Some([pose, odometry]);
            end_s = start_s + scan.time.micros() as f64 / 1e6;
            write!(out, "FLASER {BEAMS}")?;
            for beam in &beams {
                write_range(out, scan, *beam)?;
            }
            for [x, y, theta] in [pose, odometry] {
                let theta = theta - 2.0 * PI * (theta / (2.0 * PI)).round();
                write!(out, " {x:.4} {y:.4} {theta:.5}")?;
            }
            writeln!(out, " {end_s:.6} robot-{} {end_s:.6}", robot + 1)?;
        }
    }
    out.flush()
}

/// The range of a beam, from the reading in its direction.
fn write_range(
    out: &mut dyn Write,
    scan: &LoggedScan,
    beam: Option<(usize, f64)>,
) -> io::Result<()> {
    let reading = beam.and_then(|(index, stretch)| Some((*scan.readings_mm.get(index)?, stretch)));
    match reading.filter(|(reading, _)| !matches!(*reading, 0 | NOTHING_IN_RANGE)) {
        Some((reading, stretch)) => write!(out, " {:.3}", f64::from(reading) * stretch / 1000.0),
        None => write!(out, " {NO_RETURN}"),
    }
}

/// For each beam, the index of the reading nearest to its direction, and the ratio of the range to
/// the reading; `None` outside the sensor's view.
fn nearest_readings(sensor: &Sensor) -> Vec<Option<(usize, f64)>> {
    let beams = (0..BEAMS).map(|beam| {
        let angle = -PI / 2.0 + PI * beam as f64 / (BEAMS - 1) as f64;
        let (place, stretch) = match *sensor {
            Sensor::Radial { first_rad, step_rad, .. } => ((angle - first_rad) / step_rad, 1.0),
            Sensor::Pinhole { fx, cx, .. } => (cx - fx * angle.tan(), 1.0 / angle.cos()),
            Sensor::LinearAngle { field_rad, width, .. } => {
                let half = width as f64 / 2.0;
                (half - angle / (field_rad / 2.0) * half, 1.0 / angle.cos())
            }
        };
        let index = place.round();
        let is_seen = index >= 0.0 && index < sensor.readings() as f64;
        is_seen.then_some((index as usize, stretch))
    });
    beams.collect()
}

#[cfg(test)]
mod tests {
    use ubimap_protocol::time::Duration;

    use super::*;
    use crate::{
        recording::{Slicing, read},
        testing::Folder,
    };

    fn scan(seconds: u64, pose: [f64; 3], odometry: [f64; 3]) -> LoggedScan {
        LoggedScan {
            time: Duration::from_secs(seconds),
            readings_mm: vec![1_000, 0, 2_000],
            pose: Some(pose),
            odometry: Some(odometry),
            line: 0,
        }
    }

    #[test]
    fn what_is_written_is_read_again() {
        let folder = Folder::new("carmen-written");
        // Three columns 45 degrees apart, and a fan of three beams 10 degrees apart.
        let camera = Sensor::Pinhole { fx: 1.0, cx: 1.0, width: 3 };
        let fan = Sensor::Radial {
            first_rad: -10_f64.to_radians(),
            step_rad: 10_f64.to_radians(),
            beams: 3,
        };
        let first = [scan(0, [1.0, 1.0, 0.0], [0.0; 3]), scan(2, [2.0, 1.0, 0.0], [1.1, 0.0, 0.0])];
        // The second robot looks along y; its odometry says that it drove 1 m ahead.
        let second = [
            scan(0, [2.0, 5.0, PI / 2.0], [7.0, 0.0, 0.0]),
            scan(1, [2.0, 6.0, PI / 2.0], [8.0, 0.0, 0.0]),
        ];
        let mut text = Vec::new();
        write_carmen(&mut text, &[(camera, first.to_vec()), (fan, second.to_vec())]).unwrap();
        let path = folder.file("room.log", &text);
        let log = read(&path, None, Slicing::default()).unwrap();

        let seconds: Vec<_> = log.scans.iter().map(|it| it.time.micros() / 1_000_000).collect();
        assert_eq!(seconds, [0, 2, 12, 13]);
        let poses: Vec<_> = log.scans.iter().map(|it| it.pose.unwrap()).collect();
        assert_eq!(poses[1], [2.0, 1.0, 0.0]);
        assert!((poses[3][1] - 6.0).abs() < 1e-4 && (poses[3][2] - PI / 2.0).abs() < 1e-4);
        // The single robot was carried 4 m to the left and turned there; then it drove 1 m along y.
        for (index, expected) in [[0.0, 0.0], [1.1, 0.0], [1.1, 4.0], [1.1, 5.0]].iter().enumerate()
        {
            let odometry = log.scans[index].odometry.unwrap();
            let away = (odometry[0] - expected[0]).hypot(odometry[1] - expected[1]);
            assert!(away < 1e-3, "{index}: {odometry:?}");
        }

        let reading =
            |scan: usize, degrees: i32| log.scans[scan].readings_mm[((degrees + 90) * 2) as usize];
        // The leftmost column has a depth of 1 m, which is a range of 1.414 m; the rightmost has
        // twice that.
        assert_eq!([reading(0, 45), reading(0, 0), reading(0, -45)], [1_414, 0, 2_828]);
        assert_eq!([reading(0, 80), reading(0, -80)], [0, 0]);
        assert_eq!(
            [reading(2, -10), reading(2, 0), reading(2, 10), reading(2, 20)],
            [1_000, 0, 2_000, 0]
        );
    }
}

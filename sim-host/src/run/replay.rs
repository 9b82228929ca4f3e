//! `ubimap replay`: robots on the scans of a recorded log.
//!
//! The log is cut into consecutive segments, one for each robot, which run at the same time. The poses
//! of the log take the place of ceiling cameras: they give a fix for every scan, and at the cameras'
//! frame rate in between. If the log has odometry alone, the robots draw from it, without
//! correction; the map of the run is then drawn from the graph of what they saw.

use std::{collections::VecDeque, time};

use ubimap_agent::{Bounds, Config, Memory, locate::PoseSource};
use ubimap_protocol::{
    time::{Duration, Instant},
    units::{Pose, RobotId},
};

use super::{
    Outcome, RunError, figures,
    fleet::{Event, Fleet, Stage, Tap},
    graph_map::Received,
    heap::{BOUNDS, check_tiles},
    labels, markers,
    options::ReplayOptions,
    progress::Progress,
    volatility,
};
use crate::{
    camera::{Observation, Sighting},
    deployment::{self, Deployment},
    grid::OccupancyGrid,
    mapping::submaps::{motion, pose},
    recording::{self, Log, LoggedScan},
    report::{self, Caption, ExposureSummary, GraphSummary},
};

/// Time between the robots' boot and the first scan, in which they connect to the server.
const BOOT: Duration = Duration::from_secs(5);
/// Interval of the distance vectors of robots that have only odometry, shorter than that of robots out of the
/// cameras' view: at 0.7 m/s and one vector a second, one vector in five of the mines logs matches nothing.
const VECTOR_INTERVAL: Duration = Duration::from_millis(300);
/// Frame interval of the ceiling cameras.
const FRAME_INTERVAL: Duration = Duration::from_micros(66_667);

/// Runs the logs through robots, channels and the server.
pub fn run(options: &ReplayOptions) -> Result<Outcome, RunError> {
    run_tapped(options, Box::new(|_, _, _| {}))
}

/// Like [`run`], with a tap on every frame.
pub fn run_tapped(options: &ReplayOptions, tap: Tap<'_>) -> Result<Outcome, RunError> {
    let started = time::Instant::now();
    let log =
        recording::read_all(&options.logs, options.format.format(), options.slicing.slicing())?;
    log.warnings.iter().for_each(|warning| log::warn!("{warning}"));
    log.notes.iter().for_each(|note| log::info!("{note}"));
    if options.start.is_some() && !has_only_odometry(&log) {
        log::warn!("--start has no effect: the log has poses, which say where the robot is");
    }
    let mut stage = LogStage::of(&log, usize::from(options.robots));

    let bounds = Bounds {
        readings: log.sensor.readings(),
        own_tiles: options.run.tiles.map_or(BOUNDS.own_tiles, |tiles| tiles as usize),
        resolution: options.resolution,
        // The option's bound is 65 m.
        max_range: options.max_range.0.clamp(0, i32::from(u16::MAX)) as u16,
        ..BOUNDS
    };
    check_tiles(stage.robots, bounds.own_tiles)?;
    let robots = 1..=stage.robots as u16;
    let configs: Vec<_> =
        robots.map(|id| config(RobotId(id), bounds, &log, options).with_drive(None)).collect();
    let mut memory: Vec<_> = configs.iter().map(|it| Memory::new(&it.bounds)).collect();
    let faults = options.run.channel.faults();
    let (keeper, life) = options.run.keeper(options.resolution)?;
    // The poses of a log are interpolated between scans: no course shows an error.
    let deployment = deployment::Config {
        corrects_errors: false,
        labels: labels::read(options.run.labels.as_deref())?,
        ..deployment::Config::new(options.resolution)
    };
    let deployment = Deployment::new(deployment, life)?;
    let mut fleet = Fleet::new(&configs, &mut memory, faults, options.run.seed, deployment)?;
    if let Some(keeper) = keeper {
        fleet.keep(keeper);
    }
    fleet.tap(tap);

    let mut received = has_only_odometry(&log).then(|| Received::of(stage.robots));
    let progress = Progress::new(stage.end());
    let converged = fleet.run(&mut stage, |fleet| {
        received.iter_mut().for_each(|received| received.look(fleet));
        progress.at(fleet.now());
    })?;
    drop(progress);

    let fused = fleet.server().fused();
    let tiles = fused.tiles().map(|(id, _, tile)| (id, tile));
    let mut map = OccupancyGrid::from_tiles(tiles, options.resolution)?;
    let mut markers = markers::robots(&fleet);
    let intervals = volatility::intervals(fleet.deployment(), &map, fleet.now());
    let names = options.logs.iter().filter_map(|log| log.file_name()?.to_str());
    let caption = Caption {
        subject: names.collect::<Vec<_>>().join(", "),
        seed: Some(options.run.seed),
        time_s: Some(fleet.elapsed().micros() as f64 / 1e6),
    };
    let mut pictures =
        vec![("volatility.png", report::render_volatility(&map, &intervals, &caption))];
    let (mut tables, mut graph) = (Vec::new(), None);
    if let Some(mut received) = received {
        received.look(&fleet);
        pictures.push(("odometry.png", report::render(&map, &markers, &caption)));
        let starts = stage.starts(&log, &fleet);
        let solved = received.solve(options, &starts)?;
        tables.push(("trajectory.csv", solved.trajectory));
        graph = Some(solved.summary);
        if solved.summary.is_sound() {
            (map, markers) = (solved.map, solved.markers);
        } else {
            let GraphSummary { unmatched, vectors, .. } = solved.summary;
            log::warn!(
                "{unmatched} of {vectors} distance vectors match nothing, so the map is the robots' own, by \
                 odometry; see graph.png for the map of the graph"
            );
            pictures.push(("graph.png", report::render(&solved.map, &solved.markers, &caption)));
        }
    }
    let mut report = figures::report(&fleet, &map, options.run.seed, converged, bounds.own_tiles);
    report.graph = graph;
    if !report.has_mapped() {
        let scans = log.scans.len();
        log::warn!(
            "nothing was mapped: none of {scans} scans met a pose in time; lower --latency and --loss"
        );
    }
    report.exposure = log.exposure.map(ExposureSummary::from);
    report.simulated_s = fleet.elapsed().micros() as f64 / 1e6;
    report.elapsed_s = started.elapsed().as_secs_f64();
    Ok(Outcome { report, map, markers, caption, pictures, tables })
}

fn config(robot: RobotId, bounds: Bounds, log: &Log, options: &ReplayOptions) -> Config {
    let config = Config {
        boot_nonce: options.run.seed as u32 ^ u32::from(robot.0) << 16,
        policy: options.selection.policy.into(),
        gate: options.selection.gate(),
        ..Config::new(robot, log.sensor.model(), bounds)
    };
    if has_only_odometry(log) {
        let pose_source = PoseSource::Odometry(origin(log, options.start));
        Config { pose_source, vector_interval: VECTOR_INTERVAL, ..config }
    } else {
        config
    }
}

/// The origin of the odometry's frame, so that the robot is at `start` at the log's first scan.
fn origin(log: &Log, start: Option<Pose>) -> Pose {
    let first = log.scans.first().and_then(|scan| scan.odometry);
    let place = |(start, first)| pose(&(motion(start) * motion(to_pose(first)).inverse()));
    start.zip(first).map(place).unwrap_or_default()
}

fn has_only_odometry(log: &Log) -> bool {
    log.scans.iter().any(|scan| scan.pose.is_none())
}

/// The scans of a log as events.
struct LogStage {
    events: VecDeque<(Instant, Event)>,
    robots: usize,
}

impl LogStage {
    /// Cuts the log into segments of nearly equal length; there are never more robots than scans.
    fn of(log: &Log, robots: usize) -> Self {
        let robots = robots.min(log.scans.len());
        let mut events = Vec::new();
        for robot in 0..robots {
            let bound = |robot: usize| robot * log.scans.len() / robots;
            let segment = &log.scans[bound(robot)..bound(robot + 1)];
            events.extend(play(robot, segment));
        }
        // Simultaneous events keep their order: the camera first, then the robot.
        events.sort_by_key(|(moment, _)| *moment);
        Self { events: events.into(), robots }
    }

    /// The time of each robot's first scan: in the log, and by the server's clock.
    fn starts(&self, log: &Log, fleet: &Fleet<'_>) -> Vec<(Duration, Instant)> {
        let began = fleet.deployment().server_time(Instant(0) + BOOT);
        let first = |robot: usize| log.scans[robot * log.scans.len() / self.robots].time;
        (0..self.robots).map(|robot| (first(robot), began)).collect()
    }

    fn end(&self) -> Instant {
        self.events.back().map_or(Instant(0), |(moment, _)| *moment)
    }
}

impl Stage for LogStage {
    fn next_event(&self) -> Option<Instant> {
        Some(self.events.front()?.0)
    }

    fn poll(&mut self, now: Instant) -> Option<Event> {
        let due = self.events.front().is_some_and(|(moment, _)| *moment <= now);
        let (_, event) = due.then(|| self.events.pop_front()).flatten()?;
        Some(event)
    }
}

/// One robot's segment.
fn play(robot: usize, segment: &[LoggedScan]) -> Vec<(Instant, Event)> {
    let Some(first) = segment.first() else { return Vec::new() };
    let moment = |scan: &LoggedScan| Instant(0) + BOOT + Duration(scan.time.0 - first.time.0);
    let mut events = Vec::new();
    for (index, scan) in segment.iter().enumerate() {
        let now = moment(scan);
        if let Some(pose) = scan.pose {
            events.push((now, seen(robot, now, to_pose(pose))));
        }
        if let Some(pose) = scan.odometry {
            events.push((now, Event::Odometry { robot, pose: to_pose(pose) }));
        }
        events.push((now, Event::Scan { robot, readings: scan.readings_mm.clone() }));
        let next = segment.get(index + 1);
        if let Some((next, from, to)) = next.and_then(|it| Some((moment(it), scan.pose?, it.pose?)))
        {
            let span = next.since(now).micros();
            let frames = (span - 1) / FRAME_INTERVAL.micros();
            events.extend((1..=frames).map(|frame| {
                let captured = now + Duration(frame * FRAME_INTERVAL.micros());
                let part = captured.since(now).micros() as f64 / span as f64;
                (captured, seen(robot, captured, to_pose(between(from, to, part))))
            }));
        }
    }
    // The cameras continue briefly, so that the last scan has a fix after it.
    if let Some(last) = segment.last()
        && let Some(pose) = last.pose
    {
        events.extend((1..=15).map(|frame| {
            let captured = moment(last) + Duration(frame * FRAME_INTERVAL.micros());
            (captured, seen(robot, captured, to_pose(pose)))
        }));
    }
    events
}

/// An observation of one robot by its own camera.
fn seen(robot: usize, captured: Instant, pose: Pose) -> Event {
    Event::Observation(Observation {
        camera: robot,
        captured,
        robots: vec![Sighting::usual(RobotId(robot as u16 + 1), pose)],
        ..Observation::default()
    })
}

fn to_pose([x, y, heading]: [f64; 3]) -> Pose {
    Pose::from_metres(x, y, heading)
}

/// Interpolates linearly; headings take the shorter way.
fn between(from: [f64; 3], to: [f64; 3], part: f64) -> [f64; 3] {
    use std::f64::consts::{PI, TAU};
    let turn = (to[2] - from[2] + PI).rem_euclid(TAU) - PI;
    let mix = |axis: usize| from[axis] + (to[axis] - from[axis]) * part;
    [mix(0), mix(1), from[2] + turn * part]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recording::{Format, Sensor};

    fn log(scans: usize) -> Log {
        let scan = |index: usize| LoggedScan {
            time: Duration::from_secs(2 * index as u64),
            readings_mm: vec![index as u16; 3],
            pose: Some([index as f64, 0.0, 3.0 * index as f64]),
            odometry: None,
            line: index + 1,
        };
        Log {
            format: Format::Carmen,
            sensor: Sensor::Radial { first_rad: 0.0, step_rad: 0.1, beams: 3 },
            scans: (0..scans).map(scan).collect(),
            exposure: None,
            warnings: Vec::new(),
            notes: Vec::new(),
        }
    }

    #[test]
    fn segments_run_side_by_side_and_lose_no_scan() {
        let stage = LogStage::of(&log(10), 3);
        let mut scans = [const { Vec::new() }; 3];
        for (moment, event) in &stage.events {
            if let Event::Scan { robot, readings } = event {
                scans[*robot].push((moment.0 / 1_000_000, readings[0]));
            }
        }
        assert_eq!(scans[0], [(5, 0), (7, 1), (9, 2)]);
        assert_eq!(scans[1], [(5, 3), (7, 4), (9, 5)]);
        assert_eq!(scans[2], [(5, 6), (7, 7), (9, 8), (11, 9)]);
        assert_eq!(LogStage::of(&log(2), 5).robots, 2);
    }

    #[test]
    fn there_is_a_fix_for_each_scan_and_at_camera_rate_between() {
        let events = play(0, &log(2).scans);
        let fixes: Vec<_> = events
            .iter()
            .filter_map(|(_, event)| match event {
                Event::Observation(seen) => Some((seen.captured.0, seen.robots[0].pose)),
                _ => None,
            })
            .collect();
        assert_eq!(fixes[0].0, 5_000_000);
        assert!(fixes.windows(2).all(|pair| pair[1].0 - pair[0].0 <= 66_667));
        assert!(fixes.contains(&(7_000_000, Pose::from_metres(1.0, 0.0, 3.0))));
    }
}

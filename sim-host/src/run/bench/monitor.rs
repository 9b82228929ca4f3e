//! `ubimap monitor`: what a robot reports, live.

use std::fmt::Write as _;

use clap::Args;
use log::Level;
use serde::Serialize;
use ubimap_protocol::{
    message::State,
    time::{Duration, Instant},
    units::{Pose, RobotId},
};

use super::{options::PortOptions, screen::Screen, session::Bench};
use crate::{
    report::LinkSummary,
    run::{
        RunError, interruption,
        options::{pose, seconds},
        serve::CAPTURE_INTERVAL,
    },
    server::{Event, about_number},
};

/// Interval between two lines about the link, and between two pictures.
const LINK_INTERVAL: Duration = Duration::from_secs(5);
const PICTURE_INTERVAL: Duration = Duration::from_millis(250);

/// Options of `ubimap monitor`.
#[derive(Args, Clone, Debug)]
pub struct MonitorOptions {
    /// The robot's port.
    #[command(flatten)]
    pub port: PortOptions,

    /// Tell the robot that it stands at this pose, in metres and degrees, in place of cameras: then it maps
    #[arg(long, value_name = "X,Y,DEG", value_parser = pose, allow_hyphen_values = true)]
    pub pose: Option<Pose>,

    /// Duration in seconds; without it, until stopped
    #[arg(long, value_name = "S", value_parser = seconds, allow_negative_numbers = true)]
    pub duration: Option<Duration>,

    /// One line for each report, also in a terminal
    #[arg(long)]
    pub plain: bool,

    /// One JSON object per line for each report
    #[arg(long, conflicts_with = "plain")]
    pub json: bool,
}

/// A line of `--json`.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "what", rename_all = "snake_case")]
enum Line {
    /// The robot has opened a session.
    Session { t_s: f64, robot: u16, boot_nonce: Option<u32>, resolution_m: f64 },
    /// The robot's state: poses are x and y in metres and the heading in degrees.
    State {
        t_s: f64,
        pose: Option<[f64; 3]>,
        pose_t_s: Option<f64>,
        odometry: Option<[f64; 3]>,
        cells_refused: u32,
    },
    /// Something has happened.
    Event { t_s: f64, level: &'static str, text: String },
    /// The link's counters.
    Link {
        t_s: f64,
        bytes_up: u64,
        bytes_down: u64,
        time_requests: u32,
        tiles: usize,
        distance_vectors: u32,
        #[serde(flatten)]
        frames: LinkSummary,
    },
}

/// Shows the robot until the time is up or a signal interrupts.
///
/// # Errors
/// [`RunError`] if the port can't be used, or if no robot is there.
pub fn run(options: &MonitorOptions) -> Result<(), RunError> {
    let mut bench = Bench::open(&options.port)?;
    let mut screen = Screen::new(options.plain || options.json);
    let robot = bench.wait_for_robot()?;
    let mut shown = Shown::default();
    let end = options.duration.map(|duration| bench.now() + duration);
    let (mut next_fix, mut next_link, mut next_picture) = (Instant(0), bench.now(), Instant(0));
    while !interruption::is_requested() && end.is_none_or(|end| bench.now() < end) {
        let now = bench.now();
        if let Some(pose) = options.pose.filter(|_| now >= next_fix) {
            next_fix = now + CAPTURE_INTERVAL;
            bench.fix(pose);
        }
        let mut lines = shown.news(&mut bench, now);
        if now >= next_link {
            next_link = now + LINK_INTERVAL;
            if !screen.redraws() {
                lines.push(link(&bench, robot, now));
            }
        }
        let mut text = String::new();
        for line in &lines {
            match options.json {
                // Plain structs: serialising them can't fail.
                true => text += &(serde_json::to_string(line).unwrap_or_default() + "\n"),
                // The picture shows the state.
                false if screen.redraws() && matches!(line, Line::State { .. }) => {}
                false => text += &described(line),
            }
        }
        if !text.is_empty() && !screen.print(&text)? {
            return Ok(());
        }
        if screen.redraws() && (now >= next_picture || !text.is_empty()) {
            next_picture = now + PICTURE_INTERVAL;
            let state = bench.state().map(|state| described(&stated(now, &state)));
            let state = state.unwrap_or_else(|| "        no state yet\n".into());
            if !screen.draw(&(state + &described(&link(&bench, robot, now))))? {
                return Ok(());
            }
        }
        bench.turn()?;
    }
    Ok(())
}

/// What was shown already.
#[derive(Default)]
struct Shown {
    state: Option<State>,
}

impl Shown {
    /// What is new.
    fn news(&mut self, bench: &mut Bench, now: Instant) -> Vec<Line> {
        let mut lines = Vec::new();
        while let Some((at, event)) = bench.poll_event() {
            let t_s = seconds_of(at);
            if let Event::Joined(robot, _) = event {
                let boot_nonce = bench.hello().map(|hello| hello.nonce);
                let resolution_m = bench.resolution().metres();
                lines.push(Line::Session { t_s, robot: robot.0, boot_nonce, resolution_m });
                continue;
            }
            let level = match event.level() {
                Level::Error => "error",
                Level::Warn => "warning",
                Level::Info => "info",
                Level::Debug | Level::Trace => "debug",
            };
            lines.push(Line::Event { t_s, level, text: event.to_string() });
        }
        let state = bench.state();
        if state != self.state {
            self.state = state;
            lines.extend(state.map(|state| stated(now, &state)));
        }
        lines
    }
}

fn stated(now: Instant, state: &State) -> Line {
    Line::State {
        t_s: seconds_of(now),
        pose: state.pose.map(metres),
        pose_t_s: state.time.map(seconds_of),
        odometry: state.odometry.map(metres),
        cells_refused: state.cells_refused,
    }
}

fn link(bench: &Bench, robot: RobotId, now: Instant) -> Line {
    let server = bench.server();
    let [bytes_up, bytes_down] = bench.bytes();
    Line::Link {
        t_s: seconds_of(now),
        bytes_up,
        bytes_down,
        time_requests: server.time_requests(robot),
        tiles: server.layer(robot).map_or(0, |layer| layer.tiles().count()),
        distance_vectors: server.distance_vectors(robot),
        frames: bench.counters(),
    }
}

/// A line for people.
fn described(line: &Line) -> String {
    let at = |t_s: f64| format!("{t_s:7.1} s  ");
    let pose = |pose: Option<[f64; 3]>| match pose {
        Some([x, y, heading]) => format!("{x:.3} m, {y:.3} m, {heading:.1} degrees"),
        None => "none".into(),
    };
    let mut text = String::new();
    // Writing to a string can't fail.
    let _ = match line {
        Line::Session { t_s, robot, boot_nonce, resolution_m } => {
            let boot = boot_nonce.map_or(String::new(), |it| format!(", boot {it:08x}"));
            let about = about_number(RobotId(*robot));
            let at = at(*t_s);
            writeln!(
                text,
                "{at}robot {robot}{about} has a session{boot}, cells of {resolution_m} m"
            )
        }
        Line::State { t_s, pose: map, odometry, cells_refused, .. } => {
            let (at, map, odometry) = (at(*t_s), pose(*map), pose(*odometry));
            let refused = if *cells_refused > 0 {
                format!("; {cells_refused} cells refused")
            } else {
                String::new()
            };
            writeln!(text, "{at}pose {map}; odometry {odometry}{refused}")
        }
        Line::Event { t_s, level, text: event } => {
            let at = at(*t_s);
            writeln!(text, "{at}{level}: {event}")
        }
        Line::Link {
            t_s,
            bytes_up,
            bytes_down,
            time_requests,
            tiles,
            distance_vectors,
            frames,
        } => {
            let at = at(*t_s);
            writeln!(
                text,
                "{at}{bytes_up} bytes up, {bytes_down} down; {time_requests} time requests, {tiles} tiles, \
                 {distance_vectors} distance vectors; {frames}"
            )
        }
    };
    text
}

fn metres(pose: Pose) -> [f64; 3] {
    [pose.x.metres(), pose.y.metres(), pose.heading.degrees()]
}

fn seconds_of(moment: Instant) -> f64 {
    moment.micros() as f64 / 1e6
}

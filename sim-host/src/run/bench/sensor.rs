//! `ubimap sensor`: what a robot sees, drawn in the terminal.

use clap::Args;
use serde::Serialize;
use ubimap_agent::Parameter;
use ubimap_protocol::{
    message::{DistanceVector, ParameterAction, State},
    time::Duration,
    units::Pose,
};

use super::{
    options::PortOptions,
    picture,
    screen::Screen,
    session::Bench,
    tilt::{Tilt, Verdict},
    view::View,
};
use crate::run::{
    RunError, interruption,
    options::{OptionError, number, pose, seconds},
};

/// How long a robot may be without a view before it is told where it stands although it moves, and before that
/// is said. A robot that has sent many views does so every 5 s while nothing moves.
const NO_VIEW: Duration = Duration::from_secs(6);
const LONG_BLIND: Duration = Duration::from_secs(12);

/// Options of `ubimap sensor`.
#[derive(Args, Clone, Debug)]
pub struct SensorOptions {
    /// The robot's port.
    #[command(flatten)]
    pub port: PortOptions,

    /// Where the robot stands, in metres and degrees
    #[arg(long, value_name = "X,Y,DEG", value_parser = pose, allow_hyphen_values = true, default_value = "0,0,0")]
    pub pose: Pose,

    /// The sensor's height above the floor in metres: then a view of the floor tells by how much it looks down
    #[arg(long, value_name = "M", value_parser = height)]
    pub height: Option<f64>,

    /// Duration in seconds; without it, until stopped
    #[arg(long, value_name = "S", value_parser = seconds, allow_negative_numbers = true)]
    pub duration: Option<Duration>,

    /// One picture below the other, also in a terminal
    #[arg(long)]
    pub plain: bool,

    /// One JSON object per line for each view
    #[arg(long, conflicts_with = "plain")]
    pub json: bool,
}

pub(super) fn height(text: &str) -> Result<f64, OptionError> {
    number(text, 0.01, 3.0, "m")
}

/// A line of `--json`.
#[derive(Clone, Debug, PartialEq, Serialize)]
struct Seen {
    /// When the scan was taken, in seconds since the start.
    t_s: f64,
    /// The robot's pose: x and y in metres and the heading in degrees.
    pose: [f64; 3],
    /// Number of columns, those without a return included.
    columns: usize,
    /// Bearings in degrees and distances in metres, of the columns with a return.
    seen: Vec<[f64; 2]>,
    /// The line across that limits the view, in metres ahead, if it is flat.
    flat_m: Option<f64>,
    /// What that line is.
    verdict: Verdict,
    /// By how much the sensor looks down, if the line is the floor and its height is known.
    looks_down_deg: Option<f64>,
}

/// Shows views until the time is up or a signal interrupts.
///
/// # Errors
/// [`RunError`] if the port can't be used, or if no robot is there.
pub fn run(options: &SensorOptions) -> Result<(), RunError> {
    let mut bench = Bench::open(&options.port)?;
    bench.wait_for_robot()?;
    let get = ParameterAction::Get(Parameter::MountingX as u16);
    let mounting = bench.parameter(get)?.values.first().map_or(0, |it| it.value);
    bench.open_gate()?;
    show(&mut bench, options, f64::from(mounting) / 1_000.0)
}

fn show(bench: &mut Bench, options: &SensorOptions, mounting_x: f64) -> Result<(), RunError> {
    let mut screen = Screen::new(options.plain || options.json);
    let mut tilt = Tilt::new(mounting_x, options.height);
    let end = options.duration.map(|duration| bench.now() + duration);
    let (mut newest, mut seen_at, mut complained) = (None::<DistanceVector>, bench.now(), false);
    let mut stand = Stand::default();
    while !interruption::is_requested() && end.is_none_or(|end| bench.now() < end) {
        bench.turn()?;
        let now = bench.now();
        let is_blind = now.since(seen_at) > NO_VIEW;
        stand.note(bench.state());
        // Poses that contradict the wheels would be refused, so a robot that is moved by hand gets none.
        if stand.stands() || is_blind {
            bench.look_from(stand.pose().unwrap_or(options.pose));
        }
        let mut text = String::new();
        while let Some((_, event)) = bench.poll_event() {
            if event.level() <= log::Level::Info {
                text += &format!("{event}\n");
            }
        }
        if now.since(seen_at) > LONG_BLIND && !complained {
            complained = true;
            text += "no view: the sensor is silent or the robot has no pose; ubimap monitor shows its events\n";
        }
        if !options.json && !text.is_empty() && !screen.print(&text)? {
            return Ok(());
        }
        let vector = bench.robot().and_then(|robot| bench.server().distance_vector(robot));
        let is_view =
            |it: &&DistanceVector| !it.distances.is_empty() && newest.as_ref() != Some(*it);
        let Some(vector) = vector.filter(is_view).cloned() else {
            continue;
        };
        (seen_at, complained) = (now, false);
        let view = View::of(&vector);
        tilt.add(vector.pose, &view);
        let text = if options.json {
            let line = line(&vector, &view, &tilt);
            // A plain struct: serialising it can't fail.
            serde_json::to_string(&line).unwrap_or_default() + "\n"
        } else {
            picture::draw(&view) + &picture::described(&view) + "\n" + &tilt.described()
        };
        newest = Some(vector);
        if !screen.draw(&text)? {
            return Ok(());
        }
    }
    Ok(())
}

/// Whether the robot stands, by its newest two states.
#[derive(Default)]
struct Stand {
    newest: [Option<State>; 2],
}

impl Stand {
    fn note(&mut self, state: Option<State>) {
        if state != self.newest[1] {
            self.newest = [self.newest[1], state];
        }
    }

    fn stands(&self) -> bool {
        let [before, now] = self.newest.map(|state| state.and_then(|it| it.odometry));
        before.is_none() || before == now
    }

    /// Its pose, once it knows it.
    fn pose(&self) -> Option<Pose> {
        self.newest[1].and_then(|state| state.pose)
    }
}

fn line(vector: &DistanceVector, view: &View, tilt: &Tilt) -> Seen {
    let Pose { x, y, heading } = vector.pose;
    Seen {
        t_s: vector.time.micros() as f64 / 1e6,
        pose: [x.metres(), y.metres(), heading.degrees()],
        columns: view.columns,
        seen: view.seen.iter().map(|&(bearing, metres)| [bearing.to_degrees(), metres]).collect(),
        flat_m: view.flat_m(),
        verdict: tilt.verdict(),
        looks_down_deg: tilt.looks_down_deg(),
    }
}

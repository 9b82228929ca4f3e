//! `ubimap wheels`: turns a robot's wheels a little, and tells what is wrong with them.

use std::io::{self, BufRead, IsTerminal, Write};

use clap::{Args, ValueEnum};
use ubimap_agent::Parameter;
use ubimap_protocol::{
    message::{EventCode, ParameterAction, Path, Stop, Waypoint},
    time::{Duration, Instant},
    units::{Angle, Millimetres, Pose},
};

use super::{
    diagnosis::{self, Finding, Seen, Try},
    findings::{TryReport, WheelsReport},
    motion::{Motion, Sensed, sensed},
    options::PortOptions,
    sensor::height,
    session::Bench,
    tilt::{Tilt, Verdict},
    view::{View, signed},
};
use crate::{
    run::{
        RunError, interruption,
        options::{OptionError, number},
    },
    server::{self, Command, Event},
};

/// How far the ground is free that the robot is told of, beyond the way that it drives, in metres.
const FREE: f64 = 0.5;
/// Interval at which it is told so.
const PEN_INTERVAL: Duration = Duration::from_millis(250);
/// How long a try may take: the robot plans, drives and stops.
const TRY: Duration = Duration::from_secs(9);
/// A turn ends here: a robot that turns to the wrong side goes on for ever.
const TURN: Duration = Duration::from_secs(4);
/// How long until a state or a view must have come.
const REPORT: Duration = Duration::from_secs(5);
/// How long to wait for a view; the sensor may not work.
const VIEW: Duration = Duration::from_secs(4);
/// By how much a way is wrong that a person has measured, in metres.
const RULER: f64 = 0.005;

/// Options of `ubimap wheels`.
#[derive(Args, Clone, Debug)]
pub struct WheelsOptions {
    /// The robot's port.
    #[command(flatten)]
    pub port: PortOptions,

    /// How far to drive ahead, in metres
    #[arg(long, value_name = "M", default_value = "0.3", value_parser = way)]
    pub way: f64,

    /// Ask what the robot did and how far it went; without it, only in a terminal
    #[arg(long)]
    pub ask: bool,

    /// What you have seen the robot do when it was to drive ahead
    #[arg(long, value_enum, value_name = "WHAT")]
    pub saw_ahead: Option<SeenName>,

    /// What you have seen it do when it was to turn to the left
    #[arg(long, value_enum, value_name = "WHAT")]
    pub saw_turn: Option<SeenName>,

    /// The sensor's height above the floor in metres: then its tilt can be told, if it looks down
    #[arg(long, value_name = "M", value_parser = height)]
    pub height: Option<f64>,

    /// Print the findings as JSON
    #[arg(long)]
    pub json: bool,
}

/// What a person has seen.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum SeenName {
    /// It drove ahead
    Ahead,
    /// It drove backwards
    Back,
    /// It turned to the left
    Left,
    /// It turned to the right
    Right,
    /// It stood still
    Nothing,
}

impl From<SeenName> for Seen {
    fn from(name: SeenName) -> Self {
        match name {
            SeenName::Ahead => Self::Ahead,
            SeenName::Back => Self::Back,
            SeenName::Left => Self::Left,
            SeenName::Right => Self::Right,
            SeenName::Nothing => Self::Nothing,
        }
    }
}

fn way(text: &str) -> Result<f64, OptionError> {
    number(text, 0.1, 1.0, "m")
}

/// Tries the wheels.
///
/// # Errors
/// [`RunError::Bench`] if the robot has no odometry or no pose.
pub fn run(options: &WheelsOptions) -> Result<WheelsReport, RunError> {
    let mut bench = Bench::open(&options.port)?;
    let robot = bench.wait_for_robot()?;
    let get = ParameterAction::Get(Parameter::MountingX as u16);
    let mounting = bench.parameter(get)?.values.first().map_or(0, |it| it.value);
    let tilt = Tilt::new(f64::from(mounting) / 1_000.0, options.height);
    bench.open_gate()?;
    let (paths, stops, next_pen) = (0, 0, Instant(0));
    let mut trial = Trial {
        bench,
        options,
        tilt,
        tries: Vec::new(),
        paths,
        stops,
        next_pen,
        at: Pose::default(),
    };
    let tried = trial.both();
    let Trial { mut bench, tries, tilt, .. } = trial;
    bench.bid_farewell(Command::Stop(Stop { number: u32::MAX, stop: true }));
    tried?;
    Ok(WheelsReport {
        schema: "ubimap-wheels",
        version: 1,
        robot: robot.0,
        tries,
        view: tilt.verdict(),
        looks_down_deg: tilt.looks_down_deg(),
        about_view: if tilt.verdict() == Verdict::Floor { tilt.described() } else { String::new() },
    })
}

struct Trial<'o> {
    bench: Bench,
    options: &'o WheelsOptions,
    tilt: Tilt,
    tries: Vec<TryReport>,
    paths: u32,
    stops: u32,
    next_pen: Instant,
    /// Where the robot was last told to be.
    at: Pose,
}

/// What the robot told during a try.
#[derive(Default)]
struct Told {
    /// Its odometry, oldest first.
    odometry: Vec<Pose>,
    /// Events, and whether one of them ends the try.
    events: Vec<String>,
    is_over: bool,
}

impl Trial<'_> {
    fn both(&mut self) -> Result<(), RunError> {
        let first = self.try_it("drive ahead", TRY)?;
        if matches!(first, Finding::Good | Finding::Ticks { .. }) {
            self.try_it("turn to the left", TURN)?;
        }
        Ok(())
    }

    /// Lets time pass until a condition is met or the time is up. The robot is told that the ground is free.
    fn pass(
        &mut self,
        patience: Duration,
        mut is_met: impl FnMut(&mut Bench) -> bool,
    ) -> Result<bool, RunError> {
        let end = self.bench.now() + patience;
        loop {
            if is_met(&mut self.bench) {
                return Ok(true);
            }
            if interruption::is_requested() {
                return Err(RunError::Interrupted);
            }
            let now = self.bench.now();
            if now >= end {
                return Ok(false);
            }
            if now >= self.next_pen {
                self.next_pen = now + PEN_INTERVAL;
                self.bench.pen(Pose::default(), FREE + self.options.way);
            }
            self.bench.turn()?;
        }
    }

    /// Waits for the odometry of a robot that stands: two reports that are equal.
    fn standing(&mut self) -> Result<Pose, RunError> {
        let mut newest = None;
        let mut reports: Vec<Pose> = Vec::new();
        self.pass(REPORT, |bench| {
            let count = bench.states();
            if newest != Some(count) {
                newest = Some(count);
                reports.extend(bench.state().and_then(|state| state.odometry));
            }
            // The first one may be old.
            reports.len() > 2 && reports[reports.len() - 1] == reports[reports.len() - 2]
        })?;
        reports.last().copied().ok_or_else(|| {
            self.bench.fault(
                "the robot reports no odometry: does it hear its base? Check the base's power and the lines to it",
            )
        })
    }

    /// Tells the robot where it stands until it knows and has told what it sees from there.
    fn look(&mut self) -> Result<Option<View>, RunError> {
        let at = self.at;
        let robot = self.bench.robot();
        let count = |bench: &Bench| robot.map_or(0, |robot| bench.server().distance_vectors(robot));
        let before = count(&self.bench);
        self.pass(VIEW, |bench| {
            bench.look_from(at);
            // The one after the next: that was taken here.
            count(bench) >= before + 2
        })?;
        if count(&self.bench) == before {
            return Ok(None);
        }
        let vector = robot.and_then(|robot| self.bench.server().distance_vector(robot));
        let view = vector.map(View::of);
        if let Some(view) = &view {
            self.tilt.add(at, view);
        }
        Ok(view)
    }

    fn try_it(&mut self, told: &'static str, patience: Duration) -> Result<Finding, RunError> {
        let is_turn = !self.tries.is_empty();
        let before = self.look()?;
        let from = self.standing()?;
        while self.bench.poll_event().is_some() {}
        let goal = self.goal(is_turn);
        self.paths += 1;
        let path = Path { number: self.paths, waypoints: [goal].into_iter().collect() };
        self.stop(false)?;
        self.bench.command(Command::Path(path))?;
        let mut heard = Told::default();
        let mut newest = self.bench.states();
        self.pass(patience, |bench| {
            if bench.states() != newest {
                newest = bench.states();
                heard.odometry.extend(bench.state().and_then(|state| state.odometry));
            }
            while let Some((_, event)) = bench.poll_event() {
                heard.note(&event);
            }
            heard.is_over
        })?;
        self.stop(true)?;
        let to = self.standing()?;
        heard.odometry.push(to);
        let counted = Motion { turn: turned(from, &heard.odometry), ..Motion::between(from, to) };
        self.at = moved(self.at, from, to);
        let after = self.look()?;
        let sensed = before.zip(after).and_then(|views| compared(&views, counted));
        let early = heard.odometry.iter().map(|pose| Motion::between(from, *pose));
        let early = early.into_iter().find(|it| Seen::of(*it) != Seen::Nothing);
        let person = if is_turn { self.options.saw_turn } else { self.options.saw_ahead };
        let mut tried = Try {
            counted,
            early,
            seen: person.map(Seen::from).or(sensed.map(|it| Seen::of(it.motion))),
            way_m: sensed.map(|it| [it.motion.ahead, it.error_m]),
        };
        if self.options.ask || (io::stdin().is_terminal() && !self.options.json) {
            ask(told, &mut tried)?;
        }
        let finding = match is_turn {
            true => diagnosis::turn(tried),
            false => diagnosis::ahead(self.options.way, tried),
        };
        self.tries.push(TryReport {
            told,
            counted_m: counted.ahead,
            counted_deg: counted.turn.to_degrees(),
            sensed_m: sensed.map(|it| it.motion.ahead),
            sensed_error_m: sensed.map(|it| it.error_m),
            sensed_deg: sensed.map(|it| it.motion.turn.to_degrees()),
            seen: tried.seen,
            events: heard.events,
            finding,
        });
        Ok(finding)
    }

    /// A point ahead, or to the left and a little back, so that the robot turns on the spot.
    fn goal(&self, is_turn: bool) -> Waypoint {
        let heading = self.at.heading.radians();
        let (sin, cos) = (libm::sin(heading), libm::cos(heading));
        let [x, y] = if is_turn { [0.0, self.options.way] } else { [self.options.way, 0.0] };
        let place = |origin: Millimetres, offset: f64| origin + Millimetres::from_metres(offset);
        Waypoint { x: place(self.at.x, x * cos - y * sin), y: place(self.at.y, x * sin + y * cos) }
    }

    fn stop(&mut self, stop: bool) -> Result<(), RunError> {
        self.stops += 1;
        self.bench.command(Command::Stop(Stop { number: self.stops, stop }))
    }
}

impl Told {
    fn note(&mut self, event: &Event) {
        let Event::Reported(_, event) = event else { return };
        let text = server::described(event);
        self.events.push(text);
        let ends = [
            EventCode::PathDone,
            EventCode::PathBlocked,
            EventCode::DriveFault,
            EventCode::Collision,
            EventCode::SensorFault,
        ];
        let code = EventCode::from_number(event.code);
        self.is_over |= code.is_some_and(|code| ends.contains(&code));
    }
}

/// What the sensor tells of a motion. A line across the view that stays while the wheels turn may be the floor,
/// which tells nothing.
fn compared((before, after): &(View, View), counted: Motion) -> Option<Sensed> {
    let stands = |motion| Seen::of(motion) == Seen::Nothing;
    let has_line = before.flat_m().or(after.flat_m()).is_some();
    sensed(before, after, counted).filter(|it| !(has_line && stands(it.motion) && !stands(counted)))
}

/// The turn from a pose through others, which may exceed half a turn.
fn turned(from: Pose, through: &[Pose]) -> f64 {
    let mut last = from.heading;
    through.iter().fold(0.0, |sum, pose| {
        let step: Angle = pose.heading - last;
        last = pose.heading;
        sum + signed(step)
    })
}

/// A pose after a motion that odometry has measured.
fn moved(at: Pose, from: Pose, to: Pose) -> Pose {
    let [x, y] = [(to.x - from.x).metres(), (to.y - from.y).metres()];
    let turn = at.heading.radians() - from.heading.radians();
    let (sin, cos) = (libm::sin(turn), libm::cos(turn));
    Pose {
        x: at.x + Millimetres::from_metres(x * cos - y * sin),
        y: at.y + Millimetres::from_metres(x * sin + y * cos),
        heading: at.heading + (to.heading - from.heading),
    }
}

/// Asks what was seen. Empty answers leave what the sensor has told.
fn ask(told: &str, tried: &mut Try) -> Result<(), RunError> {
    let answer = |question: &str| -> Result<String, RunError> {
        let mut err = io::stderr().lock();
        // Whoever has closed standard error is not asked.
        let _ = write!(err, "{question} ").and_then(|()| err.flush());
        let mut line = String::new();
        io::stdin().lock().read_line(&mut line).map_err(RunError::Print)?;
        Ok(line.trim().to_lowercase())
    };
    let question = format!(
        "The robot was told to {told}. What did it do: ahead, back, left, right, nothing? (Enter: not seen)"
    );
    if let Ok(seen) = SeenName::from_str(&answer(&question)?, true) {
        tried.seen = Some(seen.into());
    }
    let drives = matches!(tried.seen, None | Some(Seen::Ahead | Seen::Back));
    if drives && told.contains("ahead") {
        let measured = answer("How far did it go, in metres? (Enter: not measured)")?;
        if let Ok(metres) = number(&measured, 0.0, 2.0, "m") {
            tried.way_m = Some([metres, RULER]);
        }
    }
    Ok(())
}

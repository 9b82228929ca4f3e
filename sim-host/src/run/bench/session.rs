//! A session with the robot at a port, as a server has it: without cameras, map or coordinator.

use std::{collections::VecDeque, time};

use ubimap_agent::{Parameter, map::Gate};
use ubimap_protocol::{
    frame::{Key, MAX_FRAME},
    message::{
        Hello, ParameterAction, ParameterCommand, ParameterReport, ParameterValue, RefusalReason,
        State,
    },
    tile::Cell,
    time::{Duration, Instant},
    units::{Millimetres, Pose, RobotId},
};

use super::{
    opening::{server, wire},
    options::PortOptions,
    overheard::{Ear, Overheard},
};
use crate::{
    camera::{Observation, Sighting},
    channel::wire::{Wire, WireError},
    report::LinkSummary,
    run::{RunError, interruption, keys},
    server::{Command, Event, Server},
};

/// How long a robot may take to come: a refused one tries again after 10 s.
const PATIENCE: Duration = Duration::from_secs(12);
/// How long it may take to answer a command.
const ANSWER: Duration = Duration::from_secs(5);
/// Maximum wait for bytes, so that signals are noticed.
const LONGEST_WAIT: Duration = Duration::from_millis(20);
/// Cells of a robot that has not said how large its are.
const USUAL_RESOLUTION: Millimetres = Millimetres(50);
/// How long the last commands may take.
const FAREWELL: Duration = Duration::from_millis(600);
/// Interval of the poses told to a standing robot, and half of their difference: less than their deviation.
const LOOK_INTERVAL: Duration = Duration::from_millis(500);
const LOOK_SHIFT: Millimetres = Millimetres(12);
/// Thickness of a pen's wall in cells: no ray slips through.
const PEN_WALL: i32 = 2;
/// Maximum number of events that wait to be taken.
const MAX_EVENTS: usize = 1_000;

/// The server's side of the link to one robot, in real time.
#[derive(Debug)]
pub struct Bench {
    name: String,
    wire: Wire,
    ear: Ear,
    heard: Option<Overheard>,
    hello: Option<Hello>,
    keys: Vec<(RobotId, Key)>,
    server: Server,
    port: usize,
    resolution: Millimetres,
    started: time::Instant,
    buffer: Vec<u8>,
    events: VecDeque<(Instant, Event)>,
    bytes: [u64; 2],
    /// Number of the last parameter command.
    commands: u16,
    /// When a standing robot is told its pose next, and on which side of it.
    next_look: Instant,
    looks_ahead: bool,
    /// Whether commands must be sent when the session is left.
    has_farewell: bool,
    /// The robot's gate as it was before [`Bench::open_gate`].
    gate: Option<i32>,
}

impl Bench {
    /// Opens a port. For TCP, waits until a robot has connected.
    ///
    /// # Errors
    /// [`RunError`] if the port or the keys can't be used.
    pub fn open(options: &PortOptions) -> Result<Self, RunError> {
        let keys = match &options.keys {
            Some(folder) => keys::load(folder)?,
            None => Vec::new(),
        };
        let wire = wire(options)?;
        let (server, port) = server(USUAL_RESOLUTION, &keys, options.keys.is_some())?;
        Ok(Self {
            name: options.port.to_string(),
            wire,
            ear: Ear::default(),
            heard: None,
            hello: None,
            keys,
            server,
            port,
            resolution: USUAL_RESOLUTION,
            started: time::Instant::now(),
            buffer: vec![0; 4 * MAX_FRAME],
            events: VecDeque::new(),
            bytes: [0; 2],
            commands: 0,
            next_look: Instant(0),
            looks_ahead: false,
            has_farewell: false,
            gate: None,
        })
    }

    /// The time since the port was opened, which is the server's time.
    pub fn now(&self) -> Instant {
        Instant(self.started.elapsed().as_micros() as u64)
    }

    /// The server.
    pub fn server(&self) -> &Server {
        &self.server
    }

    /// The side of the robot's cells.
    pub fn resolution(&self) -> Millimetres {
        self.resolution
    }

    /// The robot that has a session.
    pub fn robot(&self) -> Option<RobotId> {
        self.server.robot_at(self.port)
    }

    /// The robot's last Hello; `None` on a sealed link.
    pub fn hello(&self) -> Option<&Hello> {
        self.hello.as_ref()
    }

    /// The robot's last status in its session.
    pub fn state(&self) -> Option<State> {
        self.server.state(self.robot()?)
    }

    /// Counters of the link.
    pub fn counters(&self) -> LinkSummary {
        LinkSummary::new(
            self.server.link_counters(self.port),
            self.server.message_counters(self.port),
        )
    }

    /// Bytes received and sent.
    pub fn bytes(&self) -> [u64; 2] {
        self.bytes
    }

    /// The oldest event that was not taken yet, and its time.
    pub fn poll_event(&mut self) -> Option<(Instant, Event)> {
        self.events.pop_front()
    }

    /// Does the work that is due, and what arrives within some milliseconds.
    ///
    /// # Errors
    /// [`RunError::Port`] if the port fails.
    pub fn turn(&mut self) -> Result<(), RunError> {
        self.send()?;
        let now = self.now();
        let due = self.server.poll_timeout(self.port, now);
        let wait = due.map_or(LONGEST_WAIT, |due| due.since(now).min(LONGEST_WAIT));
        let wait = time::Duration::from_micros(wait.micros().max(1_000));
        let mut bytes = std::mem::take(&mut self.buffer);
        let read = self.wire.reader.read_within(&mut bytes, wait);
        let now = self.now();
        if let Ok(count) = &read {
            self.receive(&bytes[..*count], now)?;
        }
        self.buffer = bytes;
        read?;
        self.server.timeout(now);
        self.send()
    }

    fn receive(&mut self, bytes: &[u8], now: Instant) -> Result<(), RunError> {
        self.bytes[0] += bytes.len() as u64;
        for overheard in self.ear.hear(bytes) {
            self.heard = Some(overheard);
            if let Overheard::Hello(hello) = overheard {
                self.hello = Some(hello);
                // A robot that is refused waits for 10 s.
                self.suit(hello.resolution)?;
            }
        }
        // The port is open.
        let _ = self.server.receive(self.port, bytes, now);
        while let Some((at, event)) = self.server.poll_event() {
            // On a sealed link the Hello was not readable before.
            if let Event::Refused(hello, RefusalReason::Resolution(_)) = &event {
                return self.suit(hello.resolution);
            }
            if self.events.len() >= MAX_EVENTS {
                self.events.pop_front();
            }
            self.events.push_back((at, event));
        }
        Ok(())
    }

    /// Takes over the robot's cells, unless it has a session.
    fn suit(&mut self, resolution: Millimetres) -> Result<(), RunError> {
        if resolution != self.resolution && self.robot().is_none() && resolution.0 > 0 {
            let is_keyed = !self.keys.is_empty();
            (self.server, self.port) = server(resolution, &self.keys, is_keyed)?;
            self.resolution = resolution;
        }
        Ok(())
    }

    fn send(&mut self) -> Result<(), RunError> {
        let now = self.now();
        let mut frame = [0; MAX_FRAME];
        while let Some(count) = self.server.poll_transmit(self.port, now, &mut frame) {
            match self.wire.writer.write(&frame[..count]) {
                Ok(()) => self.bytes[1] += count as u64,
                // The protocol sends again what must arrive.
                Err(WireError::Stalled { .. }) => {}
                Err(error) => return Err(error.into()),
            }
        }
        Ok(())
    }

    /// Turns until a condition is met, the time is up, or a signal interrupts. Returns whether it is met.
    ///
    /// # Errors
    /// As [`Bench::turn`].
    pub fn turn_until(
        &mut self,
        patience: Duration,
        mut is_met: impl FnMut(&mut Self) -> bool,
    ) -> Result<bool, RunError> {
        let end = self.now() + patience;
        while !is_met(self) {
            if self.now() >= end || interruption::is_requested() {
                return Ok(false);
            }
            self.turn()?;
        }
        Ok(true)
    }

    /// Waits for the robot's session.
    ///
    /// # Errors
    /// [`RunError::Bench`] says what was heard instead.
    pub fn wait_for_robot(&mut self) -> Result<RobotId, RunError> {
        self.turn_until(PATIENCE, |bench| bench.robot().is_some())?;
        self.robot().ok_or_else(|| match interruption::is_requested() {
            true => RunError::Interrupted,
            false => self.fault(self.why_none()),
        })
    }

    /// An error at this port.
    pub fn fault(&self, reason: impl Into<String>) -> RunError {
        RunError::Bench { port: self.name.clone(), reason: reason.into() }
    }

    fn why_none(&self) -> String {
        if let Some((_, event)) =
            self.events.iter().rev().find(|(_, it)| it.level() <= log::Level::Warn)
        {
            return format!("no session: {event}");
        }
        let is_keyed = !self.keys.is_empty();
        match (self.heard, self.ear.bytes()) {
            (Some(Overheard::SealedHello { robot, .. } | Overheard::SealedSession(robot)), _)
                if !is_keyed =>
            {
                format!("robot {} has a sealed link: give the folder of its key with --keys", robot.0)
            }
            (Some(Overheard::Hello(hello)), _) if is_keyed => {
                format!("robot {} has no key: leave out --keys", hello.robot.0)
            }
            (Some(_), _) => "a robot is there, but it did not take up a session; what it is sent may not reach it: \
                             check the line from this port's TX to its RX"
                .into(),
            (None, 0) => format!(
                "nothing came within {} s: check the robot's power, the line from its TX to this port's RX, and \
                 that ubimap ports shows it here",
                PATIENCE.micros() / 1_000_000
            ),
            (None, bytes) => format!(
                "{bytes} bytes came, but no robot's: check --baud, and that this is the robot's port to the server"
            ),
        }
    }

    /// Sends a command to the robot.
    ///
    /// # Errors
    /// [`RunError::Bench`] if it has no session any more.
    pub fn command(&mut self, command: Command) -> Result<(), RunError> {
        let robot = self.robot().ok_or_else(|| self.fault("the robot has no session any more"))?;
        self.server.command(robot, command).map_err(|error| self.fault(error.to_string()))
    }

    /// Tells the robot that it stands at this pose now, as cameras would.
    pub fn fix(&mut self, pose: Pose) {
        let Some(robot) = self.robot() else { return };
        let robots = vec![Sighting::usual(robot, pose)];
        let captured = self.now();
        self.server.observe(&Observation { captured, robots, ..Observation::default() });
    }

    /// Tells the robot, as cameras would, that it stands in a pen: the ground up to half a side from a pose is
    /// free, and a wall is around it. So it drives there and nowhere else, and has nothing to explore.
    pub fn pen(&mut self, around: Pose, half_side_m: f64) {
        let side = self.resolution.metres();
        let cell = |metres: f64| (metres / side).floor() as i32;
        let [x, y] = [around.x, around.y].map(|it| cell(it.metres()));
        let inside = cell(half_side_m);
        let all = -inside - PEN_WALL..=inside + PEN_WALL;
        let cells = all.clone().flat_map(|column| {
            all.clone().map(move |row| {
                let is_free = column.abs() <= inside && row.abs() <= inside;
                let is = if is_free { Cell::Free } else { Cell::Occupied };
                ((x + column, y + row), is)
            })
        });
        let captured = self.now();
        let cells = cells.collect();
        self.server.observe(&Observation { captured, cells, ..Observation::default() });
    }

    /// Number of states in the robot's session, which tells a new one from one with the same content.
    pub fn states(&self) -> u32 {
        self.robot().map_or(0, |robot| self.server.states(robot))
    }

    /// Lets a robot that stands at this pose look: it tells what it sees only when its pose has changed, so it is
    /// told poses that differ by a little, twice a second. Call it at every turn.
    pub fn look_from(&mut self, pose: Pose) {
        let now = self.now();
        if now < self.next_look {
            return;
        }
        (self.next_look, self.looks_ahead) = (now + LOOK_INTERVAL, !self.looks_ahead);
        let aside = if self.looks_ahead { LOOK_SHIFT } else { Millimetres(-LOOK_SHIFT.0) };
        self.fix(Pose { x: pose.x + aside, ..pose });
    }

    /// Carries out a parameter command. Returns the robot's report, whose values may have come in several
    /// messages.
    ///
    /// # Errors
    /// [`RunError::Bench`] if no answer comes.
    pub fn parameter(&mut self, action: ParameterAction) -> Result<ParameterReport, RunError> {
        self.commands += 1;
        let number = self.commands;
        self.command(Command::Parameter(ParameterCommand { number, action }))?;
        let mut whole: Option<ParameterReport> = None;
        let mut newest: Option<ParameterReport> = None;
        // More may follow the first one, if the frames are small.
        let is_list = matches!(action, ParameterAction::List);
        let mut end = None;
        self.turn_until(ANSWER, |bench| {
            let report = bench.robot().and_then(|robot| bench.server.parameters(robot)).cloned();
            if report != newest && report.as_ref().is_some_and(|it| it.number == number) {
                newest = report;
                end = Some(bench.now() + Duration::from_millis(if is_list { 300 } else { 0 }));
                if let (Some(whole), Some(newest)) = (&mut whole, &newest) {
                    // The list of all parameters fits.
                    let _ = whole.values.extend_from_slice(&newest.values);
                } else {
                    whole.clone_from(&newest);
                }
            }
            end.is_some_and(|end| bench.now() >= end)
        })?;
        whole.ok_or_else(|| match interruption::is_requested() {
            true => RunError::Interrupted,
            false => self.fault("the robot did not answer"),
        })
    }

    /// Sends a command when the session is left, whatever has ended it. The robot may be gone.
    pub fn bid_farewell(&mut self, command: Command) {
        self.has_farewell |= self.command(command).is_ok();
    }

    /// Lets the robot's least change of pose count as a motion, after which it tells what it sees, until the
    /// session is left. A program that was killed has left it so: that is said, and mended at the end.
    ///
    /// # Errors
    /// [`RunError::Bench`] if no answer comes.
    pub fn open_gate(&mut self) -> Result<(), RunError> {
        let gate = Parameter::GateDistance as u16;
        let before = self.parameter(ParameterAction::Get(gate))?;
        let before = before.values.first().map(|it| it.value);
        let (restored, was_left) = restored(before);
        // Before the change, so that an answer that is lost does not keep it from being taken back.
        self.gate = restored;
        if let (true, Some(usual)) = (was_left, restored) {
            log::warn!(
                "{}: gate-distance was 0 mm, as a killed ubimap sensor or wheels leaves it: the robot will get the \
                 usual {usual} mm at the end (or set it with ubimap param)",
                self.name
            );
        }
        let set = ParameterValue { parameter: gate, value: 0 };
        self.parameter(ParameterAction::Set(set))?;
        Ok(())
    }

    /// Takes [`Bench::open_gate`] back.
    fn close_gate(&mut self) {
        let Some(value) = self.gate.take() else { return };
        self.commands += 1;
        let set = ParameterValue { parameter: Parameter::GateDistance as u16, value };
        let action = ParameterAction::Set(set);
        let command = ParameterCommand { number: self.commands, action };
        self.bid_farewell(Command::Parameter(command));
    }
}

/// The gate to restore, in millimetres, by the one that was found; and whether that was left by a program that
/// was killed.
fn restored(found: Option<i32>) -> (Option<i32>, bool) {
    match found {
        Some(0) => (Some(Gate::default().distance.0), true),
        found => (found, false),
    }
}

impl Drop for Bench {
    /// Sends what waits; a signal does not keep the robot from being stopped.
    fn drop(&mut self) {
        self.close_gate();
        let end = self.now() + FAREWELL;
        while self.has_farewell && self.now() < end && self.turn().is_ok() {}
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_gate_that_a_killed_program_has_left_open_is_closed() {
        assert_eq!(restored(Some(50)), (Some(50), false));
        assert_eq!(restored(Some(0)), (Some(35), true));
        assert_eq!(restored(None), (None, false));
    }
}

//! A robot that runs in step with the simulation: a command, such as an emulator with an image, which waits for the
//! simulation as the simulation waits for it. So neither is late, however busy the computer is, and a run can be
//! repeated byte by byte if the command counts its time itself, as an emulator does by instructions.
//!
//! Robot and simulation take turns over the command's standard input and output. Numbers are little-endian; the ports
//! are those to the server, the sensor and the wheels, in this order.
//!
//! | message | bytes |
//! |---|---|
//! | of the robot | its time since boot in microseconds (8), then for each port a count (2) and as many bytes, which it has sent since its last message |
//! | the answer | for each port a count (2); then the bytes of all, which have arrived at it by that time |
//!
//! A robot sends a message every millisecond or so. Its lines to the server carry 115,200 bits per second.

use std::time;

use ubimap_protocol::{
    time::{Duration, Instant},
    units::RobotId,
};

use super::link::{BAUD, Link, PortBytes};
use crate::{
    channel::{
        process,
        wire::{Wire, WireError},
    },
    devices::Line,
    run::robot_clock::RobotClock,
};

/// Maximum time, of a clock on the wall, for which a robot may say nothing.
const PATIENCE: time::Duration = time::Duration::from_secs(30);

/// The latest time since boot in microseconds, which is past any run.
const LATEST: u64 = 1 << 50;

/// A robot in a process.
pub(super) struct InStep {
    command: String,
    wire: Wire,
    clock: RobotClock,
    /// A message whose time the simulation has not reached.
    waiting: Option<(Instant, PortBytes)>,
    /// The lines from and to the server.
    up: Line,
    down: Line,
    now: Instant,
    /// What the sensor and the wheels have sent since the last answer.
    arrived: [Vec<u8>; 2],
    /// Whether the robot waits for an answer.
    is_asked: bool,
}

impl InStep {
    /// Starts the command.
    ///
    /// # Errors
    /// [`WireError::Open`].
    pub(super) fn start(command: &str, robot: RobotId, seed: u64) -> Result<Self, WireError> {
        Ok(Self {
            command: command.to_owned(),
            wire: process::start(command)?,
            clock: RobotClock::from_boot(robot, seed),
            waiting: None,
            up: Line::new(BAUD),
            down: Line::new(BAUD),
            now: Instant(0),
            arrived: Default::default(),
            is_asked: false,
        })
    }

    /// The robot's next message, with its time by the simulation's clock.
    fn message(&mut self) -> Result<(Instant, PortBytes), WireError> {
        let mut time = [0; 8];
        self.read(&mut time)?;
        let mut bytes = PortBytes::default();
        for bytes in &mut bytes {
            let mut count = [0; 2];
            self.read(&mut count)?;
            bytes.resize(u16::from_le_bytes(count).into(), 0);
            self.read(bytes)?;
        }
        let time = Instant(u64::from_le_bytes(time).min(LATEST));
        // The clock of a robot never goes back.
        let time = self.clock.server(time).max(self.now);
        Ok((time, bytes))
    }

    fn read(&mut self, bytes: &mut [u8]) -> Result<(), WireError> {
        let mut done = 0;
        while done < bytes.len() {
            match self.wire.reader.read_within(&mut bytes[done..], PATIENCE)? {
                0 => return Err(self.silent()),
                count => done += count,
            }
        }
        Ok(())
    }

    fn silent(&self) -> WireError {
        let how = format!(
            "has said nothing for {} s; is the image built with the feature in-step?",
            PATIENCE.as_secs()
        );
        WireError::Ended { name: self.command.clone(), how }
    }
}

impl Link for InStep {
    fn receive(&mut self, until: Instant) -> Result<(Instant, PortBytes), WireError> {
        let (time, bytes) = match self.waiting.take() {
            Some(message) => message,
            None => self.message()?,
        };
        if time > until {
            self.waiting = Some((time, bytes));
            self.now = until;
            return Ok((until, PortBytes::default()));
        }
        self.now = time;
        self.is_asked = true;
        let [server, sensor, wheels] = bytes;
        self.up.send(&server, time);
        Ok((time, [self.up.poll(time), sensor, wheels]))
    }

    fn send(&mut self, devices: [Vec<u8>; 2]) -> Result<(), WireError> {
        for (arrived, mut sent) in self.arrived.iter_mut().zip(devices) {
            arrived.append(&mut sent);
        }
        if !std::mem::take(&mut self.is_asked) {
            return Ok(());
        }
        let [sensor, wheels] = std::mem::take(&mut self.arrived);
        let mut ports = [self.down.poll(self.now), sensor, wheels];
        // A robot that says nothing for so long has no room for them.
        ports.iter_mut().for_each(|bytes| bytes.truncate(u16::MAX.into()));
        let counts = ports.iter().flat_map(|bytes| (bytes.len() as u16).to_le_bytes());
        let answer: Vec<u8> = counts.chain(ports.concat()).collect();
        self.wire.writer.write(&answer)
    }

    fn transmit(&mut self, frame: &[u8], now: Instant) -> Result<(), WireError> {
        self.down.send(frame, now);
        Ok(())
    }

    fn late(&self) -> Option<Duration> {
        None
    }
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;

    /// A robot that says this, given as octal escapes, then prints what it is told.
    fn robot(says: &str) -> InStep {
        let command = format!("sh -c 'printf \"{says}\"; exec cat >&2'");
        InStep::start(&command, RobotId(1), 1).unwrap()
    }

    /// At 10.000 ms "AB" to the server and "C" to the wheels.
    const FIRST: &str = r"\020\047\0\0\0\0\0\0\2\0AB\0\0\1\0C";
    /// At 10.087 ms nothing.
    const SECOND: &str = r"\147\047\0\0\0\0\0\0\0\0\0\0\0\0";

    #[test]
    fn a_message_waits_until_the_simulation_has_come_to_its_time() {
        let mut robot = robot(&[FIRST, SECOND].concat());
        for until in [0, 5_000, 9_998] {
            let got = robot.receive(Instant(until)).unwrap();
            assert_eq!(got, (Instant(until), PortBytes::default()));
            robot.send([vec![7], vec![8, 9]]).unwrap();
        }
        assert_eq!(robot.arrived, [vec![7; 3], vec![8, 9, 8, 9, 8, 9]], "no answer yet");
        // A clock that is 40 ppm fast or slow, as an emulated robot's is not, moves 10 ms by less than 1 us.
        let (now, [server, sensor, wheels]) = robot.receive(Instant(20_000)).unwrap();
        assert!(now.micros().abs_diff(10_000) <= 1, "{now:?}");
        assert_eq!((server, sensor, wheels), (vec![], vec![], b"C".to_vec()));
        robot.send(Default::default()).unwrap();
        assert_eq!(robot.arrived, <[Vec<u8>; 2]>::default(), "answered");
        // A byte takes 87 us to the server.
        let (now, [server, ..]) = robot.receive(Instant(20_000)).unwrap();
        assert!(now.micros().abs_diff(10_087) <= 1, "{now:?}");
        assert_eq!(server, b"A");
    }

    #[test]
    fn a_robot_that_has_ended_is_told_and_its_times_never_go_back() {
        // At 2^64 - 1 us nothing.
        let late = r"\377\377\377\377\377\377\377\377\0\0\0\0\0\0";
        let mut it = robot(late);
        assert_eq!(it.receive(Instant(7)).unwrap(), (Instant(7), PortBytes::default()));

        let mut it = robot(&[FIRST, SECOND, FIRST].concat());
        let mut last = Instant(0);
        for _ in 0..3 {
            let (now, _) = it.receive(Instant(20_000)).unwrap();
            assert!(now >= last);
            last = now;
            it.send(Default::default()).unwrap();
        }

        let mut it = InStep::start("true", RobotId(1), 1).unwrap();
        let error = it.receive(Instant(7)).unwrap_err();
        assert_eq!(error.to_string(), "true: the command has ended (exit status: 0)");
    }
}

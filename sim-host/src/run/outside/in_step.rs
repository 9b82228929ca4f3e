//! A robot that runs in step with the simulation: a command, such as an emulator with an image, which waits for the
//! simulation as the simulation waits for it. So neither is late, however busy the computer is, and a run can be
//! repeated byte by byte if the command's time depends on nothing but its input. Runs with QEMU, which counts
//! instructions, were the same mostly, not always.
//!
//! Robot and simulation take turns over the command's standard input and output. Numbers are little-endian; the ports
//! are those to the server, the sensor and the wheels, in this order.
//!
//! | message | bytes |
//! |---|---|
//! | of the robot | its time since boot in microseconds (8), then for each port a count (2) and as many bytes, which it has sent since its last message |
//! | the answer | for each port a count (2); then the bytes of all, which have arrived at it by that time |
//!
//! A robot sends a message every millisecond or so, and reads each answer before the next. Its clock differs from the
//! simulation's by up to 40 ppm. Its lines to and from the server carry 115,200 bits per second, and the devices' as well
//! towards it; what it sends is out of its queues at once.

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

/// Maximum wall-clock time for which a robot may say nothing.
const PATIENCE: time::Duration = time::Duration::from_secs(30);

/// Maximum number of messages with the same time.
const STANDSTILL: u32 = 10_000;

/// The latest time since boot in microseconds, which is past any run.
const LATEST: u64 = 1 << 50;

/// A robot in a process.
pub(super) struct InStep {
    command: String,
    wire: Wire,
    clock: RobotClock,
    /// Its time in the last message, in microseconds, and the number of messages with that.
    shown: (u64, u32),
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
            shown: (0, 0),
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
        let shown = u64::from_le_bytes(time).min(LATEST);
        let (last, count) = self.shown;
        self.shown = (shown, if shown == last { count + 1 } else { 0 });
        if shown < last {
            return Err(self.ended(format!(
                "has reset, after a fault in its program: its clock went from {last} to {shown} us"
            )));
        }
        if count > STANDSTILL {
            return Err(self.ended(format!("its clock stands still at {shown} us")));
        }
        // The simulation may have come a little further, as its clock is another one.
        let time = self.clock.server(Instant(shown)).max(self.now);
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
        self.ended(format!(
            "has said nothing for {} s; is the image built with the feature in-step?",
            PATIENCE.as_secs()
        ))
    }

    fn ended(&self, how: String) -> WireError {
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
        // So many arrive only after seconds without a message, when the robot's queues are full.
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

    /// A robot that writes these bytes (octal escapes), and then copies what it receives to standard error.
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
        // A clock that is 40 ppm fast or slow moves 10 ms by less than 1 us.
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
    fn a_robot_that_has_ended_or_reset_or_stands_still_is_told() {
        // At 2^64 - 1 us nothing.
        let late = r"\377\377\377\377\377\377\377\377\0\0\0\0\0\0";
        let mut it = robot(late);
        assert_eq!(it.receive(Instant(7)).unwrap(), (Instant(7), PortBytes::default()));

        let end = |mut it: InStep| {
            loop {
                match it.receive(Instant(20_000)) {
                    Ok(_) => it.send(Default::default()).unwrap(),
                    Err(error) => break error.to_string(),
                }
            }
        };
        let reset = end(robot(&[FIRST, SECOND, FIRST].concat()));
        assert!(reset.contains("has reset") && reset.contains("from 10087 to 10000 us"), "{reset}");
        let command = format!("sh -c 'while printf \"{SECOND}\"; do :; done'");
        let still = end(InStep::start(&command, RobotId(1), 1).unwrap());
        assert!(still.contains("stands still at 10087 us"), "{still}");

        let mut it = InStep::start("true", RobotId(1), 1).unwrap();
        let error = it.receive(Instant(7)).unwrap_err();
        assert_eq!(error.to_string(), "true: the command has ended (exit status: 0)");
    }
}

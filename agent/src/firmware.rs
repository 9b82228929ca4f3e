//! The main loop of an image: it joins a [`Machine`] with a [`Board`] and its status LED.

use ubimap_protocol::{
    frame::DEFAULT_FRAME,
    message::ParameterValue,
    time::{Duration, Instant},
};

use crate::{
    Machine, Port,
    device::{DepthSensor, Wheels},
    drive::Drive,
    journal::Entry,
};

/// What the main loop needs of a board. Nothing here waits, except [`Board::wait`].
pub trait Board {
    /// Whether the board stores parameters. The configuration must say the same
    /// ([`Config::keeps_parameters`](crate::Config::keeps_parameters)).
    const STORES: bool = false;

    /// The time since boot; monotonic.
    fn now(&self) -> Instant;

    /// Reads what has arrived at a port, in the order of arrival. Returns the number of bytes.
    fn read(&mut self, port: Port, bytes: &mut [u8]) -> usize;

    /// Number of bytes that [`Board::write`] accepts now.
    fn room(&mut self, port: Port) -> usize;

    /// Sends bytes, no more than there is room for: to the server one frame, to a device one command.
    fn write(&mut self, port: Port, bytes: &[u8]);

    /// Writes to the journal, if there is one.
    fn note(&mut self, now: Instant, entry: Entry<'_>);

    /// Restarts the watchdog's time.
    fn feed_watchdog(&mut self);

    /// Sets the status LED.
    fn show(&mut self, lit: bool);

    /// Stores parameters, which may take seconds, for which the watchdog must wait. Returns whether they are
    /// stored. Only a board that [`STORES`](Self::STORES) them is asked.
    fn store(&mut self, _parameters: &[ParameterValue]) -> bool {
        false
    }

    /// Sleeps until something arrives at a port, at most a millisecond.
    fn wait(&mut self);
}

/// Maximum length of a command to a device, in bytes.
pub const MAX_COMMAND: usize = 32;

/// Without a session the status LED blinks: this is the time for which it is on, and then off, as a
/// power of two in microseconds: 2^18 us, 0.26 s.
const BLINK: u32 = 18;

/// Connects a board and a machine for ever: after every input it drains the outputs, then sleeps until
/// the next deadline or byte. Ports that are not `served` stay silent. `read_others` passes on what does
/// not arrive at a port, such as the counts of encoders.
pub fn run<B: Board, S: DepthSensor, W: Wheels, D: Drive>(
    board: &mut B,
    machine: &mut Machine<'_, S, W, D>,
    served: &[Port],
    mut read_others: impl FnMut(&mut B, &mut Machine<'_, S, W, D>, Instant),
) -> ! {
    loop {
        turn(board, machine, served, &mut read_others);
    }
}

/// One turn of [`run`], for a board that starts something slowly: the first bytes to a base stop what still
/// turns from before a reset.
#[inline]
pub fn turn<B: Board, S: DepthSensor, W: Wheels, D: Drive>(
    board: &mut B,
    machine: &mut Machine<'_, S, W, D>,
    served: &[Port],
    mut read_others: impl FnMut(&mut B, &mut Machine<'_, S, W, D>, Instant),
) {
    let mut bytes = [0; DEFAULT_FRAME];
    let mut is_quiet = true;
    for &port in served {
        let count = board.read(port, &mut bytes);
        if let Some(received @ [_, ..]) = bytes.get(..count) {
            is_quiet = false;
            let now = board.now();
            board.note(now, Entry::Received(port, received));
            machine.receive(port, received, now);
        }
    }
    let now = board.now();
    board.note(now, Entry::Timeout);
    read_others(board, machine, now);
    machine.timeout(now);
    if B::STORES
        && let Some(parameters) = machine.poll_store(now)
    {
        machine.stored(board.store(&parameters));
    }
    for &port in served {
        let largest = if port == Port::Server { DEFAULT_FRAME } else { MAX_COMMAND };
        // The port's interrupt makes room meanwhile.
        while board.room(port) >= largest {
            let now = board.now();
            let count = machine.poll_transmit(port, now, &mut bytes).unwrap_or_default();
            let transmitted = bytes.get(..count).unwrap_or_default();
            board.note(now, Entry::Transmitted(port, transmitted));
            if transmitted.is_empty() {
                break;
            }
            board.write(port, transmitted);
        }
    }
    board.feed_watchdog();
    let now = board.now();
    board.show(machine.robot().is_connected() || blinks(now));
    if is_quiet && now < machine.poll_timeout() {
        board.wait();
    }
}

/// Why a robot can't work: the number of flashes of its status LED.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    /// The slice is not one of the sensor's images.
    Sensor = 2,
    /// The robot's configuration is invalid.
    Robot = 3,
    /// The robot has a key, but its flash does not keep the number of its boots.
    Flash = 4,
    /// The robot does not know its network or its server, or has no radio.
    Network = 5,
}

/// Flashes the status LED for ever: as many times as the fault's number, then a pause.
pub fn fail(board: &mut impl Board, fault: Fault) -> ! {
    loop {
        for _ in 0..fault as u8 {
            for lit in [true, false] {
                board.show(lit);
                pause(board, Duration::from_millis(200));
            }
        }
        pause(board, Duration::from_millis(1_000));
    }
}

fn pause(board: &mut impl Board, time: Duration) {
    let end = board.now() + time;
    while board.now() < end {
        board.feed_watchdog();
    }
}

/// Whether a blinking LED is lit at `now`.
fn blinks(now: Instant) -> bool {
    now.micros() >> BLINK & 1 == 0
}

#[cfg(test)]
mod tests {
    use std::{collections::VecDeque, vec::Vec};

    use ubimap_protocol::units::RobotId;

    use super::*;
    use crate::{
        Bounds, Config, Memory,
        device::{create2::Create2, ld06::Ld06},
        memory,
    };

    const BOUNDS: Bounds = Bounds { readings: 360, ..Bounds::REFERENCE };

    /// A board in whose time each turn takes a millisecond.
    #[derive(Default)]
    struct Model {
        now: Instant,
        arrived: [VecDeque<u8>; 3],
        sent: [Vec<usize>; 3],
        /// What the main loop was told.
        heard: Vec<(Port, usize)>,
        /// The last command to a device.
        last: Vec<u8>,
        lit: Vec<bool>,
        fed: usize,
        waits: usize,
    }

    impl Board for Model {
        fn now(&self) -> Instant {
            self.now
        }

        fn read(&mut self, port: Port, bytes: &mut [u8]) -> usize {
            let arrived = &mut self.arrived[port as usize];
            let count = arrived.len().min(bytes.len());
            bytes.iter_mut().zip(arrived.drain(..count)).for_each(|(place, byte)| *place = byte);
            count
        }

        fn room(&mut self, port: Port) -> usize {
            // A device takes one command per turn.
            let is_full = port != Port::Server && self.sent[port as usize].len() > self.fed;
            if is_full { MAX_COMMAND - 1 } else { DEFAULT_FRAME }
        }

        fn write(&mut self, port: Port, bytes: &[u8]) {
            assert!(bytes.len() <= self.room(port), "{port:?}: {} bytes", bytes.len());
            assert!(port == Port::Server || bytes.len() <= MAX_COMMAND);
            self.sent[port as usize].push(bytes.len());
            if port != Port::Server {
                self.last = bytes.to_vec();
            }
        }

        fn note(&mut self, _: Instant, entry: Entry<'_>) {
            if let Entry::Received(port, bytes) = entry {
                self.heard.push((port, bytes.len()));
            }
        }

        fn feed_watchdog(&mut self) {
            self.fed += 1;
        }

        fn show(&mut self, lit: bool) {
            self.lit.push(lit);
        }

        fn wait(&mut self) {
            self.waits += 1;
        }
    }

    /// Turns the loop for a time in milliseconds. Returns the number of calls of `read_others`.
    fn turns(board: &mut Model, served: &[Port], count: usize) -> usize {
        let config = Config::new(RobotId(1), Ld06::sensor(360), BOUNDS);
        let mut memory: std::boxed::Box<memory!(BOUNDS)> = std::boxed::Box::new(Memory::EMPTY);
        let mut readings = [0; 360];
        let sensor = Ld06::new(&mut readings);
        let mut machine = Machine::new(config, &mut memory, sensor, Create2::new()).unwrap();
        let mut others = 0;
        for _ in 0..count {
            turn(board, &mut machine, served, |_, _, _| others += 1);
            board.now = board.now + Duration::from_millis(1);
        }
        others
    }

    #[test]
    fn only_served_ports_are_read_and_written() {
        for served in [&Port::ALL[..], &[Port::Server]] {
            let arrived = [0, 1, 2].map(|_| [0x55; 600].into());
            let mut board = Model { arrived, ..Model::default() };
            assert_eq!(turns(&mut board, served, 5_000), 5_000);
            let is_served = Port::ALL.map(|port| served.contains(&port));
            assert_eq!(board.arrived.each_ref().map(VecDeque::is_empty), is_served);
            let mut ports: Vec<_> = board.heard.iter().map(|(port, _)| *port).collect();
            ports.dedup();
            assert_eq!(
                board.heard.iter().map(|(_, count)| count).sum::<usize>(),
                600 * served.len()
            );
            assert_eq!(ports[..served.len()], *served);
            // Three turns read them, and do not wait.
            assert!(board.waits <= 4_997, "{}", board.waits);
            // It says Hello; the lidar needs no commands, the Create 2 does.
            let sends = board.sent.map(|sent| !sent.is_empty());
            assert_eq!(sends, [true, false, is_served[2]]);
        }
    }

    #[test]
    fn the_first_turn_stops_the_wheels() {
        let mut board = Model::default();
        turns(&mut board, &Port::ALL, 1);
        // The Create 2's opcode 128 ends the mode in which it drives.
        assert_eq!(board.sent[Port::Wheels as usize], [1]);
        assert_eq!(board.last, [128]);
    }

    #[test]
    fn the_watchdog_is_fed_and_the_led_blinks_without_a_session() {
        let mut board = Model::default();
        turns(&mut board, &Port::ALL, 4_194);
        // Half of the time, in eight periods of 2^19 us.
        assert_eq!((board.fed, board.lit.len()), (4_194, 4_194));
        let lit = board.lit.iter().filter(|lit| **lit).count();
        assert!(lit.abs_diff(2_097) < 9, "{lit}");
        let changes = board.lit.windows(2).filter(|pair| pair[0] != pair[1]).count();
        assert_eq!(changes, 15);
        assert_eq!(board.waits, 4_194, "nothing arrives");
    }
}

//! The main loop of an image: it joins a [`Machine`] with a [`Board`] and its status LED.

use ubimap_protocol::{
    frame::DEFAULT_FRAME,
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
    let mut bytes = [0; DEFAULT_FRAME];
    loop {
        turn(board, machine, served, &mut read_others, &mut bytes);
    }
}

/// One turn of the main loop.
#[inline]
fn turn<B: Board, S: DepthSensor, W: Wheels, D: Drive>(
    board: &mut B,
    machine: &mut Machine<'_, S, W, D>,
    served: &[Port],
    mut read_others: impl FnMut(&mut B, &mut Machine<'_, S, W, D>, Instant),
    bytes: &mut [u8; DEFAULT_FRAME],
) {
    let mut is_quiet = true;
    for &port in served {
        let count = board.read(port, bytes);
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
    for &port in served {
        let largest = if port == Port::Server { DEFAULT_FRAME } else { MAX_COMMAND };
        // The port's interrupt makes room meanwhile.
        while board.room(port) >= largest {
            let now = board.now();
            let count = machine.poll_transmit(port, now, bytes).unwrap_or_default();
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

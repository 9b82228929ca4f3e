//! What the images have in common: a robot and its main loop.

use core::panic::PanicInfo;

use cortex_m::peripheral::SCB;
use embedded_hal::{delay::DelayNs, digital::OutputPin};
#[cfg(feature = "flash")]
use ubimap_agent::flash::Identity;
use ubimap_agent::{
    Config, ConfigError, Machine, Memory, Port, Storage, device::DepthSensor, drive::Drive,
    journal::Entry,
};
#[cfg(feature = "flash")]
use ubimap_protocol::units::RobotId;
use ubimap_protocol::{frame::DEFAULT_FRAME, time::Instant};

use crate::{
    board::{self, Board, Clock, Led},
    configuration,
    journal::Journal,
    wheels::{self, Base},
};

/// Without a session the status LED blinks: this is the time for which it is on, and then off, as a
/// power of two in microseconds: 2^18 us, 0.26 s.
const BLINK: u32 = 18;

/// Connects the ports and the robot for ever.
pub(crate) fn run<D: Drive>(
    mut board: Board,
    drive: D,
    memory: &'static mut Memory<impl Storage, D>,
    slice: &'static mut [u16],
) -> ! {
    let nonce = (board.nonce ^ board.nonce >> 32) as u32;
    let Some(served) = served(&board) else { fail(&mut board, Fault::Flash) };
    // Borrowed, because moving it would take twice its size of stack.
    match &mut machine(&mut board, nonce, drive, memory, slice) {
        Some(Ok(machine)) => {
            if board.was_reset_by_watchdog {
                machine.report_watchdog(board.clock.now());
            }
            let journal = Journal::begin(&mut board.journal, nonce);
            turn(&mut board, machine, journal, served)
        }
        Some(Err(_)) => fail(&mut board, Fault::Robot),
        None => fail(&mut board, Fault::Sensor),
    }
}

/// The ports that are served: only the server's if the robot does not know its number: it
/// then says so, and has no devices. `None` if the board's flash must not be relied on.
#[cfg(feature = "flash")]
fn served(board: &Board) -> Option<&'static [Port]> {
    match board.identity {
        Identity::Known(..) => Some(&PORTS),
        Identity::Unknown => Some(&PORTS[..1]),
        Identity::NotKept => None,
    }
}

/// Without the feature `flash` the configuration is complete.
#[cfg(not(feature = "flash"))]
fn served(_: &Board) -> Option<&'static [Port]> {
    Some(&PORTS)
}

/// The robot with its devices; `None` if the slice is not one of the sensor's images, or the wheels are
/// taken.
// Not inlined, so that the parts that it is made of leave the stack. The result is written in place.
#[inline(never)]
fn machine<D: Drive, S: Storage>(
    board: &mut Board,
    boot_nonce: u32,
    drive: D,
    memory: &'static mut Memory<S, D>,
    slice: &'static mut [u16],
) -> Option<Result<Machine<'static, impl DepthSensor + use<D, S>, Base, D>, ConfigError>> {
    let sensor = configuration::sensor(slice)?;
    let config = identified(board, configuration::config(boot_nonce)).with_drive(drive);
    Some(Machine::new(config, memory, sensor, wheels::base(board)?))
}

/// Completes a configuration by what the board's flash says.
#[cfg(feature = "flash")]
fn identified(board: &Board, mut config: Config) -> Config {
    match &board.identity {
        Identity::Known(record, seal) => {
            (config.robot, config.seal) = (record.robot, *seal);
            config.set(&record.parameters);
        }
        Identity::Unknown | Identity::NotKept => config.robot = RobotId(0),
    }
    config
}

/// Without the feature `flash` the configuration is complete.
#[cfg(not(feature = "flash"))]
fn identified(_: &Board, config: Config) -> Config {
    config
}

/// The main loop: after every input it drains the outputs, then sleeps until the next deadline or
/// byte.
fn turn<D: Drive>(
    board: &mut Board,
    machine: &mut Machine<'_, impl DepthSensor, Base, D>,
    mut journal: Journal,
    served: &'static [Port],
) -> ! {
    let mut bytes = [0; DEFAULT_FRAME];
    loop {
        let mut is_quiet = true;
        for (serial, port) in board.ports.iter_mut().zip(served.iter().copied()) {
            let count = serial.read(&mut bytes);
            if let Some(received @ [_, ..]) = bytes.get(..count) {
                is_quiet = false;
                let now = board.clock.now();
                journal.note(&mut board.journal, now, Entry::Received(port, received));
                machine.receive(port, received, now);
            }
        }
        let now = board.clock.now();
        journal.note(&mut board.journal, now, Entry::Timeout);
        look(board, machine, now);
        wheels::count(board, machine, now);
        machine.timeout(now);
        for (serial, port) in board.ports.iter_mut().zip(served.iter().copied()) {
            let largest = if port == Port::Server { DEFAULT_FRAME } else { MAX_COMMAND };
            // The port's interrupt makes room meanwhile.
            while serial.room() >= largest {
                let now = board.clock.now();
                let count = machine.poll_transmit(port, now, &mut bytes).unwrap_or_default();
                let transmitted = bytes.get(..count).unwrap_or_default();
                journal.note(&mut board.journal, now, Entry::Transmitted(port, transmitted));
                if transmitted.is_empty() {
                    break;
                }
                serial.write(transmitted);
            }
        }
        board.watchdog.feed();
        let now = board.clock.now();
        show(&mut board.led, machine.robot().is_connected() || blinks(now));
        if is_quiet && now < machine.poll_timeout() {
            board::wait(&board.ports);
        }
    }
}

/// Passes a frame of a sensor that is not at a port on to the robot, if there is one.
#[cfg(feature = "vl53")]
fn look<D: Drive>(
    board: &mut Board,
    machine: &mut Machine<'_, impl DepthSensor, Base, D>,
    now: Instant,
) {
    if let Some(frame) = board.zones.as_mut().and_then(|sensor| sensor.frame(now)) {
        machine.receive(Port::Sensor, &frame, now);
    }
}

/// The sensor is at a port.
#[cfg(not(feature = "vl53"))]
fn look<D: Drive>(_: &Board, _: &Machine<'_, impl DepthSensor, Base, D>, _: Instant) {}

/// Maximum length of a command to a device, in bytes.
const MAX_COMMAND: usize = 32;

/// The machine's ports in the order of the board's.
const PORTS: [Port; 3] = [Port::Server, Port::Sensor, Port::Wheels];

/// Why the constants above can't work: the number of flashes of the LED.
#[derive(Clone, Copy)]
enum Fault {
    /// The slice is not one of the sensor's images.
    Sensor = 2,
    /// The robot's configuration is invalid.
    Robot = 3,
    /// The robot has a key, but its flash does not keep the number of its boots.
    Flash = 4,
}

/// Flashes the LED for ever: as many times as the fault's number, then a pause.
fn fail(board: &mut Board, fault: Fault) -> ! {
    loop {
        for _ in 0..fault as u8 {
            flash(&mut board.led, &mut board.clock);
            board.watchdog.feed();
        }
        board.clock.delay_ms(1_000);
        board.watchdog.feed();
    }
}

/// Flashes the status LED once.
fn flash(led: &mut Led, clock: &mut Clock) {
    show(led, true);
    clock.delay_ms(200);
    show(led, false);
    clock.delay_ms(200);
}

/// Whether a blinking LED is lit at `now`.
fn blinks(now: Instant) -> bool {
    now.micros() >> BLINK & 1 == 0
}

/// Sets the status LED; a failure of the LED is ignored.
fn show(led: &mut impl OutputPin, lit: bool) {
    let _ = led.set_state(lit.into());
}

/// Resets the chip.
pub(crate) fn reset() -> ! {
    SCB::sys_reset()
}

/// Resets on panic; the link recovers as after any boot.
#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    reset()
}

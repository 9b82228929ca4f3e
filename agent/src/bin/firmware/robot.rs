//! What the images have in common: a robot and its main loop.

use core::panic::PanicInfo;

use cortex_m::peripheral::SCB;
use embedded_hal::digital::OutputPin;
use ubimap_agent::{
    Config, ConfigError, Machine, Memory, Port, Storage,
    device::DepthSensor,
    drive::Drive,
    firmware::{self, Board as _, Fault},
    journal::Entry,
};
#[cfg(feature = "flash")]
use ubimap_protocol::message::ParameterValue;
use ubimap_protocol::time::Instant;

use crate::{
    board::{self, Board, Serial},
    configuration,
    journal::Journal,
    wheels::{self, Base},
};

/// Connects the ports and the robot for ever.
pub(crate) fn run<D: Drive>(
    mut board: Board,
    drive: D,
    memory: &'static mut Memory<impl Storage, D>,
    slice: &'static mut [u16],
) -> ! {
    let nonce = (board.nonce ^ board.nonce >> 32) as u32;
    let served = served(&board);
    // Borrowed, because moving it would take twice its size of stack.
    let machine = &mut machine(&mut board, nonce, drive, memory, slice);
    let journal = Journal::begin(&mut board.journal, nonce);
    let was_reset_by_watchdog = board.was_reset_by_watchdog;
    let mut running = Running { board: &mut board, journal };
    let fault = match (machine, served) {
        (_, None) => Fault::Flash,
        (Some(Ok(machine)), Some(served)) => {
            if was_reset_by_watchdog {
                machine.report_watchdog(running.now());
            }
            firmware::run(&mut running, machine, served, |running, machine, now| {
                #[cfg(feature = "in-step")]
                running.board.step();
                look(running.board, machine, now);
                wheels::count(running.board, machine, now);
            })
        }
        (Some(Err(_)), _) => Fault::Robot,
        (None, _) => Fault::Sensor,
    };
    firmware::fail(&mut running, fault)
}

/// The ports that are served; `None` if the board's flash must not be relied on.
#[cfg(feature = "flash")]
fn served(board: &Board) -> Option<&'static [Port]> {
    board.identity.served()
}

/// Without the feature `flash` the configuration is complete.
#[cfg(not(feature = "flash"))]
fn served(_: &Board) -> Option<&'static [Port]> {
    Some(&Port::ALL)
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
fn identified(board: &Board, config: Config) -> Config {
    board.identity.complete(config)
}

/// Without the feature `flash` the configuration is complete.
#[cfg(not(feature = "flash"))]
fn identified(_: &Board, config: Config) -> Config {
    config
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

/// The board and the journal, as the main loop sees them.
struct Running<'b> {
    board: &'b mut Board,
    journal: Journal,
}

impl Running<'_> {
    fn serial(&mut self, port: Port) -> &mut Serial {
        let [server, sensor, wheels] = &mut self.board.ports;
        match port {
            Port::Server => server,
            Port::Sensor => sensor,
            Port::Wheels => wheels,
        }
    }
}

impl firmware::Board for Running<'_> {
    const STORES: bool = cfg!(feature = "flash");

    fn now(&self) -> Instant {
        self.board.clock.now()
    }

    fn read(&mut self, port: Port, bytes: &mut [u8]) -> usize {
        self.serial(port).read(bytes)
    }

    fn room(&mut self, port: Port) -> usize {
        self.serial(port).room()
    }

    fn write(&mut self, port: Port, bytes: &[u8]) {
        self.serial(port).write(bytes);
    }

    fn note(&mut self, now: Instant, entry: Entry<'_>) {
        self.journal.note(&mut self.board.journal, now, entry);
    }

    fn feed_watchdog(&mut self) {
        self.board.watchdog.feed();
    }

    fn show(&mut self, lit: bool) {
        // A failure of the LED is ignored.
        let _ = OutputPin::set_state(&mut self.board.led, lit.into());
    }

    #[cfg(feature = "flash")]
    fn store(&mut self, parameters: &[ParameterValue]) -> bool {
        self.board.store(parameters)
    }

    fn wait(&mut self) {
        board::wait(&self.board.ports);
    }
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

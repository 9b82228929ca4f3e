//! What the images have in common: the robot's configuration and its main loop. Change the constants
//! for another robot.

use core::panic::PanicInfo;

use cortex_m::peripheral::SCB;
use embedded_hal::{delay::DelayNs, digital::OutputPin};
use ubimap_agent::{
    Bounds, Config, Machine, Memory, Port, Robot, Storage,
    device::{
        a010::{A010, A010Config},
        create2::Create2,
    },
    drive::Drive,
    sense::{Camera, Pick, Slice, Slicer, Validity},
};
use ubimap_protocol::{
    frame::DEFAULT_FRAME,
    time::Instant,
    units::{Angle, Millimetres, Pose, RobotId},
};

use crate::board::{self, Board, Clock, Led};

/// The robot's id, unique in a deployment.
const ROBOT: RobotId = RobotId(1);

/// The baud rates of the ports to the server, the depth sensor and the wheels.
pub(crate) const BAUDS: [u32; 3] = [115_200; 3];

/// The depth sensor: as fine as its port carries ten frames per second.
const SENSOR: A010Config = A010Config::for_port(BAUDS[1]).expect("the port is too slow");

/// Pixels per row of the sensor.
const SIDE: usize = SENSOR.binning.side();

/// The middle of the image, in pixels.
const MIDDLE: f32 = (SIDE - 1) as f32 / 2.0;

/// The focal length in pixels: half the width divided by the tangent of half the field of view of 70
/// degrees.
const FOCAL: f32 = SIDE as f32 / 2.0 / 0.700_207_5;

/// The sensor in `base_link`: 10 cm ahead of the middle between the wheels, facing ahead.
const MOUNTING: Pose = Pose { x: Millimetres(100), y: Millimetres(0), heading: Angle(0) };

/// The rows of the image that are mapped: the middle one and its neighbours, for a sensor that looks
/// straight ahead above the highest bump of the floor.
const SLICE: Slice = Slice::Band { first: (SIDE / 2 - 1) as u16, rows: 3, pick: Pick::Nearest };

/// Size of the slicer's buffer, in readings.
pub(crate) const SLICE_LENGTH: usize = SLICE.buffer_len(SIDE);

/// The sizes of the robot's memory. The side of a cell must equal the server's.
pub(crate) const BOUNDS: Bounds = Bounds { readings: SIDE, own_tiles: 12, ..Bounds::REFERENCE };

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
    let camera = Camera::new((FOCAL, FOCAL), (MIDDLE, MIDDLE));
    let config = Config {
        boot_nonce: (board.nonce ^ board.nonce >> 32) as u32,
        mounting: MOUNTING,
        ..Config::new(ROBOT, SLICE.sensor(camera), BOUNDS)
    };
    let slicer = Slicer::new(SLICE, camera, SIDE, Validity::default(), slice);
    let Some(sensor) = slicer.ok().and_then(|slicer| A010::new(SENSOR, slicer).ok()) else {
        fail(&mut board, Fault::Sensor)
    };
    let robot = match Robot::new(config.with_drive(drive), memory) {
        Ok(robot) => robot,
        Err(_) => fail(&mut board, Fault::Robot),
    };
    let mut machine = Machine::new(robot, sensor, Create2::new());
    if board.was_reset_by_watchdog {
        machine.report_watchdog(board.clock.now());
    }
    turn(&mut board, &mut machine)
}

/// The main loop: after every input it drains the outputs, then sleeps until the next deadline or
/// byte.
fn turn<D: Drive>(board: &mut Board, machine: &mut Machine<'_, A010<'_>, Create2, D>) -> ! {
    let mut bytes = [0; DEFAULT_FRAME];
    loop {
        let mut is_quiet = true;
        for (serial, port) in board.ports.iter_mut().zip(PORTS) {
            let count = serial.read(&mut bytes);
            is_quiet &= count == 0;
            machine.receive(port, bytes.get(..count).unwrap_or_default(), board.clock.now());
        }
        machine.timeout(board.clock.now());
        for (serial, port) in board.ports.iter_mut().zip(PORTS) {
            // The port's interrupt makes room meanwhile.
            while serial.room() >= DEFAULT_FRAME
                && let Some(count) = machine.poll_transmit(port, board.clock.now(), &mut bytes)
            {
                serial.write(bytes.get(..count).unwrap_or_default());
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

/// The machine's ports in the order of the board's.
const PORTS: [Port; 3] = [Port::Server, Port::Sensor, Port::Wheels];

/// Why the constants above can't work: the number of flashes of the LED.
#[derive(Clone, Copy)]
enum Fault {
    /// The slice is not one of the sensor's images.
    Sensor = 2,
    /// The robot's configuration is invalid.
    Robot = 3,
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

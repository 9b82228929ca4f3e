//! The firmware of the reference board.
#![no_std]
#![no_main]

#[path = "../board/stm32f405.rs"]
mod board;

use core::panic::PanicInfo;

use board::Board;
use cortex_m::peripheral::SCB;
use cortex_m_rt::entry;
use embedded_hal::{delay::DelayNs, digital::OutputPin};
use ubimap_agent::{Bounds, Config, Memory, Robot, memory, sense::SensorModel};
use ubimap_protocol::{frame::DEFAULT_FRAME, time::Instant, units::RobotId};

/// The robot's id, unique in a deployment.
const ROBOT: RobotId = RobotId(1);

/// The baud rate of the port to the server.
const BAUD: u32 = 115_200;

/// The sizes of the robot's memory, for a forward-looking depth sensor. The side of a cell must
/// equal the server's.
const BOUNDS: Bounds = Bounds::REFERENCE;

/// The focal length in pixels: a field of view of 78 degrees across 100 pixels.
const FOCAL: f32 = 61.7;

/// Without a session the status LED blinks: this is the time for which it is on, and then off, as a
/// power of two in microseconds: 2^18 us, 0.26 s.
const BLINK: u32 = 18;

#[entry]
fn main() -> ! {
    // A static, not a local variable, so that the image's size includes it.
    static mut MEMORY: memory!(BOUNDS) = Memory::EMPTY;

    let Some(board) = Board::take(BAUD) else { SCB::sys_reset() };
    match &mut Robot::new(config(board.nonce), MEMORY) {
        Ok(robot) => run(board, robot),
        // The configuration above is invalid.
        Err(_) => SCB::sys_reset(),
    }
}

fn config(nonce: u64) -> Config {
    let centre = (BOUNDS.readings - 1) as f32 / 2.0;
    let sensor = SensorModel::Pinhole { focal: FOCAL, centre };
    Config { boot_nonce: (nonce ^ nonce >> 32) as u32, ..Config::new(ROBOT, sensor, BOUNDS) }
}

/// Connects the port and the robot forever: after every input, drains the outputs, then sleeps
/// until the next deadline or byte.
fn run(mut board: Board, robot: &mut Robot<'_>) -> ! {
    flash(&mut board.led, &mut board.clock);
    let mut bytes = [0; DEFAULT_FRAME];
    loop {
        let count = board.port.read(&mut bytes);
        let now = board.clock.now();
        robot.receive(bytes.get(..count).unwrap_or_default(), now);
        robot.timeout(now);
        // Writes frames while the port has room for them; its interrupt frees space meanwhile.
        while board.port.room() >= DEFAULT_FRAME
            && let Some(count) = robot.poll_transmit(board.clock.now(), &mut bytes)
        {
            board.port.write(bytes.get(..count).unwrap_or_default());
        }
        let now = board.clock.now();
        show(&mut board.led, robot.is_connected() || blinks(now));
        if count == 0 && now < robot.poll_timeout() {
            board.port.wait();
        }
    }
}

/// Whether a blinking LED is lit at `now`.
fn blinks(now: Instant) -> bool {
    now.micros() >> BLINK & 1 == 0
}

/// Flashes the status LED once.
fn flash(led: &mut impl OutputPin, delay: &mut impl DelayNs) {
    show(led, true);
    delay.delay_ms(20);
    show(led, false);
}

/// Sets the status LED; a failure of the LED is ignored.
fn show(led: &mut impl OutputPin, lit: bool) {
    let _ = led.set_state(lit.into());
}

/// Resets on panic; the link recovers as after any boot.
#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    SCB::sys_reset()
}

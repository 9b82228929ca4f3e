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

/// Which robot this is: unique in one deployment.
const ROBOT: RobotId = RobotId(1);

/// The speed of the port to the server.
const BAUD: u32 = 115_200;

/// What the robot keeps; the side of its map's cells must be the server's. The row is that of a
/// depth sensor that looks forward.
const BOUNDS: Bounds = Bounds::REFERENCE;

/// The focal length in pixels: 100 of them see 78 degrees.
const FOCAL: f32 = 61.7;

/// How long the status LED is on, and off, while there is no session: 2^18 us, a quarter of a
/// second.
const BLINK: u32 = 18;

#[entry]
fn main() -> ! {
    // Here, and not on the stack, so that the image tells how much memory there must be.
    static mut MEMORY: memory!(BOUNDS) = Memory::EMPTY;

    let Some(board) = Board::take(BAUD) else { SCB::sys_reset() };
    match &mut Robot::new(config(board.nonce), MEMORY) {
        Ok(robot) => run(board, robot),
        // The constants above are at odds.
        Err(_) => SCB::sys_reset(),
    }
}

fn config(nonce: u64) -> Config {
    let centre = (BOUNDS.readings - 1) as f32 / 2.0;
    let sensor = SensorModel::Pinhole { focal: FOCAL, centre };
    Config { boot_nonce: (nonce ^ nonce >> 32) as u32, ..Config::new(ROBOT, sensor, BOUNDS) }
}

/// Joins the port and the robot for ever: after every input, drain the outputs until none is left,
/// then come back at the next deadline or with the next byte.
fn run(mut board: Board, robot: &mut Robot<'_>) -> ! {
    flash(&mut board.led, &mut board.clock);
    let mut bytes = [0; DEFAULT_FRAME];
    loop {
        let count = board.port.read(&mut bytes);
        let now = board.clock.now();
        robot.receive(bytes.get(..count).unwrap_or_default(), now);
        robot.timeout(now);
        // The port's interrupt makes room meanwhile.
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

/// Whether an LED that blinks is lit now.
fn blinks(now: Instant) -> bool {
    now.micros() >> BLINK & 1 == 0
}

/// A flash of the status LED.
fn flash(led: &mut impl OutputPin, delay: &mut impl DelayNs) {
    show(led, true);
    delay.delay_ms(20);
    show(led, false);
}

/// Switches the status LED; a robot whose LED fails works on.
fn show(led: &mut impl OutputPin, lit: bool) {
    let _ = led.set_state(lit.into());
}

/// A robot that is in doubt starts again; it says hello as after any other boot.
#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    SCB::sys_reset()
}

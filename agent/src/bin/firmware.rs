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
use ubimap_protocol::time::{Duration, Instant};

/// The speed of the port to the server.
const BAUD: u32 = 115_200;

/// The longest frame of the link.
const FRAME: usize = 250;

/// How often the status LED changes.
const HEARTBEAT: Duration = Duration::from_millis(500);

#[entry]
fn main() -> ! {
    match Board::take(BAUD) {
        Some(board) => run(board),
        None => SCB::sys_reset(),
    }
}

/// Joins the port and the agent for ever: after every input, drain the outputs until none is left,
/// then come back at the next deadline or with the next byte.
fn run(mut board: Board) -> ! {
    flash(&mut board.led, &mut board.clock);
    let mut echo = Echo::new(board.nonce, board.clock.now());
    let mut bytes = [0; FRAME];
    loop {
        let count = board.port.read(&mut bytes[..echo.room().min(FRAME)]);
        echo.receive(&bytes[..count.min(FRAME)], board.clock.now());
        // The port's interrupt makes room meanwhile.
        while board.port.room() >= FRAME {
            let Some(count) = echo.poll_transmit(board.clock.now(), &mut bytes) else { break };
            board.port.write(&bytes[..count.min(FRAME)]);
        }
        show(&mut board.led, echo.is_lit());
        if count == 0 && board.clock.now() < echo.poll_timeout() {
            board.port.wait();
        }
    }
}

/// Stands in the agent's place: it sends back what it receives, after a line that says who it is,
/// and its heart beats.
struct Echo {
    pending: heapless::Deque<u8, 512>,
    lit: bool,
    heartbeat: Instant,
}

impl Echo {
    fn new(nonce: u64, now: Instant) -> Self {
        let mut pending = heapless::Deque::new();
        for byte in *b"ubimap " {
            let _ = pending.push_back(byte);
        }
        for nibble in (0..16).rev().map(|place| (nonce >> (4 * place)) as u8 & 0xF) {
            let _ = pending.push_back(nibble + if nibble < 10 { b'0' } else { b'a' - 10 });
        }
        let _ = pending.push_back(b'\n');
        Self { pending, lit: false, heartbeat: now }
    }

    fn receive(&mut self, bytes: &[u8], now: Instant) {
        for &byte in bytes {
            let _ = self.pending.push_back(byte);
        }
        while self.heartbeat <= now {
            self.heartbeat = self.heartbeat + HEARTBEAT;
            self.lit = !self.lit;
        }
    }

    fn poll_transmit(&mut self, _now: Instant, buffer: &mut [u8]) -> Option<usize> {
        let mut count = 0;
        for place in buffer {
            let Some(byte) = self.pending.pop_front() else { break };
            *place = byte;
            count += 1;
        }
        (count > 0).then_some(count)
    }

    fn room(&self) -> usize {
        self.pending.capacity() - self.pending.len()
    }

    fn poll_timeout(&self) -> Instant {
        self.heartbeat
    }

    fn is_lit(&self) -> bool {
        self.lit
    }
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

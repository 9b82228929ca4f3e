//! Replays a robot's journal, received on USART1, and prints the robot's outputs.
//! `cargo test --package ubimap-tests --test journal -- --ignored` compares them with those of the
//! same robot on a PC.
#![no_std]
#![no_main]

mod ending;
mod player;
#[expect(dead_code, reason = "a journal is read byte by byte")]
mod port;

use core::fmt;

use cortex_m_rt::entry;
use cortex_m_semihosting::{
    hio::{HostStream, hstdout},
    hprintln,
};
use ending::end;
use heapless::String;
use player::{BOUNDS, config, play};
use port::Port;
use ubimap_agent::{Memory, Robot, drive::Driving, memory};
use ubimap_protocol::frame::DEFAULT_FRAME;

/// Maximum length of a line: a frame, in two hexadecimal digits per byte.
const LINE: usize = 2 * DEFAULT_FRAME + 8;

#[entry]
fn main() -> ! {
    static mut MEMORY: memory!(BOUNDS, Driving) = Memory::EMPTY;

    end(run(MEMORY))
}

fn run(memory: &'static mut memory!(BOUNDS, Driving)) -> Option<()> {
    let mut port = Port::open()?;
    let mut robot = Robot::new(config(), memory).ok()?;
    let mut lines = Lines { host: hstdout().ok()?, line: String::new() };
    // Bytes sent before the port is open are lost: the sender waits for this line.
    hprintln!("a journal, please");
    play(&mut robot, || Some(port.byte()), &mut lines).ok()
}

/// Prints line by line, because each call to the host is slow.
struct Lines {
    host: HostStream,
    line: String<LINE>,
}

impl fmt::Write for Lines {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        self.line.push_str(text).map_err(|_| fmt::Error)?;
        if self.line.ends_with('\n') {
            self.host.write_all(self.line.as_bytes()).map_err(|()| fmt::Error)?;
            self.line.clear();
        }
        Ok(())
    }
}

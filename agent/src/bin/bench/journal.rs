//! Replays the journal of a robot, the file `journal` of the emulator's folder, on a Cortex-M or a
//! RISC-V, and prints the robot's outputs, and on a Cortex-M how long it took. `cargo test --package
//! ubimap-tests --test journal -- --ignored` compares them with those of the same robot on a PC.
#![no_std]
#![no_main]

#[path = "../firmware/configuration.rs"]
mod configuration;
#[cfg(target_arch = "arm")]
mod counter;
#[path = "../firmware/driving.rs"]
mod driving;
mod player;
#[cfg(target_arch = "arm")]
mod stopwatch;

use core::{fmt, panic::PanicInfo};

use configuration::{BOUNDS, SLICE_LENGTH};
#[cfg(target_arch = "arm")]
use cortex_m_rt::entry;
use heapless::String;
#[cfg(target_arch = "riscv32")]
use riscv_rt::entry;
use semihosting::{
    fs::File,
    io::{self, Read, Stdout, Write},
    process,
};
// Links the interrupt vectors of the chip.
#[cfg(feature = "firmware")]
use stm32f4xx_hal as _;
use ubimap_agent::{Memory, drive::Driving, memory};
use ubimap_protocol::frame::DEFAULT_FRAME;

/// Maximum length of a line: a name and a frame, in two hexadecimal digits per byte.
const LINE: usize = 2 * DEFAULT_FRAME + 16;

/// Repeats a journal.
#[entry]
fn main() -> ! {
    process::exit(i32::from(replay().is_none()))
}

fn replay() -> Option<()> {
    let mut memory: memory!(BOUNDS, Driving) = Memory::EMPTY;
    let mut slice = [0; SLICE_LENGTH];
    let mut file = Buffered { file: File::open(c"journal").ok()?, bytes: [0; 512], at: 0, end: 0 };
    let mut lines = Lines { host: io::stdout().ok()?, line: String::new() };
    #[cfg(target_arch = "arm")]
    let mut watch = stopwatch::Stopwatch::new()?;
    #[cfg(target_arch = "riscv32")]
    let mut watch = ();
    player::play(&mut memory, &mut slice, || file.byte(), &mut lines, &mut watch).ok()?;
    #[cfg(target_arch = "arm")]
    watch.write(&mut lines).ok()?;
    Some(())
}

/// Reads a file in pieces, because each call to the host is slow.
struct Buffered {
    file: File,
    bytes: [u8; 512],
    at: usize,
    end: usize,
}

impl Buffered {
    fn byte(&mut self) -> Option<u8> {
        if self.at == self.end {
            self.at = 0;
            self.end = self.file.read(&mut self.bytes).ok()?;
        }
        let byte = self.bytes.get(..self.end)?.get(self.at)?;
        self.at += 1;
        Some(*byte)
    }
}

/// Prints line by line, for the same reason.
struct Lines {
    host: Stdout,
    line: String<LINE>,
}

impl fmt::Write for Lines {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        self.line.push_str(text).map_err(|_| fmt::Error)?;
        if self.line.ends_with('\n') {
            self.host.write_all(self.line.as_bytes()).map_err(|_| fmt::Error)?;
            self.line.clear();
        }
        Ok(())
    }
}

#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    process::exit(1)
}

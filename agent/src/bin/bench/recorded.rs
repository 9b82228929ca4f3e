//! Instruction counts from rows of recorded depth frames, received on USART1, to planes: `cargo
//! test --release --package ubimap-tests --test instructions -- --ignored --nocapture`.
//!
//! Input format, all numbers little-endian:
//!
//! | what | bytes |
//! |---|---|
//! | for each row: 1 | 1 |
//! | the focal length and the column of the optical axis, in single precision | 8 |
//! | the readings, in millimetres | 1,280 |
//! | at the end: 255 | 1 |
#![no_std]
#![no_main]

mod counter;
mod ending;
mod planes;
mod port;
mod table;

use cortex_m::Peripherals;
use cortex_m_rt::entry;
use cortex_m_semihosting::hprintln;
use counter::Bench;
use ending::end;
use planes::{BOUNDS, PIXELS, rows};
use port::Port;
use ubimap_agent::{
    Memory, Storage, memory,
    sense::{SensorModel, fill_beams},
};
use ubimap_protocol::units::Pose;

#[entry]
fn main() -> ! {
    static mut MEMORY: memory!(BOUNDS) = Memory::EMPTY;

    let core = Peripherals::take();
    end(core.and_then(|core| run(&mut Bench::new(core.SYST), &mut Port::open()?, MEMORY)))
}

/// Prints the table. `None` if a row was not mapped.
fn run(bench: &mut Bench, port: &mut Port, memory: &mut Memory<impl Storage>) -> Option<()> {
    // Bytes sent before the port is open are lost: the sender waits for this line.
    hprintln!("{:>12}  stage", "instructions");
    let mut number = 0;
    while port.byte() == 1 {
        let focal = f32::from_bits(port.word());
        let sensor = SensorModel::Pinhole { focal, centre: f32::from_bits(port.word()) };
        let mut readings = [0; PIXELS];
        readings.iter_mut().for_each(|reading| *reading = port.half_word());
        fill_beams(memory.slices().beams, sensor, Pose::default());
        number += 1;
        rows(
            bench,
            memory.slices(),
            sensor,
            format_args!("a recorded row of {PIXELS} to planes: {number}"),
            &readings,
        )?;
    }
    Some(())
}

//! Instruction counts of rows of recorded depth frames to planes, which come in at USART1 once it
//! is open: `cargo test --release --package ubimap-tests --test instructions -- --nocapture`.
//!
//! What comes in, all numbers little-endian:
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
use planes::{MAX_RANGE, PIXELS, RESOLUTION, rows};
use port::Port;
use ubimap_agent::{
    Memory,
    map::{OwnTile, RowSighting, scratch_words},
    sense::{Beam, SensorModel, fill_beams},
};
use ubimap_protocol::units::Pose;

/// Places for tiles: more than a row touches.
const OWN_TILES: usize = 16;

#[entry]
fn main() -> ! {
    static mut BEAMS: [Beam; PIXELS] = [Beam::NONE; PIXELS];
    static mut WAITING: [u16; PIXELS] = [0; _];
    static mut SCRATCH: [RowSighting; scratch_words(MAX_RANGE, RESOLUTION)] =
        [RowSighting { free: 0, hit: 0 }; _];
    static mut OWN: [OwnTile; OWN_TILES] = [OwnTile::FREE; _];

    let memory =
        Memory { beams: BEAMS, waiting: WAITING, scratch: SCRATCH, own: OWN, fused: &mut [] };
    let core = Peripherals::take();
    end(core.and_then(|core| run(&mut Bench::new(core.SYST), &mut Port::open()?, memory)))
}

/// The table. `None` if a row was not mapped.
fn run(bench: &mut Bench, port: &mut Port, mut memory: Memory<'_>) -> Option<()> {
    // Bytes that come before the port is open are lost: who sends them waits for this line.
    hprintln!("{:>12}  stage", "instructions");
    let mut number = 0;
    while port.byte() == 1 {
        let focal = f32::from_bits(port.word());
        let sensor = SensorModel::Pinhole { focal, centre: f32::from_bits(port.word()) };
        let mut readings = [0; PIXELS];
        readings.iter_mut().for_each(|reading| *reading = port.half_word());
        fill_beams(memory.beams, sensor, Pose::default());
        number += 1;
        rows(
            bench,
            &mut memory,
            sensor,
            format_args!("a recorded row of {PIXELS} to planes: {number}"),
            &readings,
        )?;
    }
    Some(())
}

//! Instruction counts of the coder for the tile updates of a recorded log, received on USART1:
//! `cargo test --release --package ubimap-tests --test instructions -- --ignored --nocapture`.
//!
//! Input format, all numbers little-endian:
//!
//! | what | bytes |
//! |---|---|
//! | for each update: its direction, 0 to the server, 1 to a robot | 1 |
//! | the space available for it, in bytes | 2 |
//! | its length in bytes | 2 |
//! | its bytes | any |
//! | for each tile of it: the rows in which the receiver knows any cell (a bit per row) | 4 |
//! | for each of these rows: the words of its low and its high plane | 8 |
//! | the rows in which the complete new tile differs from the receiver's after this update (a bit
//! per row) | 4 |
//! | for each of these rows: its words | 8 |
//! | at the end: 255 | 1 |
#![no_std]
#![no_main]

mod counter;
mod ending;
mod port;

use cortex_m::Peripherals;
use cortex_m_rt::entry;
use cortex_m_semihosting::hprintln;
use counter::{Bench, instructions};
use ending::end;
use port::Port;
use ubimap_protocol::{
    frame::MAX_FRAME,
    tile::{Row, TILE_SIDE, Tile, TileDecoder, TileEncoder},
};

/// Directions of an update.
const WAYS: [&str; 2] = ["to the server", "to a robot"];

#[entry]
fn main() -> ! {
    let core = Peripherals::take();
    end(core.and_then(|core| run(&mut Bench::new(core.SYST), &mut Port::open()?)))
}

/// Prints the table. `None` if an update was not coded exactly as in the log.
fn run(bench: &mut Bench, port: &mut Port) -> Option<()> {
    // Bytes sent before the port is open are lost: the sender waits for this line.
    hprintln!("{:>12}  stage", "instructions");
    let mut counts = [Counts::default(); WAYS.len()];
    while let Some(counts) = counts.get_mut(usize::from(port.byte())) {
        let room = usize::from(port.half_word());
        let len = usize::from(port.half_word());
        let mut coded = [0; MAX_FRAME];
        let coded = coded.get_mut(..len)?;
        coded.iter_mut().for_each(|byte| *byte = port.byte());
        update(bench, port, coded, room, counts)?;
    }
    for (way, counts) in WAYS.into_iter().zip(counts) {
        counts.encoded.print(way, "to bytes");
        counts.decoded.print(way, "from bytes");
    }
    Some(())
}

/// Decodes an update and encodes it again, and checks that the bytes are the same.
fn update(
    bench: &mut Bench,
    port: &mut Port,
    coded: &[u8],
    room: usize,
    counts: &mut Counts,
) -> Option<()> {
    let mut again = [0; MAX_FRAME];
    let (mut decoder, begin_decoding) = bench.count(|| TileDecoder::new(coded));
    let (mut encoder, begin_encoding) =
        bench.count(|| Some(TileEncoder::new(again.get_mut(..room)?)));
    let encoder_mut = encoder.as_mut()?;
    let (mut decoding, mut encoding) = (begin_decoding?, begin_encoding?);
    loop {
        let (header, ticks) = bench.count(|| decoder.header());
        decoding += ticks?;
        let Some(header) = header.ok()? else { break };
        let mut old = Tile::UNKNOWN;
        read_rows(port, &mut old);
        let mut new = old;
        let ((), ticks) = bench.count(|| decoder.cells(&header, &mut new));
        decoding += ticks?;
        counts.decoded.add(core::mem::take(&mut decoding));
        read_rows(port, &mut new);
        let (pushed, ticks) = bench.count(|| {
            encoder_mut.push(header.id, header.stamp, header.base, header.start, &old, &new)
        });
        (pushed == Some(header.end)).then_some(())?;
        counts.encoded.add(core::mem::take(&mut encoding) + ticks?);
    }
    let (len, ticks) = bench.count(|| encoder?.finish());
    counts.encoded.total += u64::from(encoding + ticks?);
    counts.decoded.total += u64::from(decoding);
    (again.get(..len?) == Some(coded)).then_some(())
}

/// Costs of the updates in one direction.
#[derive(Clone, Copy, Default)]
struct Counts {
    encoded: Count,
    decoded: Count,
}

/// Number of tiles, total and maximum of their ticks.
#[derive(Clone, Copy, Default)]
struct Count {
    tiles: u64,
    total: u64,
    most: u64,
}

impl Count {
    fn add(&mut self, ticks: u32) {
        self.tiles += 1;
        self.total += u64::from(ticks);
        self.most = self.most.max(ticks.into());
    }

    fn print(&self, way: &str, what: &str) {
        let Some(mean) = instructions(self.total).checked_div(self.tiles) else { return };
        let tiles = self.tiles;
        hprintln!("{:>12}  a tile update {} {}: the mean of {}", mean, way, what, tiles);
        hprintln!("{:>12}  a tile update {} {}: the most", instructions(self.most), way, what);
    }
}

fn read_rows(port: &mut Port, tile: &mut Tile) {
    let rows = port.word();
    for y in (0..TILE_SIDE).filter(|y| rows >> y & 1 != 0) {
        tile.set_row(y, Row { low: port.word(), high: port.word() });
    }
}

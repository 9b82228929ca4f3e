//! Instruction counts of the coder of tile updates.

use core::hint::black_box;

use ubimap_protocol::{
    frame::DEFAULT_FRAME,
    message::{Messages, TileUpdateHead, ToServer},
    tile::{Epoch, Replica, Stamp, Tile, TileDecoder, TileEncoder, TileId, Version},
};

use crate::counter::Bench;

/// Encodes and decodes the fullest tile of a message.
pub(crate) fn run(bench: &mut Bench, message: &[u8]) -> Option<()> {
    code(bench, &fullest_tile(message)?)
}

/// The complete tile of a message with the most known cells.
fn fullest_tile(message: &[u8]) -> Option<Tile> {
    let message = Messages::<ToServer>::new(message).next()?.ok()?;
    let (_, coded) = message.split::<TileUpdateHead>().ok()?;
    let mut decoder = TileDecoder::new(coded);
    let mut fullest = Tile::UNKNOWN;
    while let Some(header) = decoder.header().ok()? {
        let mut replica = Replica::NOTHING;
        replica.apply(&header, &mut decoder).ok()?;
        if replica.tile().counts().0 > fullest.counts().0 {
            fullest = *replica.tile();
        }
    }
    (fullest != Tile::UNKNOWN).then_some(fullest)
}

/// Encodes and decodes an update of one tile.
fn code(bench: &mut Bench, tile: &Tile) -> Option<()> {
    let (known, free, occupied) = tile.counts();
    let id = TileId { x: 1, y: -1 };
    let stamp = Stamp { epoch: Epoch(1), version: Version(1) };
    let mut out = [0; DEFAULT_FRAME];
    let len = bench.measure(
        format_args!("a new tile ({known} cells: {free} free, {occupied} occupied) to bytes"),
        || {
            let mut encoder = TileEncoder::new(&mut out);
            encoder.push(id, stamp, None, 0, &Tile::UNKNOWN, black_box(tile))?;
            encoder.finish()
        },
    )?;
    let coded = black_box(out.get(..len)?);
    let read = bench.measure(format_args!("its {len} bytes to a tile"), || {
        let mut decoder = TileDecoder::new(coded);
        let header = decoder.header().ok()??;
        let mut read = Tile::UNKNOWN;
        decoder.cells(&header, &mut read);
        Some(read)
    })?;
    (read == *tile).then_some(())
}

//! Instruction counts of distance vectors: from a depth row, and from a grey image.

use core::hint::black_box;

use cortex_m::singleton;
use ubimap_agent::sense::{Beam, COLUMNS, Columns, FloorConfig, LINES, floor_distances};
use ubimap_protocol::{message::MAX_COLUMNS, units::Pose};

use super::counter::Bench;

/// Height of the floor in the image, in lines, in front of the wall and in front of a box before
/// the wall; the box's columns.
const WALL: usize = 110;
const BOX: usize = 70;
const BOX_COLUMNS: core::ops::Range<usize> = 90..150;

/// Measures the step from a row to the columns of a message. `None` if any column is empty.
pub(super) fn of_row(bench: &mut Bench, beams: &[Beam], readings: &[u16]) -> Option<()> {
    let name = format_args!("a row of {} to a distance vector", readings.len());
    let columns = bench.measure(name, || {
        Columns::of_scan(beams, black_box(readings), Pose::default(), MAX_COLUMNS)
    })?;
    (columns.distances.iter().filter(|&&units| units > 0).count() == MAX_COLUMNS).then_some(())
}

/// Measures the step from an image to distances, for images with walls and with floor only. `None`
/// if the distances are wrong.
pub(super) fn of_image(bench: &mut Bench) -> Option<()> {
    let image = singleton!(: [u8; COLUMNS * LINES] = [0; COLUMNS * LINES])?;
    let mut distances = |name, image: &[u8]| {
        let config = FloorConfig::default();
        let size = format_args!("{COLUMNS} x {LINES}");
        let name = format_args!("a grey image of {size} to a distance vector: {name}");
        bench.measure(name, || floor_distances(black_box(image), config)).ok()
    };
    draw(image, |column| if BOX_COLUMNS.contains(&column) { BOX } else { WALL });
    let found = distances("floor, walls, noise", image)?;
    (found.first() == Some(&(WALL as u8)) && found.get(120) == Some(&(BOX as u8))).then_some(())?;
    draw(image, |_| LINES);
    let found = distances("floor all over, noise", image)?;
    found.iter().all(|&distance| distance == FloorConfig::default().lines).then_some(())
}

/// Draws floor that darkens upwards and ends after some lines in each column, with noise.
fn draw(image: &mut [u8], floor: impl Fn(usize) -> usize) {
    let mut noise = 1u32;
    for (line, pixels) in image.chunks_exact_mut(COLUMNS).rev().enumerate() {
        for (column, pixel) in pixels.iter_mut().enumerate() {
            noise = noise.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let surface = if line < floor(column) { 150 - line / 8 } else { 60 };
            *pixel = surface as u8 + (noise >> 28) as u8;
        }
    }
}

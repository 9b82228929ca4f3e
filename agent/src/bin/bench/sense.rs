//! Instruction counts from a depth frame to valid readings.

use core::hint::black_box;

use ubimap_agent::sense::{Camera, Pick, Slice, Slicer, Validity};
use ubimap_protocol::units::Millimetres;

use crate::{FOCAL, PIXELS, counter::Bench, sensor};

/// The middle row of a frame, which sees a wall 3 m away.
const ROW: u16 = 240;
/// Number of rows of a band.
const BAND: u16 = 5;

/// Prints this file's lines of the table; `None` if a stage has a wrong result.
pub(crate) fn run(bench: &mut Bench, wall: &[u16; PIXELS], boxes: &[u16; PIXELS]) -> Option<()> {
    let validity = Validity::of(sensor());
    for (scene, row) in [("a wall", *wall), ("two boxes before it", *boxes), ("ragged", ragged())] {
        let mut readings = row;
        bench.measure(format_args!("which of {PIXELS} readings count: {scene}"), || {
            validity.clean(black_box(&mut readings));
        });
        let left = readings.iter().filter(|&&reading| reading != 0).count();
        (left * 10 > PIXELS * 8).then_some(())?;
    }
    slices(bench, wall, validity)
}

fn slices(bench: &mut Bench, line: &[u16; PIXELS], validity: Validity) -> Option<()> {
    let centre = (PIXELS - 1) as f32 / 2.0;
    let camera = Camera { pitch: 0.2, ..Camera::new((FOCAL, FOCAL), (centre, f32::from(ROW))) };
    let first = ROW - BAND / 2;
    let band = |pick| Slice::Band { first, rows: BAND, pick };
    let height = Slice::Height { below: Millimetres(600), tolerance: Millimetres(30) };
    let mut buffer = [0; PIXELS * BAND as usize];
    for (name, slice, lines) in [
        ("the nearest of five rows", band(Pick::Nearest), BAND),
        ("the median of five rows", band(Pick::Median), BAND),
        ("one row against a height, on a tilted camera", height, 1),
    ] {
        let mut slicer = Slicer::new(slice, camera, PIXELS, validity, &mut buffer).ok()?;
        let readings = bench.measure(format_args!("{PIXELS} columns: {name}"), || {
            for row in 0..lines {
                slicer.line(first + BAND - lines + row, black_box(line)).ok()?;
            }
            slicer.finish().ok()
        })?;
        readings.get(PIXELS / 2).filter(|&&reading| reading != 0)?;
    }
    Some(())
}

/// A slanted wall with noise of a few centimetres and some missing returns.
fn ragged() -> [u16; PIXELS] {
    let mut readings = [0; PIXELS];
    for (column, reading) in (0u16..).zip(&mut readings) {
        let is_lost = column % 41 == 7 || (300..340).contains(&column);
        *reading = if is_lost { 0 } else { 1_200 + 3 * column + column * 37 % 50 };
    }
    readings
}

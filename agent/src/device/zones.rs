//! Frames of 8 x 8 distances, as of ST's VL53L5CX and VL53L8CX.
//!
//! These sensors are on I2C or SPI, and their own driver needs a firmware of 86 KiB: a board reads them
//! (crate `vl53-8x8`), and passes each frame on as bytes with [`to_bytes`]: 64 distances in mm, little-endian,
//! the rows from above, each from the left, 0 for no return.

use ubimap_protocol::time::{Duration, Instant};

use super::depth_sensor::{DepthSensor, Scan, SensorCounters};
use crate::sense::{SliceError, Slicer};

/// Number of zones per row, and of rows.
pub const SIDE: usize = 8;

/// Length of a frame in bytes.
pub const FRAME: usize = 2 * SIDE * SIDE;

/// From the middle of the exposure to the arrival: half of the 67 ms that a frame takes at 15 Hz.
const AGE: Duration = Duration::from_millis(33);

/// A frame that arrives in pieces over a longer time is dropped.
const PATIENCE: Duration = Duration::from_millis(30);

/// The bytes of a frame.
pub fn to_bytes(distances: &[u16; SIDE * SIDE]) -> [u8; FRAME] {
    let mut bytes = [0; FRAME];
    for (place, distance) in bytes.as_chunks_mut::<2>().0.iter_mut().zip(distances) {
        *place = distance.to_le_bytes();
    }
    bytes
}

/// A driver that slices frames of 8 x 8 distances.
///
/// The distances are perpendicular to the sensor, as those of a depth camera. Tested on the host; never
/// tried on a board.
#[derive(Debug)]
pub struct Zones<'b> {
    slicer: Slicer<'b>,
    row: [u16; SIDE],
    /// Number of bytes of the current frame, and when the first arrived.
    received: usize,
    begun: Instant,
    counters: SensorCounters,
}

impl<'b> Zones<'b> {
    /// A driver that has not heard the sensor yet.
    ///
    /// # Errors
    /// [`SliceError`]: the slicer is for frames of another width.
    pub fn new(slicer: Slicer<'b>) -> Result<Self, SliceError> {
        if slicer.width() != SIDE {
            return Err(SliceError::Width { expected: SIDE, found: slicer.width() });
        }
        Ok(Self {
            slicer,
            row: [0; SIDE],
            received: 0,
            begun: Instant(0),
            counters: SensorCounters::default(),
        })
    }
}

impl DepthSensor for Zones<'_> {
    fn receive(&mut self, bytes: &mut &[u8], now: Instant) -> Option<Scan<'_>> {
        while let Some((&byte, rest)) = bytes.split_first() {
            *bytes = rest;
            if self.received > 0 && now.since(self.begun) > PATIENCE {
                self.counters.torn = self.counters.torn.saturating_add(1);
                self.slicer.discard();
                self.received = 0;
            }
            if self.received == 0 {
                self.begun = now;
            }
            let (zone, is_high) = (self.received / 2, self.received % 2 == 1);
            self.received += 1;
            if let Some(distance) = self.row.get_mut(zone % SIDE) {
                *distance =
                    if is_high { *distance | u16::from(byte) << 8 } else { u16::from(byte) };
            }
            if is_high && zone % SIDE == SIDE - 1 {
                // The slicer has this width, and takes all rows of a frame.
                let _ = self.slicer.line((zone / SIDE) as u16, &self.row);
            }
            if self.received == FRAME {
                self.received = 0;
                self.counters.frames = self.counters.frames.saturating_add(1);
                let taken = Instant(now.0.saturating_sub(AGE.micros()));
                return Some(Scan { taken, readings: self.slicer.finish().unwrap_or_default() });
            }
        }
        None
    }

    fn counters(&self) -> SensorCounters {
        self.counters
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sense::{Camera, Pick, Slice, Validity};
    use proptest::prelude::*;

    const SLICE: Slice = Slice::Band { first: 3, rows: 2, pick: Pick::Nearest };

    fn slicer(width: usize, buffer: &mut [u16]) -> Slicer<'_> {
        let camera = Camera::new((9.66, 9.66), (3.5, 3.5));
        Slicer::new(SLICE, camera, width, Validity::default(), buffer).unwrap()
    }

    proptest! {
        #[test]
        fn the_middle_rows_are_sliced_after_a_torn_frame(
            frame in prop::array::uniform32(300..2_000_u16),
            torn in 0..FRAME,
            piece in 1..FRAME,
        ) {
            let mut buffer = [0; 99];
            let mut sensor = Zones::new(slicer(SIDE, &mut buffer)).unwrap();
            let mut distances = [0; 64];
            distances[16..48].copy_from_slice(&frame);
            let bytes = to_bytes(&distances);
            prop_assert_eq!(sensor.receive(&mut &bytes[..torn], Instant(100_000)), None);
            let mut found = None;
            for part in bytes.chunks(piece) {
                let mut part = part;
                if let Some(scan) = sensor.receive(&mut part, Instant(200_000)) {
                    found = Some((scan.taken, scan.readings.to_vec()));
                }
                prop_assert!(part.is_empty());
            }
            let nearest: std::vec::Vec<u16> =
                (0..8).map(|column| frame[8 + column].min(frame[16 + column])).collect();
            prop_assert_eq!(found, Some((Instant(167_000), nearest)));
            let counters = sensor.counters();
            prop_assert_eq!((counters.frames, counters.torn), (1, u32::from(torn > 0)));
        }
    }

    #[test]
    fn a_slicer_of_another_width_is_refused() {
        let mut buffer = [0; 99];
        assert!(Zones::new(slicer(SIDE + 1, &mut buffer)).is_err());
    }
}

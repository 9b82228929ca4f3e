//! Where a sensor's readings lie: what is calibrated of it.
//!
//! A laser may read some centimetres too long, and its beams may turn a little with their bearing. Then surfaces are bent,
//! and the map is too large or too small by half a per cent. The vectors do not tell it. But where a surface is that was
//! seen in several columns, and from several distances, tells it.

use nalgebra::Vector2;
use ubimap_protocol::message::MAX_COLUMNS;

use crate::mapping::Reading;

/// Deviations before anything was seen: of the turn of a column in radians, and of the length that is added to all readings in
/// metres.
const LIKELY_TURN: f64 = 0.01;
const LIKELY_LENGTH_M: f64 = 0.05;

/// The columns of a sensor.
#[derive(Clone, Debug)]
pub(super) struct Columns {
    columns: [Column; MAX_COLUMNS],
    /// What is added to all readings, in metres.
    length_m: f64,
}

/// A column.
#[derive(Clone, Copy, Debug, Default)]
struct Column {
    /// How far to the left its readings are, in radians.
    turn: f64,
    /// The normal equation of what is to be added to that.
    information: f64,
    right: f64,
}

impl Default for Columns {
    fn default() -> Self {
        Self { columns: [Column::default(); MAX_COLUMNS], length_m: 0.0 }
    }
}

impl Columns {
    /// The point of a reading, in metres in `base_link`.
    pub(super) fn point(&self, reading: &Reading) -> Vector2<f64> {
        let bearing = reading.bearing + self.columns[reading.column].turn;
        let distance = reading.distance / 1_000.0 + self.length_m;
        Vector2::new(libm::cos(bearing), libm::sin(bearing)) * distance
    }

    /// What is added to all readings, in metres.
    pub(super) fn length_m(&self) -> f64 {
        self.length_m
    }

    /// Adds that a point lies `distance` before a surface, which grows by `by_turn` with the bearing of the reading.
    pub(super) fn add(&mut self, reading: &Reading, by_turn: f64, distance: f64, weight: f64) {
        let column = &mut self.columns[reading.column];
        column.information += by_turn * by_turn * weight;
        column.right -= by_turn * distance * weight;
    }

    /// The normal equation of what is to be added to the length: its element and its right side.
    pub(super) fn expected_length(&self) -> (f64, f64) {
        let information = LIKELY_LENGTH_M.powi(-2);
        (information, -self.length_m * information)
    }

    /// Turns the columns to where the distances that were added are least, while the views stay, and adds to the length.
    /// All columns together do not turn: that is the sensor's mounting.
    pub(super) fn solve(&mut self, longer_m: f64) {
        self.length_m += longer_m;
        let expected = LIKELY_TURN.powi(-2);
        let mut seen: Vec<&mut Column> =
            self.columns.iter_mut().filter(|it| it.information > 0.0).collect();
        for column in &mut seen {
            let right = column.right - column.turn * expected;
            column.turn += right / (column.information + expected);
            (column.information, column.right) = (0.0, 0.0);
        }
        let mean = seen.iter().map(|it| it.turn).sum::<f64>() / seen.len() as f64;
        seen.iter_mut().for_each(|it| it.turn -= mean);
    }
}

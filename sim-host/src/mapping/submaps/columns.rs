//! Where in their columns a sensor's readings lie.
//!
//! A column of a distance vector holds the nearest of its beams' readings. How many beams each column has, and where in it
//! they lie, depends on the sensor, and the vectors do not tell it. If a reading is a tenth of a column of 3 degrees beside its
//! place, surfaces are bent, and the map is too large or too small by 0.5 %. But where a surface is that was seen in
//! several columns tells where they lie.

use nalgebra::{Matrix2, Vector2};
use ubimap_protocol::message::MAX_COLUMNS;

use crate::mapping::Reading;

/// Deviations, before anything was seen, of the turn of a column, in radians, and of what is added to the share by which its
/// readings are nearer.
const LIKELY: (f64, f64) = (0.01, 0.15);

/// The columns of a sensor.
#[derive(Clone, Debug)]
pub(super) struct Columns {
    columns: [Column; MAX_COLUMNS],
}

/// A column.
#[derive(Clone, Copy, Debug)]
struct Column {
    /// Its turn in radians, and how much farther towards its nearer side its readings are than assumed, as a share of it.
    place: Vector2<f64>,
    /// The normal equations of what is to be added to that.
    information: Matrix2<f64>,
    right: Vector2<f64>,
}

impl Default for Columns {
    fn default() -> Self {
        let zero = Column {
            place: Vector2::zeros(),
            information: Matrix2::zeros(),
            right: Vector2::zeros(),
        };
        Self { columns: [zero; MAX_COLUMNS] }
    }
}

impl Columns {
    /// The bearing of a reading in radians.
    pub(super) fn bearing(&self, reading: &Reading) -> f64 {
        let [turn, nearer] = self.columns[reading.column].place.into();
        reading.bearing + turn + reading.lean * nearer
    }

    /// The mean share by which readings are nearer than assumed.
    pub(super) fn nearer(&self) -> f64 {
        self.columns.iter().map(|it| it.place.y).sum::<f64>() / MAX_COLUMNS as f64
    }

    /// Adds that a point lies `distance` before a surface, which grows by `by_turn` with the bearing of the reading.
    pub(super) fn add(&mut self, reading: &Reading, by_turn: f64, distance: f64, weight: f64) {
        let column = &mut self.columns[reading.column];
        let row = Vector2::new(by_turn, by_turn * reading.lean);
        column.information += row * row.transpose() * weight;
        column.right -= row * (distance * weight);
    }

    /// The normal equation of what is to be added to the mean share: its element and its right side.
    pub(super) fn expected_nearer(&self) -> (f64, f64) {
        let information = LIKELY.1.powi(-2);
        (information, -self.nearer() * information)
    }

    /// Moves the columns to where the distances that were added are least, while the views stay; the mean share by which
    /// readings are nearer grows by `nearer`. All columns together do not turn: that is the sensor's mounting.
    pub(super) fn solve(&mut self, nearer: f64) {
        let expected = Vector2::new(0.0, self.nearer());
        let prior = Vector2::new(LIKELY.0.powi(-2), LIKELY.1.powi(-2));
        for column in &mut self.columns {
            let right = column.right + prior.component_mul(&(expected - column.place));
            let information = column.information + Matrix2::from_diagonal(&prior);
            column.place += information.try_inverse().unwrap_or_else(Matrix2::zeros) * right;
            (column.information, column.right) = (Matrix2::zeros(), Vector2::zeros());
        }
        let sum: Vector2<f64> = self.columns.iter().map(|it| it.place).sum();
        let off = expected + Vector2::new(0.0, nearer) - sum / MAX_COLUMNS as f64;
        for column in &mut self.columns {
            column.place += off;
            column.place.y = column.place.y.clamp(-0.5, 0.5);
        }
    }
}

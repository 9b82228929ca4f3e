//! The ground clearance signal (Ahmed 2.1): is there room to drive on, and so something to map?

use super::floor::COLUMNS;

/// How much free floor before the robot is enough. The paper does not say.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GroundClearance {
    /// Columns in the middle of the image that the robot must fit through.
    pub columns: usize,
    /// Pixels of free floor that each of them must have.
    pub pixels: u8,
}

impl Default for GroundClearance {
    /// The middle half of the image, and the near end of table 1: of what is nearer than its 62
    /// pixels the camera cannot tell how near it is.
    fn default() -> Self {
        Self { columns: COLUMNS / 2, pixels: 62 }
    }
}

impl GroundClearance {
    /// Whether there is so much free floor, by the [`distances`](super::Floor::distances) of an
    /// image.
    pub fn is_clear(&self, distances: &[u8; COLUMNS]) -> bool {
        let aside = COLUMNS.saturating_sub(self.columns) / 2;
        distances.iter().skip(aside).take(self.columns).all(|&pixels| pixels >= self.pixels)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_stands_in_the_middle_is_in_the_way_and_what_stands_aside_is_not() {
        let clearance = GroundClearance::default();
        let clear_but_for = |column: usize, pixels| {
            let mut distances = [62; COLUMNS];
            distances[column] = pixels;
            clearance.is_clear(&distances)
        };
        assert!(clear_but_for(160, 62));
        for column in [80, 160, 239] {
            assert!(!clear_but_for(column, 61), "{column}");
        }
        for column in [0, 79, 240, 319] {
            assert!(clear_but_for(column, 0), "{column}");
        }
        let everywhere = GroundClearance { columns: COLUMNS, ..clearance };
        assert!(!everywhere.is_clear(&core::array::from_fn(|column| 61 + (column > 0) as u8)));
    }
}

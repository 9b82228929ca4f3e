//! The ground clearance signal (Ahmed 2.1): whether the floor ahead is free.

use super::floor::COLUMNS;

/// The amount of free floor that the robot needs. The paper gives no values.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GroundClearance {
    /// Number of columns at the centre of the image that must be free.
    pub columns: usize,
    /// Free floor required in each of these columns, in pixels.
    pub pixels: u8,
}

impl Default for GroundClearance {
    /// The middle half of the image, and 62 pixels: the near end of table 1, as the camera can't
    /// measure smaller distances.
    fn default() -> Self {
        Self { columns: COLUMNS / 2, pixels: 62 }
    }
}

impl GroundClearance {
    /// Whether the floor ahead is free, according to the [`distances`](super::Floor::distances) of
    /// an image.
    pub fn is_clear(&self, distances: &[u8; COLUMNS]) -> bool {
        let aside = COLUMNS.saturating_sub(self.columns) / 2;
        distances.iter().skip(aside).take(self.columns).all(|&pixels| pixels >= self.pixels)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_obstacles_in_the_middle_columns_block() {
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

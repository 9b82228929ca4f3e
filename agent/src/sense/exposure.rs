//! Over- and under-exposed pixels.

use super::slice::SliceError;

/// Range of brightness in which a pixel's depth can be trusted: the paper's exposure correction
/// (Aluckal III.D), which drops pixels that are too bright or too dark.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Exposure {
    /// Darker pixels are invalid.
    pub darkest: u16,
    /// Brighter pixels are invalid.
    pub brightest: u16,
}

impl Exposure {
    /// All pixels are valid.
    pub const ANY: Self = Self { darkest: 0, brightest: u16::MAX };

    /// Sets to 0 the readings of a row whose brightness, in the same row of the intensity image
    /// (`u8` or `u16`), is out of range.
    ///
    /// # Errors
    /// [`SliceError::Width`] if the rows differ in length; the readings are unchanged.
    pub fn mask<T: Copy + Into<u16>>(
        &self,
        readings: &mut [u16],
        light: &[T],
    ) -> Result<(), SliceError> {
        if light.len() != readings.len() {
            return Err(SliceError::Width { expected: readings.len(), found: light.len() });
        }
        for (reading, &light) in readings.iter_mut().zip(light) {
            if !(self.darkest..=self.brightest).contains(&light.into()) {
                *reading = 0;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixels_that_are_too_bright_or_too_dark_are_invalid() {
        let exposure = Exposure { darkest: 10, brightest: 250 };
        let mut readings = [900; 5];
        assert_eq!(exposure.mask(&mut readings, &[9u8, 10, 100, 250, 255]), Ok(()));
        assert_eq!(readings, [0, 900, 900, 900, 0]);
        let refused = Err(SliceError::Width { expected: 5, found: 1 });
        assert_eq!(exposure.mask(&mut readings, &[0u16]), refused);
        assert_eq!(readings, [0, 900, 900, 900, 0]);
    }
}

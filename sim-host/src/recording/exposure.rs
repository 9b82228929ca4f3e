//! Over- and underexposed pixels of depth cameras (Aluckal III.D, "exposure correction").

use std::path::Path;

use clap::ValueEnum;
use ubimap_agent::sense::Exposure;

use super::error::{FrameFault, LogError};
use crate::grid::raster;

/// Pixels outside of these are badly exposed.
const LIMITS: Exposure = Exposure { darkest: 8, brightest: 250 };
/// Brightness of a well exposed image's median.
const WELL: u16 = 128;
/// Pixels darker than this have lost their texture in the noise: no gain brings it back.
const LOST: u16 = 3;

/// What is done with depths where the picture is too bright or too dark.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum ExposureRule {
    /// Nothing: they are taken like all others
    #[default]
    Any,
    /// They are left out ("ignoring the exposed region entirely")
    Mask,
    /// They are left out after the picture is normalised: brightened until the median of its pixels that
    /// are not clipped is that of a well exposed one ("normalising the exposed area")
    Normalise,
}

/// The pixels that a rule has looked at.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ExposureCounts {
    /// Pixels with a depth, before.
    pub valid: u64,
    /// Of these, those left out.
    pub masked: u64,
}

impl ExposureRule {
    /// The brightness at which depths count in a picture, as recorded. Normalising does not change the
    /// upper limit: what is clipped stays clipped.
    pub fn limits(self, light: &[u8]) -> Exposure {
        match self {
            Self::Any => Exposure::ANY,
            Self::Mask => LIMITS,
            Self::Normalise => {
                let mut counts = [0_usize; 256];
                light.iter().for_each(|&it| counts[usize::from(it)] += 1);
                let inside = usize::from(LOST)..=usize::from(LIMITS.brightest);
                let half = counts[inside.clone()].iter().sum::<usize>().div_ceil(2);
                let mut below = 0;
                let median = inside.clone().find(|&level| {
                    below += counts[level];
                    below >= half
                });
                // At most 250.
                let median = median.filter(|_| half > 0).map_or(WELL, |level| level as u16);
                // The brightness that the gain lifts to the lower limit.
                let darkest = LIMITS.darkest * median.min(WELL) / WELL;
                Exposure { darkest: darkest.max(LOST), ..LIMITS }
            }
        }
    }

    /// Sets to 0 the depths of badly exposed pixels. A picture of another size changes nothing.
    pub fn apply(self, depths: &mut [u16], light: &[u8]) -> ExposureCounts {
        let valid = |depths: &[u16]| depths.iter().filter(|depth| **depth > 0).count() as u64;
        let before = valid(depths);
        if self == Self::Any || self.limits(light).mask(depths, light).is_err() {
            return ExposureCounts { valid: before, masked: 0 };
        }
        ExposureCounts { valid: before, masked: before - valid(depths) }
    }

    /// As [`ExposureRule::apply`], with the picture in a file, which must have this size.
    pub(super) fn apply_file(
        self,
        depths: &mut [u16],
        (expected_width, expected_height): (u32, u32),
        path: &Path,
    ) -> Result<ExposureCounts, LogError> {
        let refuse = |fault| LogError::Frame { path: path.to_owned(), fault };
        let picture = raster::read(path).map_err(|error| refuse(FrameFault::Image(error)))?;
        let picture = picture.image.into_luma8();
        let (width, height) = picture.dimensions();
        if (width, height) != (expected_width, expected_height) {
            let fault = FrameFault::Size { width, height, expected_width, expected_height };
            return Err(refuse(fault));
        }
        Ok(self.apply(depths, picture.as_raw()))
    }
}

impl std::ops::AddAssign for ExposureCounts {
    fn add_assign(&mut self, other: Self) {
        self.valid += other.valid;
        self.masked += other.masked;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn normalising_keeps_what_is_dark_in_a_dark_picture_and_nothing_that_is_clipped() {
        let kept = |rule: ExposureRule, light: &[u8]| -> Vec<u16> {
            let mut depths = vec![900; light.len()];
            let counts = rule.apply(&mut depths, light);
            let zero = depths.iter().filter(|it| **it == 0).count() as u64;
            assert_eq!(counts, ExposureCounts { valid: light.len() as u64, masked: zero });
            depths
        };
        // A backlit wall: the window is clipped, and the exposure for it leaves the rest dark.
        let backlit = [255, 255, 12, 12, 12, 6, 2];
        assert_eq!(kept(ExposureRule::Any, &backlit), [900; 7]);
        assert_eq!(kept(ExposureRule::Mask, &backlit), [0, 0, 900, 900, 900, 0, 0]);
        assert_eq!(kept(ExposureRule::Normalise, &backlit), [0, 0, 900, 900, 900, 900, 0]);
        // A well exposed picture needs no gain, and a bright one gets none.
        for median in [128, 200] {
            let light = [median, median, median, 6, 255];
            assert_eq!(kept(ExposureRule::Normalise, &light), [900, 900, 900, 0, 0]);
        }
        assert_eq!(kept(ExposureRule::Normalise, &[255, 0, 1]), [0; 3]);
        assert_eq!(kept(ExposureRule::Normalise, &[]), [0; 0]);
        let other_size = ExposureRule::Mask.apply(&mut [900, 0], &[0]);
        assert_eq!(other_size, ExposureCounts { valid: 1, masked: 0 });
    }
}

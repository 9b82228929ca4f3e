//! Detects changes in the view of a robot at standstill.

use core::ops::Range;

/// Number of equally spaced readings remembered per scan.
const SAMPLES: usize = 80;

/// Minimum change of a reading, in millimetres; it must also exceed 1/16 of the reading. A stereo
/// camera's noise is below both (2 % of the range).
const MIN_CHANGE: u16 = 60;

/// Samples of the last mapped scan.
#[derive(Clone, Debug)]
pub(super) struct LastScan {
    samples: [u16; SAMPLES],
    /// Number of readings per sample; 0 if no scan is remembered.
    step: usize,
}

impl LastScan {
    /// No scan is remembered.
    pub(super) const NONE: Self = Self { samples: [0; SAMPLES], step: 0 };

    /// Remembers the readings of a scan whose indices are in `part`.
    pub(super) fn remember(&mut self, readings: &[u16], part: Range<usize>) {
        self.step = readings.len().div_ceil(SAMPLES).max(1);
        let samples = self.samples.iter_mut().zip(readings.iter().step_by(self.step));
        let (from, to) = (part.start.div_ceil(self.step), part.end.div_ceil(self.step));
        for (sample, reading) in samples.take(to).skip(from) {
            *sample = *reading;
        }
    }

    /// The smallest range of readings that contains every change since the remembered scan; `None`
    /// if nothing changed. A changed sample counts only if an adjacent one changed too, unless
    /// every reading is a sample.
    pub(super) fn changed(&self, readings: &[u16]) -> Option<Range<usize>> {
        if self.step == 0 {
            return Some(0..readings.len());
        }
        let alone_counts = self.step == 1;
        let mut range: Option<(usize, usize)> = None;
        let mut before = alone_counts;
        let mut at = 0;
        for (index, &sample) in self.samples.iter().enumerate() {
            let Some(&reading) = readings.get(at) else { break };
            at += self.step;
            let differs = sample.abs_diff(reading) > MIN_CHANGE.max(sample >> 4);
            if !differs {
                before = alone_counts;
                continue;
            }
            if before {
                let first = range.map_or(index - usize::from(!alone_counts), |(first, _)| first);
                range = Some((first, index));
            }
            before = true;
        }
        let (first, last) = range?;
        let start = first.saturating_sub(1) * self.step;
        Some(start..((last + 2) * self.step).min(readings.len()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn a_person_is_noticed_and_noise_is_not() {
        let wall: std::vec::Vec<u16> = (0..640).map(|pixel| 3_000 + pixel % 7 * 15).collect();
        let mut last = LastScan::NONE;
        assert_eq!(last.changed(&wall), Some(0..640));
        last.remember(&wall, 0..640);
        assert_eq!(last.changed(&wall), None);
        let noisy: std::vec::Vec<u16> = wall.iter().map(|reading| reading + 50).collect();
        assert_eq!(last.changed(&noisy), None);
        let mut person = wall.clone();
        person[300..330].fill(1_500);
        let part = last.changed(&person).unwrap();
        assert!(part.start <= 300 && part.end >= 330 && part.len() < 70, "{part:?}");
        last.remember(&person, part);
        assert_eq!(last.changed(&person), None);
        assert!(last.changed(&wall).is_some(), "the person's departure is a change");
    }

    proptest! {
        #[test]
        fn changes_over_two_samples_are_noticed(
            count in 1usize..700, at in 0usize..700, width in 16usize..100, depth in 100u16..1_500,
        ) {
            let before = std::vec![2_000u16; count];
            let mut last = LastScan::NONE;
            last.remember(&before, 0..count);
            let mut now = before.clone();
            let width = if count <= SAMPLES { width } else { 2 * count.div_ceil(SAMPLES) };
            let (from, to) = (at % count, (at % count + width).min(count));
            now[from..to].fill(2_000 - depth.max(126));
            let whole = to - from == width || count <= SAMPLES;
            if let Some(part) = last.changed(&now) {
                prop_assert!(part.end <= count && part.start < part.end);
                if whole {
                    prop_assert!(part.start <= from && part.end >= to.min(count));
                }
            } else {
                prop_assert!(!whole, "{from}..{to} of {count}");
            }
        }
    }
}

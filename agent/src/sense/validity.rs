//! Which readings of a row are valid.

use core::mem;

use super::beams::SensorModel;

/// A reading that says that nothing is within the sensor's range: +Inf in ROS REP-117. A sensor that can't say so
/// reads 0, which says nothing.
pub const NOTHING_IN_RANGE: u16 = u16::MAX - 1;

/// Which readings of a row are valid, in the sensor's own measure: depth for a camera, distance for
/// a lidar. Invalid readings are treated as no return.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Validity {
    /// Minimum reading, in millimetres.
    pub nearest: u16,
    /// Maximum reading, in millimetres, below [`NOTHING_IN_RANGE`]: the limit of the sensor. (Valid
    /// readings beyond the map's range still show that the space before them is free.)
    pub farthest: u16,
    /// Readings in this range, inclusive, are never mapped: the paper's selective removal (Aluckal
    /// III.D) by distance. `(0, 0)` removes none.
    pub removed: (u16, u16),
    /// Threshold for flying pixels, in millimetres. At the edge of a near surface a camera reports
    /// depths between that surface and the one behind it. A reading that lies between its two
    /// neighbours, and differs from each by more than the threshold, counts as a flying pixel. 0
    /// disables the check: for lidars, and for sensors with few pixels, where slanted walls have
    /// steps of the same size.
    pub flying: u16,
    /// Distance up to which [`NOTHING_IN_RANGE`] says that the ground is free, in millimetres: at most the
    /// range within which every surface gives a reading. It counts half as much as a reading behind that
    /// ground. 0 for a sensor whose silence says nothing.
    pub clear: u16,
}

impl Default for Validity {
    /// All distances are valid: not 0 (no return), nor 65,535 (saturated). Nothing in range is free as far as
    /// the map's range.
    fn default() -> Self {
        Self {
            nearest: 1,
            farthest: NOTHING_IN_RANGE - 1,
            removed: (0, 0),
            flying: 0,
            clear: u16::MAX,
        }
    }
}

impl Validity {
    /// The default for a sensor. For cameras it removes flying pixels: readings that differ from
    /// both neighbours by more than 150 mm, or, if that is larger, by more than the step between
    /// two columns on a wall at 4 m seen at 7 degrees.
    pub fn of(sensor: SensorModel) -> Self {
        let focal = match sensor {
            SensorModel::Radial { .. } => return Self::default(),
            SensorModel::Pinhole { focal, .. } => focal,
            SensorModel::Row { camera, .. } => camera.focal.0,
        };
        Self { flying: (4_000.0 * 8.0 / focal).max(150.0) as u16, ..Self::default() }
    }

    /// Sets invalid readings to 0, in one pass.
    ///
    /// Readings close to the last reading that was fully checked need no check of their own: they
    /// cost 2.5 instructions each on a Cortex-M4, others a hundred.
    pub fn clean(&self, readings: &mut [u16]) {
        let mut window = ReadingWindow::NO_RETURN;
        // The interval of valid readings that contains the last valid one.
        let mut interval = (1, 0);
        // The previous reading, before cleaning; 0 if invalid.
        let mut before = 0;
        let mut rest = readings;
        while let Some(skipped) = window.first_outside(rest) {
            let Some((inside, later)) = mem::take(&mut rest).split_at_mut_checked(skipped) else {
                return;
            };
            let Some((reading, later)) = later.split_first_mut() else { return };
            before = inside.last().map_or(before, |&last| last);
            let (here, after) = (*reading, later.first());
            if here == 0 {
                // Missing returns often come in long runs.
                let gap = later.iter().take_while(|&&reading| reading == 0).count();
                (before, rest) = (0, later.get_mut(gap..).unwrap_or_default());
                continue;
            }
            if here == NOTHING_IN_RANGE {
                (before, rest) = (0, later);
                continue;
            }
            if here < interval.0 || here > interval.1 {
                let Some(counted) = self.counted(here) else {
                    *reading = 0;
                    (before, rest) = (0, later);
                    continue;
                };
                interval = counted;
                window = ReadingWindow::within(interval, self.flying);
            }
            window.follow(here, interval);
            let is_apart = before != 0 && before.abs_diff(here) > self.flying;
            if self.flying != 0 && is_apart && self.is_flying(before, here, after) {
                *reading = 0;
            }
            (before, rest) = (here, later);
        }
    }

    /// Whether a reading is a distance in range that is not removed.
    #[inline]
    pub fn counts(&self, reading: u16) -> bool {
        let Self { nearest, farthest, removed: (from, to), .. } = *self;
        let is_in_range = reading >= nearest && reading <= farthest && reading != 0;
        is_in_range && (reading < from || reading > to)
    }

    /// The widest interval of valid readings that contains `reading`; `None` if it is invalid.
    fn counted(&self, reading: u16) -> Option<(u16, u16)> {
        let Self { nearest, farthest, removed: (from, to), .. } = *self;
        let (nearest, farthest) = (nearest.max(1), farthest.min(NOTHING_IN_RANGE - 1));
        self.counts(reading).then_some(if to < from {
            (nearest, farthest)
        } else if reading < from {
            (nearest, farthest.min(from.saturating_sub(1)))
        } else {
            (nearest.max(to.saturating_add(1)), farthest)
        })
    }

    /// Whether any readings are removed by distance.
    pub(crate) fn removes(&self) -> bool {
        self.removed.1 >= self.removed.0.max(1)
    }

    /// Whether the reading at `index` is valid, by the same rules as [`Validity::clean`]; for rows
    /// that are not cleaned as a whole.
    #[inline]
    pub(crate) fn counts_at(&self, readings: &[u16], index: usize, reading: u16) -> bool {
        if !self.counts(reading) {
            return false;
        }
        let before = index.checked_sub(1).and_then(|before| readings.get(before)).copied();
        let apart = before.filter(|before| before.abs_diff(reading) > self.flying);
        let apart = apart.filter(|_| self.flying != 0).filter(|&before| self.counts(before));
        !apart.is_some_and(|before| self.is_flying(before, reading, readings.get(index + 1)))
    }

    /// Whether a reading far from the previous one is a flying pixel, given the next one.
    fn is_flying(&self, before: u16, reading: u16, after: Option<&u16>) -> bool {
        after.is_some_and(|&after| {
            let is_between = (before < reading) == (reading < after);
            is_between && reading.abs_diff(after) > self.flying && self.counts(after)
        })
    }
}

/// An interval of valid readings, any two of which are close enough to need no further check. Its
/// length is a power of two, so that two readings can be compared in one word. A borrow into the
/// upper half can only come from a lower reading that is outside, and is then detected there.
#[derive(Clone, Copy)]
struct ReadingWindow {
    /// The interval's minimum, in both halves of the word.
    low: u32,
    /// The bits that the difference between a reading and `low` has only if the reading is outside,
    /// in both halves.
    outside: u32,
    last: u16,
}

/// Two readings in one word.
fn pair(first: u16, second: u16) -> u32 {
    u32::from(first) | u32::from(second) << 16
}

impl ReadingWindow {
    /// Number of readings compared at once.
    const LOOK: usize = 8;

    /// The window that contains only 0.
    const NO_RETURN: Self = Self { low: 0, outside: u32::MAX, last: 0 };

    /// The longest window that fits into the interval; at most `touch` long, unless that is 0.
    fn within((nearest, farthest): (u16, u16), touch: u16) -> Self {
        let touch = if touch == 0 { u16::MAX } else { touch };
        let room = farthest.saturating_sub(nearest).saturating_add(1);
        let last = (1 << room.min(touch).max(1).ilog2()) - 1;
        Self { low: 0, outside: pair(!last, !last), last }
    }

    /// Moves the window so that it contains `reading`. On a slanted wall the readings continue in
    /// the direction in which they left the window, so three quarters of it are placed on that
    /// side.
    fn follow(&mut self, reading: u16, (nearest, farthest): (u16, u16)) {
        let quarter = self.last / 4;
        let behind = if reading < self.low as u16 { self.last - quarter } else { quarter };
        let low = reading.saturating_sub(behind).max(nearest);
        let low = low.min(farthest.saturating_sub(self.last));
        self.low = pair(low, low);
    }

    fn first_outside(&self, readings: &[u16]) -> Option<usize> {
        let (looks, tail) = readings.as_chunks::<{ Self::LOOK }>();
        for (index, &[a, b, c, d, e, f, g, h]) in looks.iter().enumerate() {
            // Unrolled by hand: at opt-level "s" the compiler would emit a loop.
            let off = |first, second| pair(first, second).wrapping_sub(self.low);
            let words = [off(a, b), off(c, d), off(e, f), off(g, h)];
            let [first, second, third, fourth] = words;
            if (first | second | third | fourth) & self.outside != 0 {
                let place = words.iter().position(|word| word & self.outside != 0)?;
                let lower = words.get(place)? & self.outside & 0xFFFF;
                return Some(index * Self::LOOK + place * 2 + usize::from(lower == 0));
            }
        }
        let is_outside =
            |&reading: &u16| pair(reading, 0).wrapping_sub(self.low) & self.outside & 0xFFFF != 0;
        let inside = looks.len() * Self::LOOK;
        Some(inside + tail.iter().position(is_outside)?)
    }
}

#[cfg(test)]
mod tests {
    use std::vec::Vec;

    use super::*;
    use proptest::prelude::*;

    /// Reference implementation: the definition, reading by reading.
    fn plain(validity: Validity, readings: &[u16]) -> Vec<u16> {
        let Validity { nearest, farthest, removed: (from, to), flying, .. } = validity;
        let valid = |reading: u16| {
            let is_removed = (from..=to).contains(&reading);
            let is_measure = reading != 0 && reading != NOTHING_IN_RANGE;
            is_measure && reading >= nearest && reading <= farthest && !is_removed
        };
        let of = |index: Option<usize>| {
            index.and_then(|index| readings.get(index)).copied().filter(|&it| valid(it))
        };
        let keep = |index: usize| {
            if readings[index] == NOTHING_IN_RANGE {
                return Some(NOTHING_IN_RANGE);
            }
            let reading = of(Some(index))?;
            let between = of(index.checked_sub(1)).zip(of(Some(index + 1))).filter(|&(a, b)| {
                let far = |other: u16| reading.abs_diff(other) > flying;
                (a < reading) == (reading < b) && far(a) && far(b)
            });
            (flying == 0 || between.is_none()).then_some(reading)
        };
        (0..readings.len()).map(|index| keep(index).unwrap_or(0)).collect()
    }

    fn clean(validity: Validity, readings: &[u16]) -> Vec<u16> {
        let mut cleaned = readings.to_vec();
        validity.clean(&mut cleaned);
        cleaned
    }

    #[test]
    fn a_pixel_between_two_surfaces_is_removed_and_a_chair_leg_is_not() {
        let validity = Validity { flying: 150, ..Validity::default() };
        let row = [1_200, 1_205, 1_700, 2_400, 3_000, 3_000, 1_500, 3_010, 0, 2_000, 2_500, 2_990];
        let expected = [1_200, 1_205, 0, 0, 3_000, 3_000, 1_500, 3_010, 0, 2_000, 0, 2_990];
        assert_eq!(clean(validity, &row), expected);
        // For a lidar the check is disabled.
        assert_eq!(clean(Validity::default(), &row), row);
    }

    #[test]
    fn a_slanted_wall_is_not_removed() {
        // From 10 to 26 degrees off-axis, a wall that the outermost pixel sees at 8 degrees.
        let validity = Validity::of(SensorModel::Pinhole { focal: 343.1, centre: 319.5 });
        let wall: Vec<u16> = (60..170)
            .map(|column| {
                let tan = f64::from(column) / 343.1;
                (600.0 / (tan.atan() - 0.6).sin().abs() * (tan.atan()).cos()) as u16
            })
            .collect();
        assert_eq!(clean(validity, &wall), wall);
    }

    #[test]
    fn readings_out_of_range_or_removed_are_cleared() {
        let removed = (900, 1_000);
        let validity = Validity { nearest: 200, farthest: 5_000, removed, ..Validity::default() };
        let row = [0, 1, 199, 200, 899, 900, 950, 1_000, 1_001, 5_000, 5_001, u16::MAX];
        let expected = [0, 0, 0, 200, 899, 0, 0, 0, 1_001, 5_000, 0, 0];
        assert_eq!(clean(validity, &row), expected);
        assert_eq!(clean(Validity { nearest: 9, farthest: 8, ..validity }, &row), [0; 12]);
        assert_eq!(clean(Validity { removed: (0, u16::MAX), ..validity }, &row), [0; 12]);
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(2_000))]

        /// The fast pass and the reference agree.
        #[test]
        fn the_fast_pass_matches_the_definition(
            steps in proptest::collection::vec(
                (prop_oneof![-40i32..40, -400i32..400, Just(0), -70_000i32..70_000], 1usize..14),
                0..30,
            ),
            start: u16,
            nearest in prop_oneof![Just(0u16), 0u16..4_000, any::<u16>()],
            farthest in prop_oneof![Just(NOTHING_IN_RANGE - 1), 0..NOTHING_IN_RANGE],
            removed in prop_oneof![Just((0, 0)), any::<(u16, u16)>(), (900u16..1_200, 1_000u16..3_000)],
            flying in prop_oneof![Just(0u16), 1u16..300, any::<u16>()],
        ) {
            let validity = Validity { nearest, farthest, removed, flying, clear: 0 };
            let mut reading = i32::from(start);
            let mut row = Vec::new();
            for (step, times) in steps {
                for _ in 0..times {
                    reading = (reading + step).clamp(0, i32::from(u16::MAX));
                    // Not a measure, and often seen.
                    let nothing = reading > 60_000;
                    row.push(if nothing { NOTHING_IN_RANGE } else { reading as u16 });
                }
            }
            prop_assert_eq!(clean(validity, &row), plain(validity, &row), "{:?}", row);
        }
    }
}

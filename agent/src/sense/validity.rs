//! Which readings of a row count.

use core::mem;

use super::beams::SensorModel;

/// Which readings of a row count, in the sensor's own measure: depth for a camera, distance for a
/// lidar. Any other is treated as if nothing had come back.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Validity {
    /// Nearer readings do not count, in millimetres.
    pub nearest: u16,
    /// Farther readings do not count, in millimetres: the sensor can't measure them any more.
    /// (What it can measure beyond the range of the map says that the way there is free.)
    pub farthest: u16,
    /// Readings from the first to the second, both included, are never mapped: the paper's
    /// selective removal (Aluckal III.D) by distance. `(0, 0)` removes none.
    pub removed: (u16, u16),
    /// Flying pixels: at the edge of a near surface a camera reports depths between it and the
    /// one behind. A reading that lies between its two neighbours, by more than so many
    /// millimetres from either, is one. 0 lets all pass: for lidars, and for sensors with few
    /// pixels, whose walls seen at a slant take as wide steps.
    pub flying: u16,
}

impl Default for Validity {
    /// All but 0 (no return) and 65,535 (a saturated measurement) count.
    fn default() -> Self {
        Self { nearest: 1, farthest: u16::MAX - 1, removed: (0, 0), flying: 0 }
    }
}

impl Validity {
    /// The usual one of a sensor. A camera's flying pixels do not count: those more than 150 mm
    /// from both neighbours, or than a wall at 4 m that is seen at 7 degrees steps from column to
    /// column.
    pub fn of(sensor: SensorModel) -> Self {
        let focal = match sensor {
            SensorModel::Radial { .. } => return Self::default(),
            SensorModel::Pinhole { focal, .. } => focal,
            SensorModel::Row { camera, .. } => camera.focal.0,
        };
        Self { flying: (4_000.0 * 8.0 / focal).max(150.0) as u16, ..Self::default() }
    }

    /// Sets to 0 what does not count, in one pass.
    ///
    /// Readings close to the last one that was looked at closely need no look of their own: they
    /// cost two and a half instructions each on a Cortex-M4, those that lie elsewhere a hundred.
    pub fn clean(&self, readings: &mut [u16]) {
        let mut window = ReadingWindow::NO_RETURN;
        // Around the last reading that counted: readings that do.
        let mut interval = (1, 0);
        // The reading before, as it came; 0 if it does not count.
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
                // Where nothing comes back, often much does not.
                let gap = later.iter().take_while(|&&reading| reading == 0).count();
                (before, rest) = (0, later.get_mut(gap..).unwrap_or_default());
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

    /// Whether a reading is in range and not removed.
    #[inline]
    pub fn counts(&self, reading: u16) -> bool {
        let Self { nearest, farthest, removed: (from, to), .. } = *self;
        let is_in_range = reading >= nearest && reading <= farthest && reading != 0;
        is_in_range && (reading < from || reading > to)
    }

    /// The widest interval around a reading in which all count; `None` if it does not itself.
    fn counted(&self, reading: u16) -> Option<(u16, u16)> {
        let Self { nearest, farthest, removed: (from, to), .. } = *self;
        let nearest = nearest.max(1);
        self.counts(reading).then_some(if to < from {
            (nearest, farthest)
        } else if reading < from {
            (nearest, farthest.min(from.saturating_sub(1)))
        } else {
            (nearest.max(to.saturating_add(1)), farthest)
        })
    }

    /// Whether readings are removed by distance.
    pub(crate) fn removes(&self) -> bool {
        self.removed.1 >= self.removed.0.max(1)
    }

    /// Whether the reading at `index` counts, as [`Validity::clean`] has it: for rows that are not
    /// cleaned as a whole.
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

    /// Whether a reading that lies apart from the one before flies, given the one after.
    fn is_flying(&self, before: u16, reading: u16, after: Option<&u16>) -> bool {
        after.is_some_and(|&after| {
            let is_between = (before < reading) == (reading < after);
            is_between && reading.abs_diff(after) > self.flying && self.counts(after)
        })
    }
}

/// An interval of readings, all of which count and any two of which touch. Its length is a power
/// of two, so that two readings can be held against it in one word: what the lower one borrows
/// from the upper one changes nothing, for it then lies outside itself.
#[derive(Clone, Copy)]
struct ReadingWindow {
    /// Its least reading, in both halves of the word.
    low: u32,
    /// The bits that a reading less that one has only if it lies outside, in both halves.
    outside: u32,
    last: u16,
}

/// A word of two readings.
fn pair(first: u16, second: u16) -> u32 {
    u32::from(first) | u32::from(second) << 16
}

impl ReadingWindow {
    /// Readings that are looked at together.
    const LOOK: usize = 8;

    /// Nothing but 0.
    const NO_RETURN: Self = Self { low: 0, outside: u32::MAX, last: 0 };

    /// As long as an interval has room for, and no longer than `touch` if that is not 0.
    fn within((nearest, farthest): (u16, u16), touch: u16) -> Self {
        let touch = if touch == 0 { u16::MAX } else { touch };
        let room = farthest.saturating_sub(nearest).saturating_add(1);
        let last = (1 << room.min(touch).max(1).ilog2()) - 1;
        Self { low: 0, outside: pair(!last, !last), last }
    }

    /// Moves it to a reading of the interval that it was made for. On a wall that is seen at a
    /// slant readings go on as they left it: three quarters of it come to lie that way.
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
            // Written out: the compiler, told to be brief, would make it a loop.
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

    /// The same by its definition, reading by reading.
    fn plain(validity: Validity, readings: &[u16]) -> Vec<u16> {
        let Validity { nearest, farthest, removed: (from, to), flying } = validity;
        let valid = |reading: u16| {
            let is_removed = (from..=to).contains(&reading);
            reading != 0 && reading >= nearest && reading <= farthest && !is_removed
        };
        let of = |index: Option<usize>| {
            index.and_then(|index| readings.get(index)).copied().filter(|&it| valid(it))
        };
        let keep = |index: usize| {
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
    fn a_pixel_between_two_surfaces_flies_and_a_leg_does_not() {
        let validity = Validity { flying: 150, ..Validity::default() };
        let row = [1_200, 1_205, 1_700, 2_400, 3_000, 3_000, 1_500, 3_010, 0, 2_000, 2_500, 2_990];
        let expected = [1_200, 1_205, 0, 0, 3_000, 3_000, 1_500, 3_010, 0, 2_000, 0, 2_990];
        assert_eq!(clean(validity, &row), expected);
        // A lidar keeps them.
        assert_eq!(clean(Validity::default(), &row), row);
    }

    #[test]
    fn a_slanted_wall_does_not_fly() {
        // From 10 to 26 degrees aside, a wall that the outermost pixel sees at 8 degrees.
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
    fn what_is_out_of_range_or_removed_says_nothing() {
        let validity = Validity { nearest: 200, farthest: 5_000, removed: (900, 1_000), flying: 0 };
        let row = [0, 1, 199, 200, 899, 900, 950, 1_000, 1_001, 5_000, 5_001, u16::MAX];
        let expected = [0, 0, 0, 200, 899, 0, 0, 0, 1_001, 5_000, 0, 0];
        assert_eq!(clean(validity, &row), expected);
        assert_eq!(clean(Validity { nearest: 9, farthest: 8, ..validity }, &row), [0; 12]);
        assert_eq!(clean(Validity { removed: (0, u16::MAX), ..validity }, &row), [0; 12]);
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(2_000))]

        /// Quick or plain, the same readings are left.
        #[test]
        fn the_quick_pass_does_what_its_definition_says(
            steps in proptest::collection::vec(
                (prop_oneof![-40i32..40, -400i32..400, Just(0), -70_000i32..70_000], 1usize..14),
                0..30,
            ),
            start: u16,
            nearest in prop_oneof![Just(0u16), 0u16..4_000, any::<u16>()],
            farthest in prop_oneof![Just(u16::MAX), any::<u16>()],
            removed in prop_oneof![Just((0, 0)), any::<(u16, u16)>(), (900u16..1_200, 1_000u16..3_000)],
            flying in prop_oneof![Just(0u16), 1u16..300, any::<u16>()],
        ) {
            let validity = Validity { nearest, farthest, removed, flying };
            let mut reading = i32::from(start);
            let mut row = Vec::new();
            for (step, times) in steps {
                for _ in 0..times {
                    reading = (reading + step).clamp(0, i32::from(u16::MAX));
                    row.push(reading as u16);
                }
            }
            prop_assert_eq!(clean(validity, &row), plain(validity, &row), "{:?}", row);
        }
    }
}

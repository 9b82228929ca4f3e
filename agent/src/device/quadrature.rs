//! A quadrature encoder: two signals, a quarter of a period apart, whose order tells the direction.

/// The state of an encoder. Update it at every edge of both signals.
#[derive(Clone, Copy, Debug, Default)]
pub struct Quadrature {
    /// The quarter of the period, 0 to 3; `None` before the first update.
    quarter: Option<i8>,
    /// The direction of the last count.
    direction: i8,
}

impl Quadrature {
    /// Takes the levels of both signals. Returns the counts since the last update, four per period:
    /// positive if `a` leads.
    ///
    /// If two edges came between two updates, the direction is taken to be that of the last count.
    pub fn update(&mut self, a: bool, b: bool) -> i32 {
        let quarter = match (a, b) {
            (false, false) => 0,
            (true, false) => 1,
            (true, true) => 2,
            (false, true) => 3,
        };
        let last = self.quarter.replace(quarter).unwrap_or(quarter);
        let counts = match (quarter - last) & 3 {
            1 => 1,
            3 => -1,
            2 => 2 * self.direction,
            _ => 0,
        };
        if counts != 0 {
            self.direction = counts.signum();
        }
        counts.into()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use core::f64::consts::{FRAC_PI_2, PI};
    use proptest::prelude::*;

    /// The encoder's signals at an angle in counts: square waves, `a` a quarter of a period ahead.
    fn levels(counts: f64) -> (bool, bool) {
        let phase = counts * FRAC_PI_2 - PI / 4.0;
        ((phase + FRAC_PI_2).sin() > 0.0, phase.sin() > 0.0)
    }

    proptest! {
        #[test]
        fn counts_follow_the_wheel(
            start in -9.0..9.0_f64,
            steps in prop::collection::vec(-0.9..0.9_f64, 1..200),
        ) {
            let (mut encoder, mut at, mut counted) = (Quadrature::default(), start, 0);
            let (a, b) = levels(at);
            prop_assert_eq!(encoder.update(a, b), 0);
            for step in steps {
                at += step;
                let (a, b) = levels(at);
                counted += encoder.update(a, b);
                prop_assert!((f64::from(counted) - (at - start)).abs() <= 1.0, "{counted} at {at}");
            }
        }
    }

    #[test]
    fn a_missed_edge_is_counted_in_the_last_direction() {
        let mut encoder = Quadrature::default();
        let said = [(false, false), (false, true), (true, false), (true, true), (false, false)]
            .map(|(a, b)| encoder.update(a, b));
        assert_eq!(said, [0, -1, -2, 1, 2]);
    }
}

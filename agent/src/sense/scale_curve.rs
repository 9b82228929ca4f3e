//! From pixels of free floor to a distance (Ahmed 2.3): equations 1 and 2, and curves fitted to
//! other tables.

use core::fmt;

/// Number of coefficients: the curve is of fourth degree, like equation 1.
const TERMS: usize = 5;

/// Ahmed's table 1: pixels of free floor (d_r), and the distance to the object in pixels of the
/// ceiling camera (d_c). The scale factor in its third column is their quotient.
pub const TABLE_1: [(u8, f32); 10] = [
    (62, 74.0),
    (69, 83.0),
    (75, 91.0),
    (81, 100.0),
    (85, 106.0),
    (93, 119.0),
    (101, 138.0),
    (108, 170.0),
    (114, 199.0),
    (121, 254.0),
];

/// The scale factor alpha as a function of the pixels of free floor in a column, within the
/// measured range. Outside that range it is undefined, because a polynomial diverges from its data
/// there.
///
/// The polynomial is in a basis `p_0 = 1`, `p_(k+1) = (x - shift_k) p_k - damping_k p_(k-1)`. With
/// all shifts and dampings zero these are the powers of x. [`ScaleCurve::fit`] chooses them so that
/// the p_k are orthogonal over the table, for which the precision of `f32` is enough.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScaleCurve {
    /// The number of pixels at which x is zero, and the number of pixels by which x grows by one.
    centre: f32,
    spread: f32,
    terms: [Term; TERMS],
    /// The measured range of pixels, inclusive.
    first: u8,
    last: u8,
}

/// The recurrence and the coefficient of one p_k.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Term {
    coefficient: f32,
    shift: f32,
    damping: f32,
}

impl Term {
    const fn of(coefficient: f32) -> Self {
        Self { coefficient, shift: 0.0, damping: 0.0 }
    }
}

/// Why a table can't be fitted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ScaleError {
    /// The table has fewer than five rows, one for each coefficient.
    TooShort,
    /// The row at this index does not exceed the row before it, or its distance is not finite.
    Row(usize),
    /// The fitted curve is not monotonic: at this number of pixels more free floor would give a
    /// shorter distance.
    Turns(u8),
}

impl fmt::Display for ScaleError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::TooShort => {
                write!(f, "the scale table has fewer than {TERMS} rows")
            }
            Self::Row(row) => {
                write!(
                    f,
                    "row {row} of the scale table (counted from 0) is not beyond the previous one, or not a distance"
                )
            }
            Self::Turns(pixels) => {
                write!(f, "the fitted scale curve is not monotonic at {pixels} pixels")
            }
        }
    }
}

impl core::error::Error for ScaleError {}

impl ScaleCurve {
    /// Equation 1 as printed, for distances in pixels of the ceiling camera. Its coefficients are
    /// rounded: it is 0.04 to 0.09 below table 1, where a [`ScaleCurve::fit`] is within 0.03.
    pub const EQUATION_1: Self = Self::of_powers([0.0051, 0.028, 0.000_11, -7e-6, 4.4e-8], 62, 121);

    /// The curve with these coefficients by powers of the pixels, from the constant on, measured from
    /// `first` to `last` pixels. `ubimap scale` prints them for a table.
    pub const fn of_powers([a, b, c, d, e]: [f32; TERMS], first: u8, last: u8) -> Self {
        let terms = [Term::of(a), Term::of(b), Term::of(c), Term::of(d), Term::of(e)];
        Self { centre: 0.0, spread: 1.0, terms, first, last }
    }

    /// Fits a curve of fourth degree to a table (least squares of the scale factor). Each row holds
    /// the pixels of free floor in the middle column and the distance to the object there, in any
    /// unit; the curve uses the same unit. Both must increase from row to row. Takes one pass over
    /// the table for each of the five coefficients.
    ///
    /// # Errors
    /// [`ScaleError`].
    pub fn fit(table: &[(u8, f32)]) -> Result<Self, ScaleError> {
        let (Some(&(first, _)), Some(&(last, _))) = (table.first(), table.last()) else {
            return Err(ScaleError::TooShort);
        };
        if table.len() < TERMS {
            return Err(ScaleError::TooShort);
        }
        let mut before = (0, 0.0);
        for (index, &(pixels, distance)) in table.iter().enumerate() {
            if pixels <= before.0 || !(distance > before.1 && distance.is_finite()) {
                return Err(ScaleError::Row(index));
            }
            before = (pixels, distance);
        }
        let (low, high) = (f32::from(first), f32::from(last));
        let mut curve = Self {
            centre: (low + high) / 2.0,
            spread: (high - low) / 2.0,
            terms: [Term::of(0.0); TERMS],
            first,
            last,
        };
        let mut norm_before = 1.0;
        for degree in 0..TERMS {
            // The inner products of p_k with itself, with x p_k, and with the residual that the
            // previous terms left.
            let (mut norm, mut moment, mut rest) = (0.0, 0.0, 0.0);
            for &(pixels, distance) in table {
                let (Some(x), Some(alpha)) = (curve.x(pixels), curve.alpha(pixels)) else {
                    continue;
                };
                let p = curve.basis(x).nth(degree).map_or(0.0, |(_, p, _)| p);
                norm += p * p;
                moment += x * p * p;
                rest += (distance / f32::from(pixels) - alpha) * p;
            }
            if let Some(term) = curve.terms.get_mut(degree) {
                let damping = if degree == 0 { 0.0 } else { norm / norm_before };
                *term = Term { coefficient: rest / norm, shift: moment / norm, damping };
            }
            norm_before = norm;
        }
        let grows = |&pixels: &u8| {
            let distance = curve.distance(pixels).is_some_and(f32::is_finite);
            distance && curve.reach(pixels).is_some_and(|reach| reach > 0.0)
        };
        match (first..=last).find(|pixels| !grows(pixels)) {
            Some(pixels) => Err(ScaleError::Turns(pixels)),
            None => Ok(curve),
        }
    }

    /// The same curve for distances in another unit, multiplied by `factor`: for
    /// [`ScaleCurve::EQUATION_1`], millimetres of floor per pixel of the ceiling camera.
    pub fn scaled(mut self, factor: f32) -> Self {
        for term in &mut self.terms {
            term.coefficient *= factor;
        }
        self
    }

    /// The scale factor (equation 1); `None` outside the measured range.
    pub fn alpha(&self, pixels: u8) -> Option<f32> {
        let x = self.x(pixels)?;
        Some(self.basis(x).map(|(term, p, _)| term.coefficient * p).sum())
    }

    /// The distance (equation 2) in the table's unit; `None` outside the measured range.
    pub fn distance(&self, pixels: u8) -> Option<f32> {
        Some(self.alpha(pixels)? * f32::from(pixels))
    }

    /// The far end of the measured range: its pixels, and its distance in the table's unit.
    pub fn far(&self) -> (u8, f32) {
        (self.last, self.distance(self.last).unwrap_or(0.0))
    }

    /// The derivative of the distance with respect to pixels: alpha + d_r d(alpha)/d(d_r).
    pub fn reach(&self, pixels: u8) -> Option<f32> {
        let x = self.x(pixels)?;
        let slope: f32 = self.basis(x).map(|(term, _, slope)| term.coefficient * slope).sum();
        Some(self.alpha(pixels)? + f32::from(pixels) * slope / self.spread)
    }

    /// The weight of a boundary at `pixels`, 0 to 1: the inverse of [`ScaleCurve::reach`], the
    /// distance by which an error of one pixel moves the boundary, scaled to 1 at the near end of
    /// the curve. `None` outside the measured range.
    pub fn weight(&self, pixels: u8) -> Option<f32> {
        Some((self.reach(self.first)? / self.reach(pixels)?).min(1.0))
    }

    /// The distance up to which the weight is at least 0.5, in the table's unit. Beyond it, one
    /// pixel changes the distance more than twice as much as at the near end of the curve.
    pub fn near(&self) -> f32 {
        let is_near = |&pixels: &u8| self.weight(pixels).is_some_and(|weight| weight >= 0.5);
        let near = (self.first..=self.last).take_while(is_near);
        near.last().and_then(|pixels| self.distance(pixels)).unwrap_or(0.0)
    }

    fn x(&self, pixels: u8) -> Option<f32> {
        let measured = (self.first..=self.last).contains(&pixels);
        measured.then(|| (f32::from(pixels) - self.centre) / self.spread)
    }

    /// Each term, with the value and the slope of its p_k at x.
    fn basis(&self, x: f32) -> impl Iterator<Item = (Term, f32, f32)> {
        let (mut p, mut slope) = (1.0, 0.0);
        let (mut p_before, mut slope_before) = (0.0, 0.0);
        self.terms.into_iter().map(move |term| {
            let now = (term, p, slope);
            let along = x - term.shift;
            let next = along * p - term.damping * p_before;
            let next_slope = p + along * slope - term.damping * slope_before;
            (p_before, slope_before) = (p, slope);
            (p, slope) = (next, next_slope);
            now
        })
    }
}

#[cfg(test)]
mod tests {
    use std::vec::Vec;

    use super::*;
    use proptest::prelude::*;

    /// The third column of table 1, as printed.
    const PRINTED: [f32; 10] = [1.19, 1.20, 1.21, 1.23, 1.25, 1.28, 1.37, 1.57, 1.75, 2.10];

    fn errors(curve: &ScaleCurve) -> Vec<f32> {
        let rows = TABLE_1.iter().zip(PRINTED);
        rows.map(|(&(pixels, _), alpha)| curve.alpha(pixels).unwrap() - alpha).collect()
    }

    #[test]
    fn table_1_has_the_printed_quotients() {
        for ((pixels, distance), alpha) in TABLE_1.into_iter().zip(PRINTED) {
            assert!((distance / f32::from(pixels) - alpha).abs() < 0.006, "{pixels}");
        }
    }

    #[test]
    fn equation_1_stays_below_table_1_by_four_to_nine_hundredths() {
        for error in errors(&ScaleCurve::EQUATION_1) {
            assert!((-0.0897..=-0.0413).contains(&error), "{error}");
        }
        // Evaluates equation 1 independently, in the order of its terms.
        for d in 62..=121u8 {
            let r = f64::from(d);
            let printed =
                4.4e-8 * r.powi(4) - 7e-6 * r.powi(3) + 0.00011 * r.powi(2) + 0.028 * r + 0.0051;
            let alpha = f64::from(ScaleCurve::EQUATION_1.alpha(d).unwrap());
            assert!((alpha - printed).abs() < 1e-5, "{d}: {alpha} {printed}");
        }
    }

    #[test]
    fn a_fit_of_table_1_has_a_third_of_the_error() {
        let curve = ScaleCurve::fit(&TABLE_1).unwrap();
        let worst = errors(&curve).into_iter().map(f32::abs).fold(0.0, f32::max);
        assert!(worst < 0.0897 / 3.0, "{worst}");
        for pixels in 0..=255 {
            assert_eq!(curve.alpha(pixels).is_some(), (62..=121).contains(&pixels));
        }
    }

    #[test]
    fn the_weight_falls_as_a_pixel_spans_more() {
        for curve in [ScaleCurve::EQUATION_1, ScaleCurve::fit(&TABLE_1).unwrap()] {
            assert_eq!(curve.weight(62), Some(1.0));
            assert!(curve.weight(121).unwrap() < 0.25);
            for pixels in 63..=120 {
                // The slope by finite differences, in f64 for precision.
                let at = |pixels| f64::from(curve.distance(pixels).unwrap());
                let slope = (at(pixels + 1) - at(pixels - 1)) / 2.0;
                let reach = f64::from(curve.reach(pixels).unwrap());
                assert!((reach - slope).abs() < 0.02, "{pixels}: {reach} {slope}");
            }
            let far: Vec<_> = (95..=121).map(|pixels| curve.weight(pixels).unwrap()).collect();
            assert!(far.is_sorted_by(|near, far| near > far), "{far:?}");
            let near = (62..=121).find(|&pixels| curve.distance(pixels) == Some(curve.near()));
            let weights = near.map(|near| [near, near + 1].map(|it| curve.weight(it).unwrap()));
            assert!(weights.is_some_and(|[near, far]| near >= 0.5 && far < 0.5), "{weights:?}");
        }
    }

    #[test]
    fn tables_without_a_valid_curve_are_refused() {
        assert_eq!(ScaleCurve::fit(&[]), Err(ScaleError::TooShort));
        assert_eq!(ScaleCurve::fit(&TABLE_1[..4]), Err(ScaleError::TooShort));
        let with = |index: usize, row| {
            let mut table = TABLE_1;
            table[index] = row;
            ScaleCurve::fit(&table)
        };
        for (index, row) in [
            (0, (0, 74.0)),
            (3, (75, 100.0)),
            (3, (81, 91.0)),
            (4, (85, f32::NAN)),
            (9, (121, f32::INFINITY)),
        ] {
            assert_eq!(with(index, row), Err(ScaleError::Row(index)));
        }
        let jump = [(10, 10.0), (20, 20.0), (30, 21.0), (40, 900.0), (50, 901.0), (60, 902.0)];
        assert!(matches!(ScaleCurve::fit(&jump), Err(ScaleError::Turns(_))));
    }

    proptest! {
        /// A camera at a random height, looking down on a floor, with a random horizon.
        #[test]
        fn the_fit_is_no_worse_than_any_curve_nearby(
            pixels in proptest::collection::btree_set(20u8..120, 6..30),
            horizon in 125.0f64..200.0,
            height in 3_000.0f64..30_000.0,
            nudge in proptest::collection::vec(-1.0f64..1.0, 5),
        ) {
            let table: Vec<_> = pixels
                .iter()
                .map(|&pixels| (pixels, (height / (horizon - f64::from(pixels))) as f32))
                .collect();
            let Ok(curve) = ScaleCurve::fit(&table) else { return Ok(()) };
            let (low, high) = (f64::from(table[0].0), f64::from(table[table.len() - 1].0));
            let cost = |size: f64| -> f64 {
                table
                    .iter()
                    .map(|&(pixels, distance)| {
                        let alpha = f64::from(distance) / f64::from(pixels);
                        let x = 2.0 * (f64::from(pixels) - low) / (high - low) - 1.0;
                        let powers = nudge.iter().enumerate();
                        let nudged: f64 = powers.map(|(k, by)| by * x.powi(k as i32)).sum();
                        let fitted = f64::from(curve.alpha(pixels).unwrap());
                        (fitted + size * nudged - alpha).powi(2)
                    })
                    .sum()
            };
            let scale = f64::from(curve.alpha(table[0].0).unwrap());
            for size in [1e-2, -1e-2] {
                prop_assert!(cost(0.0) <= cost(size * scale));
            }
        }

        #[test]
        fn any_table_gives_a_finite_curve_or_an_error(table in proptest::collection::vec((any::<u8>(), any::<f32>()), 0..40)) {
            if let Ok(curve) = ScaleCurve::fit(&table) {
                for pixels in 0..=255 {
                    prop_assert!(curve.distance(pixels).is_none_or(|it| it.is_finite()));
                }
            }
        }
    }
}

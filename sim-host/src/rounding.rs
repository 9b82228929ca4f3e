//! Numbers in messages.

use std::fmt;

/// A number with at most four decimals, and with an exponent if plain digits would be long.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Rounded(pub(crate) f64);

impl fmt::Display for Rounded {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self(value) = *self;
        let size = value.abs();
        if value.is_finite() && size > 0.0 && !(1e-3..1e12).contains(&size) {
            write!(f, "{value:.3e}")
        } else {
            write!(f, "{}", (value * 1e4).round() / 1e4)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_short() {
        for (value, text) in [
            (1.0 / 3.0, "0.3333"),
            (-1.0, "-1"),
            (0.0, "0"),
            (86_400.0, "86400"),
            (1e300, "1.000e300"),
            (-1.234_56e-7, "-1.235e-7"),
            (f64::NAN, "NaN"),
            (f64::INFINITY, "inf"),
        ] {
            assert_eq!(Rounded(value).to_string(), text);
        }
    }
}

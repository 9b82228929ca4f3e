//! Time as integer microseconds. Nothing here reads a clock: time is always an argument.

use core::ops::{Add, Sub};

use serde::{Deserialize, Serialize};

/// A point in time: microseconds since a clock's start. Each side has its own clock; where the
/// server's clock is meant, docs say "server's clock".
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
)]
pub struct Instant(pub u64);

/// A span of time in microseconds.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
)]
pub struct Duration(pub u64);

impl Instant {
    /// The instant `micros` microseconds after the clock's start.
    pub const fn from_micros(micros: u64) -> Self {
        Self(micros)
    }

    /// Microseconds since the clock's start.
    pub const fn micros(self) -> u64 {
        self.0
    }

    /// Whole seconds since the clock's start; wraps after 136 years.
    pub const fn seconds(self) -> u32 {
        // Long division in 16-bit digits, because a 64-bit division costs a microcontroller 1 kB of
        // flash.
        const PER_SECOND: u32 = 1_000_000 >> 6;
        let (mut seconds, mut rest, mut digit) = (0u32, 0, 4);
        while digit > 0 {
            digit -= 1;
            rest = (rest << 16) | ((self.0 >> 6) >> (16 * digit)) as u16 as u32;
            seconds = (seconds << 16) | (rest / PER_SECOND);
            rest %= PER_SECOND;
        }
        seconds
    }

    /// The earlier of two instants, or the only one that is present; `None` if neither is.
    #[inline(never)]
    pub fn earlier(one: Option<Self>, other: Option<Self>) -> Option<Self> {
        match (one, other) {
            (Some(one), Some(other)) => Some(one.min(other)),
            _ => one.or(other),
        }
    }

    /// The time elapsed since `earlier`; zero if `earlier` is later than `self`.
    pub const fn since(self, earlier: Self) -> Duration {
        Duration(self.0.saturating_sub(earlier.0))
    }
}

impl Duration {
    /// A span of microseconds.
    pub const fn from_micros(micros: u64) -> Self {
        Self(micros)
    }

    /// A span of milliseconds.
    pub const fn from_millis(millis: u64) -> Self {
        Self(millis * 1_000)
    }

    /// A span of seconds.
    pub const fn from_secs(secs: u64) -> Self {
        Self(secs * 1_000_000)
    }

    /// The span in microseconds.
    pub const fn micros(self) -> u64 {
        self.0
    }
}

impl Add<Duration> for Instant {
    type Output = Self;
    fn add(self, span: Duration) -> Self {
        Self(self.0.saturating_add(span.0))
    }
}

impl Sub<Duration> for Instant {
    type Output = Self;
    fn sub(self, span: Duration) -> Self {
        Self(self.0.saturating_sub(span.0))
    }
}

impl Add for Duration {
    type Output = Self;
    fn add(self, other: Self) -> Self {
        Self(self.0.saturating_add(other.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn seconds_are_micros_divided_by_a_million(micros: u64, shift in 0u32..64) {
            let micros = micros >> shift;
            prop_assert_eq!(Instant(micros).seconds(), (micros / 1_000_000) as u32);
        }
    }
}

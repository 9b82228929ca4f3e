//! The wall clock of the rig, which somebody may set while it runs.

use std::{str::FromStr, time};

/// "At 60 s, set the clock forward by 3,600 s": `60:3600`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Step {
    at_s: f64,
    by_s: f64,
}

impl FromStr for Step {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let number = |text: &str| text.parse::<f64>().ok().filter(|it| it.abs() < 1e8);
        let (at, by) = text.split_once(':').unwrap_or((text, ""));
        match (number(at), number(by)) {
            (Some(at_s), Some(by_s)) if at_s >= 0.0 => Ok(Self { at_s, by_s }),
            _ => Err("give AT:BY in seconds, as 60:3600 or 60:-3600".into()),
        }
    }
}

/// Microseconds since 1970, and since the rig began.
#[derive(Clone, Copy, Debug)]
pub(super) struct WallClock {
    began: time::Instant,
    began_at: u64,
    step: Option<Step>,
}

impl WallClock {
    /// The rig begins now.
    pub(super) fn start(step: Option<Step>) -> Self {
        let since = time::SystemTime::now().duration_since(time::UNIX_EPOCH);
        let began_at = since.unwrap_or_default().as_micros() as u64;
        Self { began: time::Instant::now(), began_at, step }
    }

    /// Microseconds since the rig began, which nobody sets.
    pub(super) fn elapsed(&self) -> u64 {
        self.began.elapsed().as_micros() as u64
    }

    /// When the rig began.
    pub(super) fn began_at(&self) -> u64 {
        self.began_at
    }

    /// What the clock shows now.
    pub(super) fn now(&self) -> u64 {
        let elapsed = self.elapsed();
        let step = self.step.filter(|step| elapsed as f64 >= step.at_s * 1e6);
        let by = step.map_or(0, |step| (step.by_s * 1e6) as i64);
        (self.began_at + elapsed).saturating_add_signed(by)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_clock_is_set_at_its_time() {
        assert_eq!("60:-3600".parse(), Ok(Step { at_s: 60.0, by_s: -3_600.0 }));
        for text in ["", "60", "-1:5", "x:5", "5:nan", "1:1e9"] {
            assert!(text.parse::<Step>().is_err(), "{text}");
        }
        let before = WallClock::start("1000:3600".parse().ok());
        let after = WallClock::start("0:3600".parse().ok());
        let apart = |clock: WallClock| clock.now() - clock.began_at();
        assert!(apart(before) < 900_000_000 && apart(after) >= 3_600_000_000);
    }
}

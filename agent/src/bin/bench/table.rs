//! The lines of the table.

use core::fmt::Display;

use cortex_m_semihosting::hprintln;

use crate::counter::{Bench, instructions};

impl Bench {
    /// Runs a stage once and prints its line; its instructions are accurate to one tick of six.
    pub(crate) fn measure<T>(&mut self, name: impl Display, stage: impl FnOnce() -> T) -> T {
        let (result, ticks) = self.count(stage);
        match ticks {
            Some(ticks) => hprintln!("{:>12}  {}", instructions(ticks.into()), name),
            None => hprintln!("{:>12}  {}", "too many", name),
        }
        result
    }
}

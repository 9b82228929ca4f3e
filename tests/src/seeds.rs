//! With which seeds the measured tables are run.

use std::{env, ops::RangeInclusive};

/// What `UBIMAP_SEEDS` says: `10` is the first ten, `11-30` is those from one to another. Without it
/// the first `fewest`.
///
/// # Panics
/// If it says neither.
pub fn seeds(fewest: u64) -> RangeInclusive<u64> {
    let Ok(said) = env::var("UBIMAP_SEEDS") else { return 1..=fewest };
    let (first, last) = said.split_once('-').unwrap_or(("1", &said));
    match (first.parse(), last.parse()) {
        (Ok(first), Ok(last)) if first <= last => first..=last,
        _ => panic!("UBIMAP_SEEDS is {said}, and not a number like 10 or numbers like 11-30"),
    }
}

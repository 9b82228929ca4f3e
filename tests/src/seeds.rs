//! The seeds with which the measured tables are run.

use std::{env, ops::RangeInclusive};

/// The seeds given by `UBIMAP_SEEDS`: `10` means 1 to 10, and `11-30` means that range. Default: 1
/// to `fewest`.
///
/// # Panics If `UBIMAP_SEEDS` has neither form.
pub fn seeds(fewest: u64) -> RangeInclusive<u64> {
    let Ok(said) = env::var("UBIMAP_SEEDS") else { return 1..=fewest };
    let (first, last) = said.split_once('-').unwrap_or(("1", &said));
    match (first.parse(), last.parse()) {
        (Ok(first), Ok(last)) if first <= last => first..=last,
        _ => panic!("UBIMAP_SEEDS is {said}; give a number such as 10, or a range such as 11-30"),
    }
}

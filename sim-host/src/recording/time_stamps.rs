//! Repairs the time stamps of a log so that they increase.

use ubimap_protocol::time::Duration;

/// Default interval between scans in seconds.
pub(super) const USUAL_S: f64 = 1.0;

/// Maximum gap between scans in seconds: a longer one means that the clock was set.
const MAX_GAP_S: f64 = 3600.0;

/// Maximum median step of a coarse clock in seconds. The rate of scans can't be derived from a
/// clock that advances more rarely.
const MAX_TICK_S: f64 = 10.0;

/// Minimum number of different time stamps of a coarse clock. With two of them, the time between
/// would be known only to one tick.
const MIN_VALUES: usize = 3;

/// Maximum fraction of unusable steps for which each of them is repaired by itself.
const MAX_REPAIRED: f64 = 0.1;

/// Converts time stamps in seconds (`None` if the log has none) to strictly increasing times since
/// the first scan. Also returns a note for the user if times were changed or invented.
///
/// If few stamps repeat the previous one, go back or jump, these steps are replaced by the median
/// step. If there are many such stamps, the scans are spread evenly over the time from the first to
/// the last stamp. If that time is unusable too, because stamps go back or have too few different
/// values, the scans are placed one second apart.
pub(super) fn repair(stamps: Option<&[f64]>, scans: usize) -> (Vec<Duration>, Option<String>) {
    let evenly = |step_s: f64| {
        let micros = |index: usize| (index as f64 * step_s * 1e6).round() as u64;
        (0..scans).map(|index| Duration::from_micros(micros(index))).collect()
    };
    let by_index = |why: &str| {
        let note = format!("{why}; times are set by scan index, {USUAL_S} s apart");
        (evenly(USUAL_S), Some(note))
    };
    let Some(stamps) = stamps else { return by_index("no time stamps") };
    if scans < 2 {
        return (evenly(USUAL_S), None);
    }
    let numbered = stamps.iter().enumerate().all(|(index, stamp)| *stamp == index as f64);

    let steps: Vec<f64> = stamps.windows(2).map(|pair| pair[1] - pair[0]).collect();
    let is_usable = |step: &f64| *step >= 1e-6 && *step <= MAX_GAP_S;
    let mut usable: Vec<f64> = steps.iter().copied().filter(is_usable).collect();
    let repaired = steps.len() - usable.len();

    if repaired as f64 <= MAX_REPAIRED * steps.len() as f64 {
        usable.sort_by(f64::total_cmp);
        let usual = usable[usable.len() / 2];
        let mut time = Duration::from_micros(0);
        let mut times = vec![time];
        for step in &steps {
            let step = if is_usable(step) { *step } else { usual };
            time = time + Duration::from_micros(((step * 1e6).round() as u64).max(1));
            times.push(time);
        }
        let note = if repaired > 0 {
            Some(format!(
                "{repaired} of {scans} time stamps don't advance, or leap; \
                 each counted as the usual {usual:.3} s"
            ))
        } else if numbered {
            Some("the time stamps are the scan numbers; taken as seconds".to_owned())
        } else {
            None
        };
        return (times, note);
    }

    let span = stamps[scans - 1] - stamps[0];
    let step = span / (scans - 1) as f64;
    let mut ticks: Vec<f64> = steps.iter().copied().filter(|step| *step > 0.0).collect();
    ticks.sort_by(f64::total_cmp);
    let is_seldom = ticks.get(ticks.len() / 2).is_some_and(|tick| *tick > MAX_TICK_S);
    if steps.iter().all(|step| *step >= 0.0) && (ticks.len() + 1 < MIN_VALUES || is_seldom) {
        let values = ticks.len() + 1;
        return by_index(&format!(
            "the {scans} time stamps have only {values} different values, too coarse to tell the rate"
        ));
    }
    if steps.iter().all(|step| *step >= 0.0) && (1e-6..=MAX_GAP_S).contains(&step) {
        let note = format!(
            "the time stamps are coarse; times are set by scan index, {step:.3} s apart, the mean from \
             first to last stamp"
        );
        return (evenly(step), Some(note));
    }
    by_index("no usable time stamps")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn micros(stamps: &[f64]) -> (Vec<u64>, Option<String>) {
        let (times, note) = repair(Some(stamps), stamps.len());
        (times.into_iter().map(Duration::micros).collect(), note)
    }

    #[test]
    fn good_stamps_are_counted_from_the_first() {
        assert_eq!(micros(&[32.5, 33.0, 35.25]), (vec![0, 500_000, 2_750_000], None));
    }

    #[test]
    fn few_bad_steps_are_replaced_by_the_median() {
        let mut stamps: Vec<f64> = (0..40).map(|index| 5.0 + 2.0 * f64::from(index)).collect();
        stamps[10] = 3.0;
        stamps[30] = 1e9;
        let (times, note) = micros(&stamps);
        assert!(times.windows(2).all(|pair| pair[0] < pair[1]));
        assert!(*times.last().unwrap() < 120_000_000);
        assert!(note.unwrap().contains("3 of 40"));
    }

    #[test]
    fn coarse_stamps_are_spread_and_missing_ones_set_by_index() {
        let (times, note) = micros(&[7.0, 7.0, 7.0, 8.0, 9.0]);
        assert_eq!(times, [0, 500_000, 1_000_000, 1_500_000, 2_000_000]);
        assert!(note.unwrap().contains("coarse"));
        for stamps in [&[0.0; 4][..], &[9.0, 5.0, 4.0, 3.0], &[1e300, -1e300, 1e300, 0.0]] {
            let (times, note) = micros(stamps);
            assert_eq!(times, [0, 1_000_000, 2_000_000, 3_000_000]);
            assert!(note.unwrap().contains("scan index"));
        }
        // It is unknown which part of these 3,340 s the scans took.
        for stamps in [&[0.0, 0.0, 0.0, 3_340.0][..], &[0.0, 0.0, 1_670.0, 3_340.0]] {
            let (times, note) = micros(stamps);
            assert_eq!(times, [0, 1_000_000, 2_000_000, 3_000_000]);
            let note = note.unwrap();
            assert!(note.contains("too coarse to tell the rate; times are set"), "{note}");
        }
        let (times, note) = repair(None, 2);
        assert_eq!(times, [Duration::from_secs(0), Duration::from_secs(1)]);
        assert!(note.is_some());
    }
}

//! Progress of a run: a bar with the remaining time, or a line every ten seconds if standard error
//! is no terminal.

use std::{cell::Cell, time};

use indicatif::{ProgressBar, ProgressStyle};
use ubimap_protocol::time::Instant;

use super::terminal;

/// Interval between two updates of the bar.
const REDRAW: time::Duration = time::Duration::from_millis(100);
/// Interval between two lines without a terminal.
const LINE: time::Duration = time::Duration::from_secs(10);

/// Progress of a run; the bar disappears when it is dropped.
pub(super) struct Progress {
    end: Instant,
    started: time::Instant,
    /// Time of the next update; `None` if progress is not shown.
    next: Cell<Option<time::Instant>>,
    /// The bar; `None` without a terminal.
    bar: Option<ProgressBar>,
}

impl Progress {
    /// Progress of a run until `end`, shown if warnings are logged.
    pub(super) fn new(end: Instant) -> Self {
        let started = time::Instant::now();
        let is_shown = terminal::shows_progress();
        let bar = (is_shown && terminal::is_terminal()).then(|| terminal::show(bar(end)));
        let first = if bar.is_some() { started } else { started + LINE };
        Self { end, started, next: Cell::new(is_shown.then_some(first)), bar }
    }

    /// Reports that the run has reached `now`. Cost: one reading of the wall clock.
    pub(super) fn at(&self, now: Instant) {
        let wall = time::Instant::now();
        if self.next.get().is_none_or(|next| wall < next) {
            return;
        }
        let text = describe(now, self.end, wall.duration_since(self.started));
        match &self.bar {
            Some(bar) => {
                bar.set_message(text);
                bar.set_position(now.micros());
                self.next.set(Some(wall + REDRAW));
            }
            None => {
                terminal::write_line(&format!("ubimap: {text}"));
                self.next.set(Some(wall + LINE));
            }
        }
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

fn bar(end: Instant) -> ProgressBar {
    let bar = ProgressBar::new(end.micros());
    // The template is valid; otherwise the bar keeps its default style.
    if let Ok(style) = ProgressStyle::with_template("{bar:40} {msg}") {
        bar.set_style(style);
    }
    bar
}

/// Text such as "35 of 120 s, 40 s left". At time zero the remaining time is unknown and left out.
fn describe(now: Instant, end: Instant, elapsed: time::Duration) -> String {
    let [done, all] = [now, end].map(|moment| moment.micros() as f64 / 1e6);
    let mut text = format!("{done:.0} of {all:.0} s");
    if done > 0.0 {
        let left = elapsed.as_secs_f64() * (all - done).max(0.0) / done;
        text += &if left < 100.0 {
            format!(", {left:.0} s left")
        } else {
            format!(", {:.0} min left", left / 60.0)
        };
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_remaining_time_is_extrapolated_from_the_elapsed_time() {
        let text = |now: u64, elapsed: u64| {
            let seconds = |it: u64| Instant(it * 1_000_000);
            describe(seconds(now), seconds(120), time::Duration::from_secs(elapsed))
        };
        assert_eq!(text(0, 3), "0 of 120 s");
        assert_eq!(text(30, 10), "30 of 120 s, 30 s left");
        assert_eq!(text(30, 100), "30 of 120 s, 5 min left");
        assert_eq!(text(121, 40), "121 of 120 s, 0 s left");
    }
}

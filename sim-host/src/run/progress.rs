//! How far a run is: a bar with the time left, or a line now and then where standard error is no
//! terminal.

use std::{cell::Cell, time};

use indicatif::{ProgressBar, ProgressStyle};
use ubimap_protocol::time::Instant;

use super::terminal;

/// Between two drawings of the bar.
const REDRAW: time::Duration = time::Duration::from_millis(100);
/// Between two lines without a terminal.
const LINE: time::Duration = time::Duration::from_secs(10);

/// Progress over the time of a run. It goes away when dropped.
pub(super) struct Progress {
    end: Instant,
    started: time::Instant,
    /// When it is shown next; `None` if never.
    next: Cell<Option<time::Instant>>,
    /// None without a terminal.
    bar: Option<ProgressBar>,
}

impl Progress {
    /// For a run up to `end`, shown if warnings are logged.
    pub(super) fn new(end: Instant) -> Self {
        let started = time::Instant::now();
        let is_shown = terminal::shows_progress();
        let bar = (is_shown && terminal::is_terminal()).then(|| terminal::show(bar(end)));
        let first = if bar.is_some() { started } else { started + LINE };
        Self { end, started, next: Cell::new(is_shown.then_some(first)), bar }
    }

    /// It is `now` in the run. Costs the reading of a clock.
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
    // The template is a constant: a bar of the default style would be no harm.
    if let Ok(style) = ProgressStyle::with_template("{bar:40} {msg}") {
        bar.set_style(style);
    }
    bar
}

/// As in "35 of 120 s, 40 s left"; nobody can tell what is left before the run has begun.
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
    fn the_time_left_goes_by_the_speed_so_far() {
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

//! How far a run is: a bar on standard error, if that is a terminal.

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use ubimap_protocol::time::Instant;

/// A bar over the time of a run.
pub(super) struct Progress {
    bar: ProgressBar,
}

impl Progress {
    /// A bar for a run up to `end`; `quiet` shows none.
    pub(super) fn new(end: Instant, quiet: bool) -> Self {
        let bar = ProgressBar::new(end.micros() / 1_000_000);
        let template = "{bar:40} {pos}/{len} s of the run, {elapsed}";
        if let Ok(style) = ProgressStyle::with_template(template) {
            bar.set_style(style);
        }
        if quiet {
            bar.set_draw_target(ProgressDrawTarget::hidden());
        }
        Self { bar }
    }

    /// It is now.
    pub(super) fn at(&self, now: Instant) {
        self.bar.set_position(now.micros() / 1_000_000);
    }

    /// The run is over.
    pub(super) fn finish(&self) {
        self.bar.finish_and_clear();
    }
}

//! How far a placement is: a line on standard error, if that is a terminal.

use std::time::Duration;

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

use crate::placement::{
    placing::{Aim, Stage},
    solver::Interim,
};

/// A line that says what is known so far.
pub(super) struct PlacingProgress {
    bar: ProgressBar,
    aim: Aim,
}

impl PlacingProgress {
    /// A line for a placement with this aim; `quiet` shows none.
    pub(super) fn new(aim: Aim, quiet: bool) -> Self {
        let bar = ProgressBar::new_spinner();
        if let Ok(style) = ProgressStyle::with_template("{spinner} {msg}, {elapsed}") {
            bar.set_style(style);
        }
        if quiet {
            bar.set_draw_target(ProgressDrawTarget::hidden());
        }
        bar.enable_steady_tick(Duration::from_millis(200));
        Self { bar, aim }
    }

    /// Shows what goes on.
    pub(super) fn show(&self, stage: &Stage) {
        // Formatting costs more than a slice of the solver's work where nobody looks.
        if !self.bar.is_hidden() {
            self.bar.set_message(self.describe(stage));
        }
    }

    /// Takes the line away.
    pub(super) fn finish(&self) {
        self.bar.finish_and_clear();
    }

    fn describe(&self, stage: &Stage) -> String {
        match *stage {
            Stage::Seeing { candidates } => format!("what {candidates} candidates see"),
            Stage::Solving(Interim { cameras: None, .. }) => "searching".to_owned(),
            Stage::Solving(Interim { cameras: Some(cameras), weight, bound }) => {
                let bound = bound.map_or("?".to_owned(), |bound| bound.to_string());
                match self.aim {
                    Aim::Cameras(_) => format!("{cameras} cameras see {weight} of at most {bound}"),
                    _ => format!("{cameras} cameras, at least {bound}"),
                }
            }
            Stage::Connecting { cameras, pieces } => {
                format!("connecting {cameras} cameras, {pieces} pieces")
            }
        }
    }
}

//! Progress of a placement: a line on standard error, if that is a terminal.

use std::time::Duration;

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

use crate::{
    placement::{
        placing::{Aim, Stage},
        solver::Interim,
    },
    run::terminal,
};

/// A line with the current stage and the best placement found.
pub(super) struct PlacingProgress {
    bar: ProgressBar,
    aim: Aim,
}

impl PlacingProgress {
    /// A line for a placement with this aim, shown if warnings are logged.
    pub(super) fn new(aim: Aim) -> Self {
        let hidden = ProgressBar::with_draw_target(None, ProgressDrawTarget::hidden());
        let bar = if terminal::shows_progress() { terminal::show(hidden) } else { hidden };
        if let Ok(style) = ProgressStyle::with_template("{spinner} {msg}, {elapsed}") {
            bar.set_style(style);
        }
        bar.enable_steady_tick(Duration::from_millis(200));
        Self { bar, aim }
    }

    /// Shows the current stage.
    pub(super) fn show(&self, stage: &Stage) {
        // Formatting takes longer than a slice of the solver's work: skipped for a hidden line.
        if !self.bar.is_hidden() {
            self.bar.set_message(self.describe(stage));
        }
    }

    /// Removes the line.
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

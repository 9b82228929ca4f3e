//! The runs of the experiments: simulations with the options of the command line.

use clap::Parser;

use super::super::{Outcome, RunError, interruption, options::SimulateOptions, simulate};

/// The options of a simulation as they are typed.
#[derive(Parser)]
struct Typed {
    #[command(flatten)]
    options: SimulateOptions,
}

/// Runs simulations.
pub(super) struct Runs {
    seconds: Option<f64>,
}

impl Runs {
    /// Each run lasts as long as its scenario says, or so many seconds.
    pub(super) fn new(seconds: Option<f64>) -> Self {
        Self { seconds }
    }

    /// Runs `ubimap simulate` with these options.
    pub(super) fn simulate(&mut self, options: &str) -> Result<Outcome, RunError> {
        if interruption::is_requested() {
            return Err(RunError::Interrupted);
        }
        log::info!("simulate {options}");
        let mut words: Vec<String> = vec!["simulate".to_owned()];
        words.extend(options.split_whitespace().map(str::to_owned));
        if let Some(seconds) = self.seconds {
            words.push(format!("--duration={seconds}"));
        }
        let typed = Typed::try_parse_from(words);
        let Typed { options } = typed.map_err(|error| RunError::Typed(error.to_string()))?;
        simulate::run(&options)
    }
}

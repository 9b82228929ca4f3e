//! The runs of the experiments: simulations with the options of the command line.

use std::{
    collections::BTreeMap,
    num::NonZero,
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicUsize, Ordering},
    },
    thread,
};

use clap::Parser;

use super::super::{Outcome, RunError, interruption, options::SimulateOptions, simulate};

/// The pictures of a run that a page may show; the others are dropped, as there are dozens of runs.
const PICTURES: [&str; 4] = ["robot-view.png", "error.png", "points.png", "volatility.png"];

/// The options of a simulation as they are typed.
#[derive(Parser)]
struct Typed {
    #[command(flatten)]
    options: SimulateOptions,
}

/// Runs simulations, each once.
pub(super) struct Runs {
    seconds: Option<f64>,
    done: BTreeMap<String, Arc<Outcome>>,
}

impl Runs {
    /// Each run lasts as long as its scenario says, or so many seconds.
    pub(super) fn new(seconds: Option<f64>) -> Self {
        Self { seconds, done: BTreeMap::new() }
    }

    /// Runs `ubimap simulate` with each of these options, as many at a time as there are processors.
    pub(super) fn prepare(&mut self, lines: &[String]) -> Result<(), RunError> {
        let (next, seconds) = (AtomicUsize::new(0), self.seconds);
        let results = Mutex::new(Vec::new());
        let work = || {
            while let Some(line) = lines.get(next.fetch_add(1, Ordering::Relaxed)) {
                let result = run(line, seconds);
                let is_over = result.is_err();
                let mut results = results.lock().unwrap_or_else(PoisonError::into_inner);
                results.push((line.clone(), result));
                if is_over {
                    return;
                }
            }
        };
        let abreast = thread::available_parallelism().map_or(1, NonZero::get);
        thread::scope(|scope| (0..abreast).for_each(|_| drop(scope.spawn(work))));
        for (line, result) in results.into_inner().unwrap_or_else(PoisonError::into_inner) {
            self.done.insert(line, Arc::new(result?));
        }
        Ok(())
    }

    /// The outcome of `ubimap simulate` with these options.
    pub(super) fn simulate(&mut self, options: &str) -> Result<Arc<Outcome>, RunError> {
        if let Some(done) = self.done.get(options) {
            return Ok(done.clone());
        }
        let outcome = Arc::new(run(options, self.seconds)?);
        self.done.insert(options.to_owned(), outcome.clone());
        Ok(outcome)
    }
}

fn run(line: &str, seconds: Option<f64>) -> Result<Outcome, RunError> {
    if interruption::is_requested() {
        return Err(RunError::Interrupted);
    }
    log::info!("simulate {line}");
    let mut words: Vec<String> = vec!["simulate".to_owned()];
    words.extend(line.split_whitespace().map(str::to_owned));
    if let Some(seconds) = seconds {
        words.push(format!("--duration={seconds}"));
    }
    let typed = Typed::try_parse_from(words);
    let Typed { options } = typed.map_err(|error| RunError::Typed(error.to_string()))?;
    let mut outcome = simulate::run(&options)?;
    outcome.pictures.retain(|(name, _)| PICTURES.contains(name));
    Ok(outcome)
}

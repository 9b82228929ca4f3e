//! `ubimap reproduce`: runs the experiments of the three papers, and writes one page that puts their printed
//! numbers beside ours. Its sections are the papers' own.

mod ahmed;
mod aluckal;
mod awareness;
mod page;
mod runs;
mod ubislam;

use std::path::PathBuf;

use clap::{Args, ValueEnum};

use super::{
    RunError,
    options::{OptionError, number},
};
use crate::report::OutputFolder;
use page::Page;
use runs::Runs;

/// Options of `ubimap reproduce`.
#[derive(Args, Clone, Debug)]
pub struct ReproduceOptions {
    /// The paper; all three without it
    #[arg(value_enum)]
    pub paper: Option<Paper>,

    /// Folder for the page (page.md) and its pictures
    #[arg(long, value_name = "DIR", default_value = "reproduced")]
    pub out: PathBuf,

    /// Simulate only so many seconds of each experiment, for a quick look
    #[arg(long, value_name = "S", value_parser = seconds, allow_negative_numbers = true)]
    pub seconds: Option<f64>,
}

fn seconds(text: &str) -> Result<f64, OptionError> {
    number(text, 1.0, 3_600.0, "seconds")
}

/// A paper.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Paper {
    /// Djerroud et al., Towards ubiquitous mapping and localization for dynamic indoor environments (2025)
    Ubislam,
    /// Aluckal et al., Dynamic real-time indoor environment mapping for unmanned autonomous vehicle navigation
    Aluckal,
    /// Ahmed et al., Vision based environment mapping by network connected multi-robotic system (2013)
    Ahmed,
}

/// Runs the experiments and writes the page. Returns where it is.
///
/// # Errors
/// [`RunError`]: a run fails, or the folder can't be written.
pub fn run(options: &ReproduceOptions) -> Result<PathBuf, RunError> {
    let mut folder = OutputFolder::create(&options.out)?;
    let mut runs = Runs::new(options.seconds);
    let mut page = Page::new(options.seconds);
    let is_asked = |paper| options.paper.is_none_or(|asked| asked == paper);
    // The longest first, so that no processor is idle at the end.
    let papers = [
        (Paper::Ubislam, ubislam::lines()),
        (Paper::Ahmed, ahmed::lines()),
        (Paper::Aluckal, aluckal::lines()),
    ];
    let asked = papers.into_iter().filter(|(paper, _)| is_asked(*paper));
    runs.prepare(&asked.flat_map(|(_, lines)| lines).collect::<Vec<_>>())?;
    if is_asked(Paper::Ubislam) {
        ubislam::write(&mut page, &mut runs)?;
    }
    if is_asked(Paper::Aluckal) {
        aluckal::write(&mut page, &mut runs)?;
    }
    if is_asked(Paper::Ahmed) {
        ahmed::write(&mut page, &mut runs)?;
    }
    for (name, bytes) in page.pictures() {
        folder.add(name, bytes)?;
    }
    folder.add("page.md", page.text().as_bytes())?;
    folder.finish()?;
    Ok(options.out.join("page.md"))
}

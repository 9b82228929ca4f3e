//! Standard error: log lines, with a progress bar below them.
//!
//! Both share the process's one terminal, so the bars are a static like the logger: logging a line
//! clears the bars, writes the line, and redraws the bars below it.

use std::{
    io::{self, IsTerminal, Write},
    sync::LazyLock,
};

use indicatif::{MultiProgress, ProgressBar};
use log::{Level, LevelFilter, Log, Metadata, Record};
use ubimap_protocol::time::Instant;

static BARS: LazyLock<MultiProgress> = LazyLock::new(MultiProgress::new);

/// Starts logging to standard error at `level`, unless `RUST_LOG` says otherwise.
pub fn start_logging(level: LevelFilter) {
    let mut builder = env_logger::Builder::new();
    builder.filter_level(level).parse_default_env().format(|out, record| {
        let kind = match record.level() {
            Level::Warn => "warning",
            Level::Error => "error",
            Level::Info => "info",
            Level::Debug => "debug",
            Level::Trace => "trace",
        };
        writeln!(out, "ubimap: {kind}: {}", record.args())
    });
    let logger = AboveBars(builder.build());
    let level = logger.0.filter();
    // An existing logger is kept.
    if log::set_boxed_logger(Box::new(logger)).is_ok() {
        log::set_max_level(level);
    }
}

/// Whether progress is shown: whenever warnings are logged. Before [`start_logging`] there is none.
pub(super) fn shows_progress() -> bool {
    log::max_level() >= LevelFilter::Warn
}

/// Whether standard error is a terminal, so that a bar is visible.
pub(super) fn is_terminal() -> bool {
    io::stderr().is_terminal()
}

/// Shows a bar below the log lines.
pub(super) fn show(bar: ProgressBar) -> ProgressBar {
    BARS.add(bar)
}

/// Writes a line above the bars. Ignores a closed standard error.
pub(super) fn write_line(line: &str) {
    BARS.suspend(|| {
        let _ = writeln!(io::stderr(), "{line}");
    });
}

/// A moment of a run as a prefix of log lines, such as "at 12.3 s".
pub(super) fn seconds(moment: Instant) -> String {
    format!("at {:.1} s", moment.micros() as f64 / 1e6)
}

/// Logs above the bars.
struct AboveBars(env_logger::Logger);

impl Log for AboveBars {
    fn enabled(&self, metadata: &Metadata<'_>) -> bool {
        self.0.enabled(metadata)
    }

    fn log(&self, record: &Record<'_>) {
        if self.0.enabled(record.metadata()) {
            BARS.suspend(|| self.0.log(record));
        }
    }

    fn flush(&self) {
        self.0.flush();
    }
}

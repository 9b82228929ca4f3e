//! Standard error: log lines, and a progress bar below them.
//!
//! Both write to the one terminal of the process, and the logger of the process is a static too, so
//! the bars are one: a line that is logged takes them away, is written, and draws them again below.

use std::{
    io::{self, IsTerminal, Write},
    sync::LazyLock,
};

use indicatif::{MultiProgress, ProgressBar};
use log::{Level, LevelFilter, Log, Metadata, Record};
use ubimap_protocol::time::Instant;

static BARS: LazyLock<MultiProgress> = LazyLock::new(MultiProgress::new);

/// Logs to standard error from now on: what is at least as important as `level`, or what `RUST_LOG`
/// asks for.
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
    // A logger that is there already stays.
    if log::set_boxed_logger(Box::new(logger)).is_ok() {
        log::set_max_level(level);
    }
}

/// Where progress is shown: wherever warnings are. A program that has not started to log shows none.
pub(super) fn shows_progress() -> bool {
    log::max_level() >= LevelFilter::Warn
}

/// Whether somebody sees a bar.
pub(super) fn is_terminal() -> bool {
    io::stderr().is_terminal()
}

/// Shows a bar below all lines that are logged.
pub(super) fn show(bar: ProgressBar) -> ProgressBar {
    BARS.add(bar)
}

/// Writes a line above the bars. A standard error that is closed is no reason to fail.
pub(super) fn write_line(line: &str) {
    BARS.suspend(|| {
        let _ = writeln!(io::stderr(), "{line}");
    });
}

/// A moment of a run as log lines begin, such as "at 12.3 s".
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

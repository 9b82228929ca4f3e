//! The results of a run, as a table, JSON and JUnit XML.

use std::fmt;

use serde::Serialize;
use ubimap_protocol::{frame::VERSION, time::Duration};

use super::check::{CheckResult, Role, Verdict};

/// The results of all checks that were run.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ConformanceReport {
    /// Always "ubimap-conformance".
    pub schema: &'static str,
    /// Version of the schema.
    pub version: u32,
    /// What was tested: "robot" or "server".
    pub role: String,
    /// The version of the wire format.
    pub protocol: u8,
    /// Number of checks that passed.
    pub passed: usize,
    /// Number of checks that failed.
    pub failed: usize,
    /// Number of checks that were skipped.
    pub skipped: usize,
    /// The checks.
    pub checks: Vec<CheckResult>,
    /// Duration in seconds by the bench's clock.
    pub elapsed_s: f64,
}

impl ConformanceReport {
    pub(super) fn new(role: Role, checks: Vec<CheckResult>, elapsed: Duration) -> Self {
        let count = |is: fn(&Verdict) -> bool| checks.iter().filter(|it| is(&it.verdict)).count();
        Self {
            schema: "ubimap-conformance",
            version: 1,
            role: role.to_string(),
            protocol: VERSION,
            passed: count(|it| matches!(it, Verdict::Passed)),
            failed: count(|it| matches!(it, Verdict::Failed { .. })),
            skipped: count(|it| matches!(it, Verdict::Skipped(_))),
            checks,
            elapsed_s: elapsed.micros() as f64 / 1e6,
        }
    }

    /// Whether no check has failed, and at least one has passed.
    pub fn conforms(&self) -> bool {
        self.failed == 0 && self.passed > 0
    }

    /// The results as JUnit XML.
    pub fn junit(&self) -> String {
        let suite = format!("ubimap conformance of a {}", self.role);
        let mut xml = format!(
            "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<testsuite name=\"{suite}\" tests=\"{}\" \
             failures=\"{}\" skipped=\"{}\" time=\"{:.3}\">\n",
            self.checks.len(),
            self.failed,
            self.skipped,
            self.elapsed_s
        );
        for check in &self.checks {
            let case = format!(
                "  <testcase classname=\"SPEC {}\" name=\"{}\" time=\"{}\"",
                check.section, check.name, check.seconds
            );
            xml.push_str(&case);
            match &check.verdict {
                Verdict::Passed => xml.push_str("/>\n"),
                Verdict::Skipped(reason) => {
                    xml.push_str(&format!(
                        ">\n    <skipped message=\"{}\"/>\n  </testcase>\n",
                        escaped(reason)
                    ));
                }
                Verdict::Failed { expected, found, frames } => {
                    let message = format!("expected {expected}; found {found}");
                    xml.push_str(&format!(
                        ">\n    <failure message=\"{}\">{}</failure>\n  </testcase>\n",
                        escaped(&message),
                        escaped(&frames.join("\n"))
                    ));
                }
            }
        }
        xml + "</testsuite>\n"
    }
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// The counts in one line.
impl fmt::Display for ConformanceReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { role, passed, failed, skipped, elapsed_s, .. } = self;
        writeln!(
            f,
            "{role}: {passed} passed, {failed} failed, {skipped} skipped in {elapsed_s:.0} s"
        )
    }
}

/// One line, and for a failure what was expected, what was found and the last frames.
impl fmt::Display for CheckResult {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { number, name, section, rule, verdict, .. } = self;
        let word = match verdict {
            Verdict::Passed => "pass",
            Verdict::Skipped(_) => "skip",
            Verdict::Failed { .. } => "FAIL",
        };
        writeln!(f, "{word} {number:>3} {name:<30} SPEC {section:<4} {rule}")?;
        match verdict {
            Verdict::Passed => Ok(()),
            Verdict::Skipped(reason) => writeln!(f, "         {reason}"),
            Verdict::Failed { expected, found, frames } => {
                writeln!(f, "         expected: {expected}\n         found:    {found}")?;
                frames.iter().try_for_each(|frame| writeln!(f, "         {frame}"))
            }
        }
    }
}

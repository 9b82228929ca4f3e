//! A check, and its result.

use std::fmt;

use serde::Serialize;

use super::{bench::Gone, talk::Talk};

/// What the implementation under test is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// A robot: the runner plays the server.
    Robot,
    /// A server: the runner plays robots.
    Server,
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Robot => "robot",
            Self::Server => "server",
        })
    }
}

/// A rule of SPEC.md, and how to check that it is kept.
#[derive(Clone, Copy, Debug)]
pub struct Check {
    /// A short name, unique among all checks of a role.
    pub name: &'static str,
    /// The section of SPEC.md.
    pub section: &'static str,
    /// The rule in a few words.
    pub rule: &'static str,
    /// Checks it.
    pub run: fn(&mut Talk<'_>) -> Result<(), Halt>,
}

/// Why a check ended early.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Halt {
    /// The rule is broken.
    Failed {
        /// What was expected.
        expected: String,
        /// What happened instead.
        found: String,
    },
    /// The rule can't be checked with this implementation, for this reason.
    Skipped(String),
    /// The implementation has gone.
    Gone(Gone),
}

impl From<Gone> for Halt {
    fn from(gone: Gone) -> Self {
        Self::Gone(gone)
    }
}

/// A failed check.
pub(super) fn fail<T>(expected: impl Into<String>, found: impl Into<String>) -> Result<T, Halt> {
    Err(Halt::Failed { expected: expected.into(), found: found.into() })
}

/// A skipped check.
pub(super) fn skip<T>(reason: impl Into<String>) -> Result<T, Halt> {
    Err(Halt::Skipped(reason.into()))
}

/// The result of a check.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct CheckResult {
    /// Its number, as `--only` takes it.
    pub number: usize,
    /// Its name.
    pub name: &'static str,
    /// The section of SPEC.md.
    pub section: &'static str,
    /// The rule in a few words.
    pub rule: &'static str,
    /// How it ended.
    pub verdict: Verdict,
    /// Duration in seconds by the bench's clock.
    pub seconds: u64,
}

/// How a check ended.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// The rule is kept.
    Passed,
    /// The rule can't be checked with this implementation, for this reason.
    Skipped(String),
    /// The rule is broken.
    Failed {
        /// What was expected.
        expected: String,
        /// What happened instead.
        found: String,
        /// The last frames in both directions: time, direction, and the bytes as text and in words.
        frames: Vec<String>,
    },
}

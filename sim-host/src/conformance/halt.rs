//! What is tested, and why a check ends early.

use std::fmt;

use super::bench::Gone;

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

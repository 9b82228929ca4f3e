//! Messages that could not be read, and why.

use core::fmt;

use ubimap_protocol::message::{Message, ToServer, ToServerKind};

/// A message that could not be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Unread {
    /// Its kind, by number, is not known to this version.
    Unknown(u8),
    /// It can't be read as its kind, or breaks a rule.
    Malformed {
        /// The number of the kind.
        number: u8,
        /// Length of the body in bytes.
        len: usize,
    },
}

impl Unread {
    pub(super) fn of(message: Message<'_, ToServer>) -> Self {
        match message.kind() {
            None => Self::Unknown(message.number),
            Some(_) => Self::Malformed { number: message.number, len: message.body.len() },
        }
    }
}

impl fmt::Display for Unread {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::Unknown(number) => {
                write!(f, "a message of kind {number}, which this version does not know")
            }
            Self::Malformed { number, len } => {
                let kind = ToServerKind::from_number(number);
                let name = kind.map_or_else(String::new, |kind| format!("{kind:?} "));
                write!(f, "a malformed {name}(kind {number}, {len} bytes)")
            }
        }
    }
}

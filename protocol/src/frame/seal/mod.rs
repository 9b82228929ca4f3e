//! What protects a frame.
//!
//! | file | content |
//! |---|---|
//! | `crc` | the seal of an open link: a checksum, for a trusted wire |
//! | `ascon` | authenticated encryption under a [`Key`], for all others |
//! | `layout` | sealed frames: clear bytes, nonces and associated data of each kind |
//! | `slot` | memory of sealed links |

mod ascon;
mod crc;
mod layout;
mod slot;

pub use ascon::{KEY_LEN, Key, SealSupport, TAG_LEN};
pub use crc::{SEAL_LEN, open, seal};
pub use layout::{
    ANSWER_CLEAR_LEN, Attempt, HELLO_CLEAR_LEN, MAX_SEALED_HANDSHAKE, SEALED_LEN,
    SESSION_CLEAR_LEN, SessionKey, Stray, echo_of, open_answer, open_hello, open_session,
    seal_answer, seal_hello, seal_session,
};
pub use slot::SealSlot;

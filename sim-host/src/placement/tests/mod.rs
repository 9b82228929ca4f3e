//! Tests that span several files.

mod connecting;
mod placing;
mod programmes;
mod seeing;
mod solving;

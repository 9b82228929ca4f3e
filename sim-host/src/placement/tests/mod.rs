//! Tests of several files at once.

mod connecting;
mod placing;
mod programmes;
mod seeing;
mod solving;

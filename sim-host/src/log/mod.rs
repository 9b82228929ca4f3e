//! Readers of recorded logs.

//! Tests that span several files.

//! `ubimap`, the command line.
fn main() {}

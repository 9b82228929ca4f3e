//! Tests of marker detection on recorded and on rendered pictures.

mod accuracy;
mod reach;
mod recorded;

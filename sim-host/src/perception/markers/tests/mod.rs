//! What the markers are good for, on pictures that others took and on rendered ones.

mod accuracy;
mod recorded;

//! Simulated devices, which speak the bytes of the real ones, for robots in the simulated room.
//!
//! [`SimA010`] is a depth camera, [`SimLd06`] a lidar and [`SimCreate2`] a mobile base; each sends its bytes at the speed
//! of its [`Line`]. They are written by the manufacturers' documents and share no code with the
//! robots' drivers (`ubimap_agent::device`).

mod a010;
mod create2;
mod ld06;
mod line;

pub use a010::SimA010;
pub use create2::{SimCreate2, Wiring};
pub use ld06::SimLd06;
pub use line::Line;

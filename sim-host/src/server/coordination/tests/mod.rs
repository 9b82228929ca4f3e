//! Complete drives of several robots on simple floors.

mod exploration;
mod floor;
pub(super) mod plan;
mod traffic;

//! Complete drives of several robots on simple floors.

mod blocked;
mod exploration;
mod floor;
mod keeping;
pub(super) mod plan;
mod traffic;

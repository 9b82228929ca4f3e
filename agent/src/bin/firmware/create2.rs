//! The wheels are an iRobot Create 2 at a port.

use ubimap_agent::{
    Machine,
    device::{DepthSensor, create2::Create2},
    drive::Drive,
};
use ubimap_protocol::time::Instant;

use crate::board::Board;

/// The driver of the wheels.
pub(crate) type Base = Create2;

/// The wheels of a board; `None` if they were taken before.
pub(crate) fn base(_: &mut Board) -> Option<Base> {
    Some(Create2::new())
}

/// Nothing to do: the base reports by bytes.
pub(crate) fn count<D: Drive>(
    _: &mut Board,
    _: &mut Machine<'_, impl DepthSensor, Base, D>,
    _: Instant,
) {
}

//! The firmware of a robot with an A010 depth camera (with the feature `ld06`, an LD06 lidar) on an
//! iRobot Create 2, which maps and drives.
#![no_std]
#![no_main]

#[path = "../../board/mod.rs"]
mod board;
#[cfg_attr(feature = "ld06", path = "lidar.rs")]
#[cfg_attr(all(feature = "vl53", not(feature = "ld06")), path = "zones.rs")]
mod configuration;
mod driving;
mod journal;
mod robot;
#[cfg_attr(feature = "motors", path = "motors.rs")]
#[cfg_attr(not(feature = "motors"), path = "create2.rs")]
mod wheels;

use board::Board;
use configuration::{BAUDS, BOUNDS, SLICE_LENGTH};
use cortex_m_rt::entry;
use driving::driving;
use ubimap_agent::{Memory, drive::Driving, memory};

#[entry]
fn main() -> ! {
    // Statics, not local variables, so that the image's size includes them.
    static mut MEMORY: memory!(BOUNDS, Driving) = Memory::EMPTY;
    static mut SLICE: [u16; SLICE_LENGTH] = [0; SLICE_LENGTH];

    match Board::take(BAUDS) {
        Some(board) => robot::run(board, driving(), MEMORY, SLICE),
        None => robot::reset(),
    }
}

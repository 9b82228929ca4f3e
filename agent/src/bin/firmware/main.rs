//! The firmware of a robot with an A010 depth camera on an iRobot Create 2, which maps and drives.
#![no_std]
#![no_main]

#[path = "../../board/mod.rs"]
mod board;
mod robot;

use board::Board;
use cortex_m_rt::entry;
use robot::{BAUDS, BOUNDS, SLICE_LENGTH};
use ubimap_agent::{
    Memory,
    drive::{Driving, Gaze, Motion},
    memory,
};

/// The radius of the robot, in millimetres.
const RADIUS: u16 = 180;

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

/// The drive of a robot that follows the server's paths.
fn driving() -> Driving {
    let motion = Motion { radius: RADIUS, top_speed: 450.0, ..Motion::default() };
    // Half the field of view, in radians.
    let gaze = Gaze { half_view: 0.61, reach: 2_500, radius: RADIUS };
    Driving { motion, looks_at_goal: Some(gaze), ..Driving::default() }
}

//! The wheels are two DC motors with encoders at the board, in the place of `create2.rs`. Change the
//! constants for another robot.

use ubimap_agent::{
    Machine,
    device::{
        DepthSensor,
        diff_drive::WheelBase,
        pwm_motors::{PwmMotors, SpeedGains},
    },
    drive::Drive,
};
use ubimap_protocol::time::{Duration, Instant};

use crate::board::{Board, LeftMotor, RightMotor};

/// Wheels of 43 mm on N20 gear motors of 1:50 with 7 periods, of 4 counts each, per turn of the motor, so
/// 96,491 nm per count; 110 mm apart, up to 300 mm/s, 800 mm/s^2.
const WHEELS: WheelBase = WheelBase::new(96_491, 110_000, 300, 800);

/// The driver of the wheels.
pub(crate) type Base = PwmMotors<LeftMotor, RightMotor>;

/// The wheels of a board; `None` if they were taken before.
pub(crate) fn base(board: &mut Board) -> Option<Base> {
    Some(PwmMotors::new(board.motors.take()?, WHEELS, SpeedGains::default()))
}

/// Time between two readings of the encoders.
const INTERVAL: Duration = Duration::from_millis(10);

/// Passes the encoders' counts to the robot when they are due.
pub(crate) fn count<D: Drive>(
    board: &mut Board,
    machine: &mut Machine<'_, impl DepthSensor, Base, D>,
    now: Instant,
) {
    if board.encoders.since.is_none_or(|since| now.since(since) >= INTERVAL) {
        board.encoders.since = Some(now);
        machine.counts(board.encoders.take(), now);
    }
}

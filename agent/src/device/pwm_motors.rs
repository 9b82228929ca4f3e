//! Two DC motors with encoders, on drivers such as the TB6612: two direction pins and a PWM input per
//! motor.
//!
//! | first pin | second pin | PWM | motor |
//! |---|---|---|---|
//! | high | low | duty cycle | turns forward |
//! | low | high | duty cycle | turns backward |
//! | high | high | 0 | brakes |
//!
//! The speed of each wheel is controlled by its encoder: the power is the wanted speed as a part of the
//! top speed, plus a part proportional to the error, plus the sum of errors.

use embedded_hal::{digital::OutputPin, pwm::SetDutyCycle};
use ubimap_protocol::time::{Duration, Instant};

use super::{
    diff_drive::{DiffDrive, WheelBase, WheelSpeeds},
    wheels::{WheelCounters, WheelReport, Wheels},
};
use crate::drive::{DriveCommand, StopReason};

/// Full power, in per mille.
const FULL: i32 = 1_000;

/// Time without counts after which the robot must stop.
const SILENCE: Duration = Duration::from_millis(200);

/// Minimum time over which a speed is measured: shorter, and single counts are coarse.
const MEASURED: Duration = Duration::from_millis(15);

/// Time for which a motor has full power without a count before it counts as blocked.
const BLOCKED: Duration = Duration::from_millis(700);

/// A motor behind a driver with two direction pins and a PWM input.
#[derive(Debug)]
pub struct Motor<P, A, B> {
    pwm: P,
    first: A,
    second: B,
}

impl<P: SetDutyCycle, A: OutputPin, B: OutputPin> Motor<P, A, B> {
    /// A motor that turns forward when `first` is high and `second` low. Exchange them for a motor
    /// that is mounted the other way round.
    pub fn new(pwm: P, first: A, second: B) -> Self {
        Self { pwm, first, second }
    }
}

/// A motor that takes a power.
pub trait PoweredMotor {
    /// Sets the power in per mille of the full power, negative for backward; 0 brakes. Returns
    /// whether the hardware accepted it.
    #[must_use]
    fn set_power(&mut self, power: i16) -> bool;
}

impl<P: SetDutyCycle, A: OutputPin, B: OutputPin> PoweredMotor for Motor<P, A, B> {
    fn set_power(&mut self, power: i16) -> bool {
        let duty =
            u32::from(self.pwm.max_duty_cycle()) * u32::from(power.unsigned_abs().min(1_000));
        let duty = (duty / 1_000) as u16;
        // The duty cycle is 0 while the direction changes.
        let is_off = self.pwm.set_duty_cycle_fully_off().is_ok();
        let pins = self.first.set_state((power >= 0).into()).is_ok()
            & self.second.set_state((power <= 0).into()).is_ok();
        let is_on = power == 0 || pins && self.pwm.set_duty_cycle(duty).is_ok();
        is_off && pins && is_on
    }
}

/// The gains of the speed control, alike for both wheels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SpeedGains {
    /// Power in per mille for an error of 1 m/s.
    pub proportional: u16,
    /// Power in per mille that an error of 1 m/s adds per second.
    pub integral: u16,
}

impl Default for SpeedGains {
    /// For small gear motors, whose speed settles within some 50 ms.
    fn default() -> Self {
        Self { proportional: 1_000, integral: 4_000 }
    }
}

/// The control of one wheel.
#[derive(Clone, Copy, Debug, Default)]
struct Wheel {
    /// Counts since the speed was measured.
    counts: i32,
    /// The measured speed in mm/s.
    speed: i32,
    /// The sum of errors, as a power in millionths.
    sum: i32,
    /// Since when the wheel has had full power and has not moved.
    blocked: Option<Instant>,
}

/// Two motors with encoders. The caller counts the encoders' edges and passes the counts to
/// [`Machine::counts`](crate::Machine::counts) at 50 to 100 Hz; nothing is sent or received by bytes.
///
/// Tested with simulated motors behind mocks of `embedded-hal`; never tried on a board.
///
/// A board of one's own, with a lidar at a serial port:
///
/// ```
/// use core::{convert::Infallible, mem::take};
/// use embedded_hal::{
///     digital::{self, OutputPin},
///     pwm::{self, SetDutyCycle},
/// };
/// use ubimap_agent::{
///     Bounds, Config, Machine, Memory, Port,
///     device::{
///         Wheels,
///         diff_drive::WheelBase,
///         ld06::Ld06,
///         pwm_motors::{Motor, PwmMotors, SpeedGains},
///     },
///     memory,
/// };
/// use ubimap_protocol::{frame::DEFAULT_FRAME, time::Instant, units::RobotId};
///
/// // A pin and a PWM channel: those of the chip's HAL.
/// struct Pin(bool);
/// struct Pwm(u16);
///
/// impl digital::ErrorType for Pin {
///     type Error = Infallible;
/// }
/// impl OutputPin for Pin {
///     fn set_low(&mut self) -> Result<(), Infallible> {
///         self.0 = false;
///         Ok(())
///     }
///     fn set_high(&mut self) -> Result<(), Infallible> {
///         self.0 = true;
///         Ok(())
///     }
/// }
/// impl pwm::ErrorType for Pwm {
///     type Error = Infallible;
/// }
/// impl SetDutyCycle for Pwm {
///     fn max_duty_cycle(&self) -> u16 {
///         1_000
///     }
///     fn set_duty_cycle(&mut self, duty: u16) -> Result<(), Infallible> {
///         self.0 = duty;
///         Ok(())
///     }
/// }
///
/// type Motors = PwmMotors<Motor<Pwm, Pin, Pin>, Motor<Pwm, Pin, Pin>>;
///
/// // What the board's interrupts fill and empty.
/// #[derive(Default)]
/// struct Board {
///     now: Instant,
///     from_server: Vec<u8>,
///     to_server: Vec<u8>,
///     from_lidar: Vec<u8>,
///     counts: [i32; 2],
/// }
///
/// // One turn of the main loop: what has come in, the time, what goes out.
/// fn turn(board: &mut Board, machine: &mut Machine<'_, Ld06<'_>, Motors>) {
///     machine.receive(Port::Server, &take(&mut board.from_server), board.now);
///     machine.receive(Port::Sensor, &take(&mut board.from_lidar), board.now);
///     machine.counts(take(&mut board.counts), board.now); // every 10 to 20 ms
///     machine.timeout(board.now);
///     let mut bytes = [0; DEFAULT_FRAME];
///     while let Some(count @ 1..) = machine.poll_transmit(Port::Server, board.now, &mut bytes) {
///         board.to_server.extend(&bytes[..count]);
///     }
///     // Now sleep until `machine.poll_timeout()`, a byte, or the next counts.
/// }
///
/// const WHEELS: WheelBase = WheelBase::new(96_491, 110_000, 300, 800);
/// const BOUNDS: Bounds = Bounds { readings: 360, ..Bounds::SMALL };
///
/// let motor = || Motor::new(Pwm(0), Pin(false), Pin(false));
/// let wheels = PwmMotors::new((motor(), motor()), WHEELS, SpeedGains::default());
/// let mut memory: Box<memory!(BOUNDS)> = Box::new(Memory::EMPTY);
/// let mut turn_of_lidar = [0; BOUNDS.readings];
/// let config = Config::new(RobotId(7), Ld06::sensor(BOUNDS.readings), BOUNDS);
/// let mut machine =
///     Machine::new(config, &mut memory, Ld06::new(&mut turn_of_lidar), wheels)?;
///
/// let mut board = Board { counts: [12, 11], ..Board::default() };
/// turn(&mut board, &mut machine);
/// assert_eq!(machine.wheels().counters().frames, 1);
/// assert!(!board.to_server.is_empty(), "it says Hello");
/// # Ok::<(), Box<dyn core::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct PwmMotors<L, R> {
    motors: (L, R),
    base: WheelBase,
    gains: SpeedGains,
    odometry: DiffDrive,
    speeds: WheelSpeeds,
    command: DriveCommand,
    wheels: [Wheel; 2],
    /// When counts last came, and when the speeds were last measured.
    heard: Option<Instant>,
    measured: Instant,
    /// Whether the hardware accepted the last powers.
    is_sound: bool,
    counters: WheelCounters,
}

impl<L: PoweredMotor, R: PoweredMotor> PwmMotors<L, R> {
    /// Braked motors, the left and the right one.
    pub fn new(motors: (L, R), base: WheelBase, gains: SpeedGains) -> Self {
        let mut driver = Self {
            motors,
            base,
            gains,
            odometry: DiffDrive::new(base),
            speeds: WheelSpeeds::new(base),
            command: DriveCommand::STAND,
            wheels: [Wheel::default(); 2],
            heard: None,
            measured: Instant(0),
            is_sound: true,
            counters: WheelCounters::default(),
        };
        driver.set_powers([0, 0]);
        driver
    }

    /// Processes the counts of the left and the right encoder since the last call.
    pub(crate) fn count(&mut self, counts: [i32; 2], now: Instant) -> WheelReport {
        if self.heard.is_none() || self.is_silent(now) {
            self.counters.restarts =
                self.counters.restarts.wrapping_add(self.heard.is_some().into());
            self.measured = now;
        }
        self.heard = Some(now);
        self.counters.frames = self.counters.frames.wrapping_add(1);
        self.odometry.advance(counts);
        for (wheel, count) in self.wheels.iter_mut().zip(counts) {
            wheel.counts = wheel.counts.saturating_add(count);
        }
        let elapsed = now.since(self.measured);
        if elapsed >= MEASURED {
            self.measured = now;
            self.control(elapsed, now);
        }
        let is_blocked = |wheel: &Wheel| wheel.blocked.is_some_and(|at| now.since(at) >= BLOCKED);
        let is_faulty = !self.is_sound || self.wheels.iter().any(is_blocked);
        let stop = is_faulty.then_some(StopReason::WheelsFaulty);
        WheelReport { moment: now, pose: self.odometry.pose(), stop }
    }

    /// Measures the speeds over the last `elapsed`, and sets the powers.
    fn control(&mut self, elapsed: Duration, now: Instant) {
        let millis = (elapsed.micros() / 1_000).clamp(1, 100) as i32;
        let wanted = self.speeds.follow(self.command, millis as u32);
        let top = i32::from(self.base.top_speed()).max(1);
        let mut powers = [0; 2];
        for ((wheel, wanted), power) in self.wheels.iter_mut().zip(wanted).zip(&mut powers) {
            let way = self.base.way_um(core::mem::take(&mut wheel.counts));
            wheel.speed = way / millis;
            if wanted == 0 {
                (wheel.sum, wheel.blocked) = (0, None);
                continue;
            }
            let wanted = i32::from(wanted);
            let error = (wanted - wheel.speed).clamp(-5_000, 5_000);
            let ahead = wanted * FULL / top + error * i32::from(self.gains.proportional) / 1_000;
            // The sum holds still while more power is not to be had.
            let change = error.saturating_mul(i32::from(self.gains.integral)) / 1_000;
            let sum = wheel.sum.saturating_add(change.saturating_mul(millis));
            let sum = sum.clamp(-FULL * 1_000, FULL * 1_000);
            if (ahead + sum / 1_000).abs() <= FULL || sum.abs() < wheel.sum.abs() {
                wheel.sum = sum;
            }
            *power = (ahead + wheel.sum / 1_000).clamp(-FULL, FULL) as i16;
            let is_stuck = power.unsigned_abs() >= 900 && way == 0;
            wheel.blocked = is_stuck.then(|| wheel.blocked.unwrap_or(now));
        }
        self.set_powers(powers);
    }

    fn set_powers(&mut self, [left, right]: [i16; 2]) {
        self.is_sound = self.motors.0.set_power(left) & self.motors.1.set_power(right);
    }
}

impl<L: PoweredMotor, R: PoweredMotor> Wheels for PwmMotors<L, R> {
    /// There are no bytes.
    fn receive(&mut self, bytes: &mut &[u8], _: Instant) -> Option<WheelReport> {
        *bytes = &[];
        None
    }

    fn drive(&mut self, command: DriveCommand, now: Instant) {
        self.command = command;
        // A stop does not wait for the next counts, and motors without counts have no power.
        if command == DriveCommand::STAND || self.is_silent(now) {
            self.speeds.follow(DriveCommand::STAND, 0);
            self.set_powers([0, 0]);
        }
    }

    fn poll_transmit(&mut self, _: Instant, _: &mut [u8]) -> Option<usize> {
        None
    }

    fn poll_timeout(&self) -> Instant {
        self.heard.map_or(Instant(u64::MAX), |heard| heard + SILENCE)
    }

    fn is_silent(&self, now: Instant) -> bool {
        self.heard.is_some_and(|heard| now.since(heard) >= SILENCE)
    }

    fn counters(&self) -> WheelCounters {
        self.counters
    }
}

#[cfg(test)]
mod tests;

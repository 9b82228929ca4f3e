//! The motors behind mocks of `embedded-hal`: a simulated gear motor with inertia and friction.

use core::convert::Infallible;
use std::{cell::Cell, rc::Rc, vec, vec::Vec};

use embedded_hal::{digital, pwm};
use ubimap_protocol::units::{Angle, Pose};

use super::*;

/// Wheels with 0.2 mm per count, 120 mm apart, up to 400 mm/s.
const BASE: WheelBase = WheelBase::new(200_000, 120_000, 400, 1_000);

/// The pins and the duty cycle of one motor.
#[derive(Debug, Default)]
struct Lines {
    first: Cell<bool>,
    second: Cell<bool>,
    duty: Cell<u16>,
    is_broken: Cell<bool>,
}

struct Pin(Rc<Lines>, bool);

impl digital::ErrorType for Pin {
    type Error = Infallible;
}

impl OutputPin for Pin {
    fn set_low(&mut self) -> Result<(), Infallible> {
        self.set(false)
    }

    fn set_high(&mut self) -> Result<(), Infallible> {
        self.set(true)
    }
}

impl Pin {
    fn set(&self, level: bool) -> Result<(), Infallible> {
        assert_eq!(self.0.duty.get(), 0, "the direction changes under power");
        if self.1 {
            self.0.first.set(level)
        } else {
            self.0.second.set(level)
        }
        Ok(())
    }
}

struct Pwm(Rc<Lines>);

#[derive(Debug)]
struct Broken;

impl pwm::Error for Broken {
    fn kind(&self) -> pwm::ErrorKind {
        pwm::ErrorKind::Other
    }
}

impl pwm::ErrorType for Pwm {
    type Error = Broken;
}

impl SetDutyCycle for Pwm {
    fn max_duty_cycle(&self) -> u16 {
        2_100
    }

    fn set_duty_cycle(&mut self, duty: u16) -> Result<(), Broken> {
        assert!(duty <= 2_100, "{duty}");
        self.0.duty.set(duty);
        if self.0.is_broken.get() { Err(Broken) } else { Ok(()) }
    }
}

type MockMotor = Motor<Pwm, Pin, Pin>;

/// A base on a bench: two motors, and the wheels that they turn.
struct Bench {
    driver: PwmMotors<MockMotor, MockMotor>,
    lines: [Rc<Lines>; 2],
    /// Speeds of the wheels in mm/s, and the ways in mm.
    speeds: [f64; 2],
    ways: [f64; 2],
    /// The base in `odom`: x, y in mm, and the heading in radians.
    pose: [f64; 3],
    counted: [i32; 2],
    /// Factors of the motors' strength: no two are alike.
    strength: [f64; 2],
    is_held: bool,
    micros: u64,
}

impl Bench {
    fn new() -> Self {
        let lines = [Rc::<Lines>::default(), Rc::default()];
        let [left, right] = lines
            .each_ref()
            .map(|it| Motor::new(Pwm(it.clone()), Pin(it.clone(), true), Pin(it.clone(), false)));
        let driver = PwmMotors::new((left, right), BASE, SpeedGains::default());
        Self {
            driver,
            lines,
            speeds: [0.0; 2],
            ways: [0.0; 2],
            pose: [0.0; 3],
            counted: [0; 2],
            strength: [1.15, 0.85],
            is_held: false,
            micros: 1_000_000,
        }
    }

    fn now(&self) -> Instant {
        Instant(self.micros)
    }

    /// The power of a motor by its pins: 1 is full power forward; `None` when it brakes.
    fn power(&self, motor: usize) -> Option<f64> {
        let lines = &self.lines[motor];
        let duty = f64::from(lines.duty.get()) / 2_100.0;
        match (lines.first.get(), lines.second.get()) {
            (true, false) => Some(duty),
            (false, true) => Some(-duty),
            (true, true) => {
                assert_eq!(duty, 0.0);
                None
            }
            (false, false) => panic!("the motor coasts"),
        }
    }

    /// Turns the wheels for `millis`, and passes the counts every 10 ms. Returns the last report.
    fn run(&mut self, millis: u64) -> Option<WheelReport> {
        let mut last = None;
        for _ in 0..millis {
            self.micros += 1_000;
            for motor in 0..2 {
                let power = self.power(motor);
                let speed = &mut self.speeds[motor];
                // The motor settles in 50 ms; friction takes 30 mm/s; a brake acts in 10 ms.
                let (target, time) = match power {
                    None => (0.0, 10.0),
                    Some(power) => {
                        let driven = power * 480.0 * self.strength[motor];
                        (driven.signum() * (driven.abs() - 30.0).max(0.0), 50.0)
                    }
                };
                *speed += (target - *speed) / time;
                if self.is_held {
                    *speed = 0.0;
                }
                self.ways[motor] += *speed / 1_000.0;
            }
            let [left, right] = self.speeds.map(|speed| speed / 1_000.0);
            let [x, y, heading] = self.pose;
            let (way, turned) = ((left + right) / 2.0, (right - left) / 120.0);
            self.pose = [x + way * heading.cos(), y + way * heading.sin(), heading + turned];
            if self.micros.is_multiple_of(10_000) {
                let counted = self.ways.map(|way| (way / 0.2).floor() as i32);
                let counts = [0, 1].map(|motor| counted[motor] - self.counted[motor]);
                self.counted = counted;
                last = Some(self.driver.count(counts, self.now()));
            }
        }
        last
    }

    fn drive(&mut self, speed: i16, turn: i16) {
        let now = self.now();
        self.driver.drive(DriveCommand { speed, turn }, now);
    }
}

#[test]
fn unequal_motors_reach_the_commanded_speeds() {
    for (speed, turn, wanted) in [
        (200, 0, [200.0, 200.0]),
        (-150, 0, [-150.0, -150.0]),
        (0, 2_000, [-120.0, 120.0]),
        (200, 1_000, [140.0, 260.0]),
        // The faster wheel has a limit; the curvature stays.
        (400, 2_000, [215.0, 400.0]),
    ] {
        let mut bench = Bench::new();
        bench.drive(speed, turn);
        bench.run(1_500);
        for (speed, wanted) in bench.speeds.into_iter().zip(wanted) {
            // The weaker motor's top speed is 378 mm/s.
            let wanted = f64::min(wanted, 378.0);
            assert!((speed - wanted).abs() < 15.0, "{:?}, not {wanted}", bench.speeds);
        }
    }
}

#[test]
fn acceleration_is_limited_and_a_stop_is_not() {
    let mut bench = Bench::new();
    bench.drive(300, 0);
    bench.run(100);
    assert!(bench.speeds.iter().all(|&speed| speed < 150.0), "{:?}", bench.speeds);
    bench.run(900);
    assert!(bench.speeds.iter().all(|&speed| speed > 280.0), "{:?}", bench.speeds);
    bench.drive(0, 0);
    assert_eq!([0, 1].map(|motor| bench.power(motor)), [None, None], "both brake at once");
    bench.run(60);
    assert!(bench.speeds.iter().all(|&speed| speed < 5.0), "{:?}", bench.speeds);
}

#[test]
fn odometry_is_the_way_of_the_wheels() {
    let mut bench = Bench::new();
    bench.drive(200, 0);
    bench.run(2_000);
    bench.drive(0, 0);
    let report = bench.run(200).unwrap();
    let ([x, y, heading], Pose { x: seen_x, y: seen_y, heading: seen }) = (bench.pose, report.pose);
    assert!((f64::from(seen_x.0) - x).hypot(f64::from(seen_y.0) - y) < 3.0, "{report:?}, {x}, {y}");
    assert!(seen.distance(Angle::from_radians(heading)) < 40, "{report:?}, {heading}");
    assert!(x > 300.0 && heading.abs() < 0.3 && report.stop.is_none(), "{report:?}");
}

#[test]
fn motors_without_counts_have_no_power() {
    let mut bench = Bench::new();
    bench.drive(200, 0);
    bench.run(500);
    bench.micros += 199_000;
    bench.drive(200, 0);
    assert!(bench.power(0).is_some() && !bench.driver.is_silent(bench.now()));
    assert!(bench.driver.poll_timeout() <= bench.now() + Duration::from_millis(1));
    bench.micros += 1_000;
    bench.drive(200, 0);
    assert!(bench.driver.is_silent(bench.now()));
    assert_eq!([0, 1].map(|motor| bench.power(motor)), [None, None]);
}

#[test]
fn a_blocked_wheel_stops_the_robot() {
    let mut bench = Bench::new();
    bench.drive(200, 0);
    bench.run(500);
    bench.is_held = true;
    assert_eq!(bench.run(400).unwrap().stop, None);
    assert_eq!(bench.run(1_500).unwrap().stop, Some(StopReason::WheelsFaulty));
    // The machine then stops, and the wheels are tried again.
    bench.is_held = false;
    bench.drive(0, 0);
    assert_eq!(bench.run(100).unwrap().stop, None);
    bench.drive(200, 0);
    assert_eq!(bench.run(1_000).unwrap().stop, None);
}

#[test]
fn hardware_that_refuses_stops_the_robot() {
    let mut bench = Bench::new();
    bench.drive(200, 0);
    bench.run(200);
    bench.lines[1].is_broken.set(true);
    assert_eq!(bench.run(50).unwrap().stop, Some(StopReason::WheelsFaulty));
}

/// Counts and commands of any size: no panic, and no power above the full one (the mock checks).
#[test]
fn any_counts_are_taken() {
    let mut bench = Bench::new();
    let extremes: Vec<i32> = vec![0, 1, -1, i32::MAX, i32::MIN, 70_000, -70_000];
    for (index, &left) in extremes.iter().enumerate() {
        for &right in &extremes {
            bench.micros += [1, 14_999, 15_000, 1 << 40][index % 4];
            bench.drive(i16::MIN, i16::MAX);
            bench.driver.count([left, right], bench.now());
        }
    }
    assert_eq!(bench.driver.counters().frames, 49);
}

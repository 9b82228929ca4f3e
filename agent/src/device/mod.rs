//! Devices on a robot's ports, as parsers of bytes without input or output.
//!
//! | file | device |
//! |---|---|
//! | [`a010`] | the depth camera Sipeed MaixSense A010 |
//! | [`ld06`] | the lidar LDROBOT LD06 |
//! | [`zones`] | frames of 8 x 8 distances, of ST's VL53L5CX and VL53L8CX |
//! | [`create2`] | the mobile base iRobot Create 2 |
//! | [`pwm_motors`] | two DC motors with encoders, on drivers with direction pins and PWM |
//! | [`quadrature`] | an encoder with two signals |
//! | [`diff_drive`] | the geometry of two driven wheels |
//!
//! A [`DepthSensor`] makes scans of bytes, [`Wheels`] make odometry of bytes and bytes of commands. A
//! [`Machine`](crate::Machine) joins them with a [`Robot`](crate::Robot). None of these drivers was
//! ever tried on a board: they were written by the manufacturers' documents.

pub mod a010;
mod cadence;
pub mod create2;
mod depth_sensor;
pub mod diff_drive;
pub mod ld06;
pub mod pwm_motors;
pub mod quadrature;
mod wheels;
pub mod zones;

pub use depth_sensor::{DepthSensor, Scan, SensorCounters};
pub use wheels::{WheelCounters, WheelReport, Wheels};

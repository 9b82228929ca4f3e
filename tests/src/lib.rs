//! Shared parts of the end-to-end tests.

pub mod boxes;
pub mod conformance;
pub mod data;
pub mod deployments;
pub mod device_fuzz;
pub mod disk;
pub mod elf;
pub mod emulator;
pub mod faulty_line;
pub mod floor_view;
pub mod fuzz;
pub mod lossy_network;
pub mod per_ray;
pub mod plain_map;
pub mod plain_moved;
pub mod port_fuzz;
pub mod raw_robot;
pub mod routes;
pub mod schedule;
pub mod script;
pub mod seeds;
pub mod star;
pub mod stream_relay;
pub mod updates;
pub mod vectors;
pub mod wheel_commands;

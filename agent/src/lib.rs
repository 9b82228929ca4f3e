//! What runs on a ubimap robot.
#![no_std]

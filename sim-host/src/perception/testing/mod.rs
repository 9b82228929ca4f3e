//! Synthetic depth images for the tests of this folder.

use crate::camera::{DepthImage, DepthNoise, Intrinsics, Lens};

mod boxes;

pub(crate) use boxes::{Cuboid, lens, noisy, render};

//! What the tests of this folder need.

use crate::camera::{DepthImage, Intrinsics, Lens};

mod boxes;

pub(crate) use boxes::{Cuboid, lens, noisy, render};

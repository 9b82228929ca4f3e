//! The poses of the cameras: section 5 of UbiSLAM, "Cameras on the same plane".
//!
//! Cameras with overlapping views see common landmarks. The transforms between pairs of cameras
//! form a graph, along which the poses are propagated from a reference camera; then all poses
//! together are optimised. Nothing here owns a clock, a thread or a file, and all randomness is
//! seeded.
//!
//! Files in the order in which data passes through them:
//!
//! 1. [`point_noise`] and [`observations`] (the paper's `P_i`): what the cameras have seen, in their
//!    optical frames; [`observations_file`]: the same as TOML; [`landmark_finder`]: the same from
//!    frames, in which robots' markers are `moving_landmarks`.
//! 2. `tie` (a landmark that two cameras see), [`closed_form`], `consensus` (leaves wrong
//!    labels out), `icp` and `congruence` (landmarks without labels), [`pairing`]; [`pairwise`]:
//!    `T_ij`.
//! 3. [`graph`]: propagation to `R0`, `T_0k = T_0i T_ij T_jk`; `frame`: `R0` from the floor.
//! 4. `sharing`, `levenberg_marquardt` and [`refine`]: the minimum of
//!    `C = sum |T_ij p_i - p_j|^2`.
//! 5. [`calibrating`]: from observations to poses with their covariances.

pub mod calibrating;
pub mod closed_form;
mod congruence;
mod consensus;
mod frame;
pub mod graph;
mod icp;
pub mod landmark_finder;
mod levenberg_marquardt;
mod moving_landmarks;
pub mod observations;
pub mod observations_file;
pub mod pairing;
pub mod pairwise;
pub mod point_noise;
pub mod refine;
mod sharing;
mod tie;

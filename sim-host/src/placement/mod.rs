//! Where to hang cameras: section 4 of UbiSLAM, "Camera placement optimization".
//!
//! The room's floor is divided into square cells. Candidate cameras hang at a grid of places and look
//! in several directions; an integer programme chooses among them. Nothing here owns a clock or
//! a thread, and all randomness is seeded.
//!
//! Files in the order in which data passes through them:
//!
//! 1. [`floor_plan`] (the paper's `S`) and [`obstacle`]: the floor, and what hides it.
//! 2. [`camera`]: `alpha`, `beta`, `h`, `theta`, and what a camera sees of an empty floor; `sight`:
//!    the part of it that walls and furniture do not hide; [`candidates`] (the paper's `C`); [`coverage`]: the
//!    paper's `f`.
//! 3. [`programme`] on [`incidence`]: the integer programme and its constraints `m` and `k`.
//! 4. [`reduction`]: smaller programmes with the same optimum, or with an optimum that bounds it.
//! 5. `selection` (a placement that changes; `index_set`), `greedy`, `weighting` and `annealing`:
//!    placements.
//! 6. `relaxation` and `branching`: bounds on all placements, and proofs.
//! 7. [`solver`]: runs all of these in turn; [`milp`]: hands the programme to other solvers.
//! 8. [`connection`]: whether the cameras overlap so that they can be calibrated.
//! 9. [`placing`]: from a room and a request to a placement.

mod annealing;
mod branching;
pub mod camera;
pub mod candidates;
pub mod connection;
pub mod coverage;
pub mod floor_plan;
mod greedy;
pub mod incidence;
mod index_set;
pub mod milp;
pub mod obstacle;
pub mod placing;
pub mod programme;
pub mod reduction;
mod relaxation;
mod selection;
mod sight;
pub mod solver;
mod weighting;

#[cfg(test)]
mod tests;

//! The simulated room.

//! Whether a fixed camera still is where it was calibrated.
//!
//! A [`View`] is what a camera sees of the room that does not move, as planes. Aligning a depth image
//! with it gives the [`Motion`] of the camera since the view was learnt, with the information on each
//! direction: a floor tells height, tilt and roll; walls and furniture tell the rest. A [`Witness`] adds what
//! other cameras know: where a robot is whose marker the camera sees. A [`Steadiness`]
//! decides from the motions of some seconds: a camera that was knocked is out of use until its new pose
//! is known, and one that drifts is followed.

mod body;
mod motion;
mod standing;
#[cfg(test)]
mod tests;
mod view;
mod witness;

pub use body::Body;
pub use motion::Motion;
pub use standing::{Change, Standing, Steadiness};
pub use view::View;
pub use witness::Witness;

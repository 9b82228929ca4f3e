//! Port handles.

/// A port of a deployment. Handles are not reused.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct PortId(pub(super) usize);

impl PortId {
    /// The port's number, as in [`server::Event::Joined`](crate::server::Event::Joined).
    pub fn number(self) -> usize {
        self.0
    }
}

/// The port was closed, or belongs to another deployment.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("port {} is not open", .0.0)]
pub struct PortClosed(pub PortId);

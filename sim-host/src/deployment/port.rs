//! The handles of ports.

/// A port of a deployment. It is never used again for another one.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct PortId(pub(super) usize);

impl PortId {
    /// Its number, by which [`server::Event::Joined`](crate::server::Event::Joined) names it.
    pub fn number(self) -> usize {
        self.0
    }
}

/// A port that was closed, or is another deployment's.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("port {} is not open", .0.0)]
pub struct PortClosed(pub PortId);

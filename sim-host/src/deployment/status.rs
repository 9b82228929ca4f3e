//! How a deployment fares.

use std::collections::BTreeMap;

use ubimap_protocol::{link::Counters, message::State, units::RobotId};

use super::port::PortId;
use crate::camera::Observation;

/// How a deployment fares.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Status {
    /// The cameras that anything has come from, by their numbers.
    pub cameras: BTreeMap<usize, CameraStatus>,
    /// The open ports, in the order in which they were opened.
    pub ports: Vec<PortStatus>,
}

/// How a camera fares.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CameraStatus {
    /// Frames and observations of it.
    pub observations: u64,
    /// Those that said of cells what is there.
    pub looks: u64,
}

impl CameraStatus {
    pub(super) fn add(&mut self, observation: &Observation) {
        self.observations += 1;
        self.looks += u64::from(!observation.cells.is_empty());
    }
}

/// How a port fares.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PortStatus {
    /// Which port.
    pub port: PortId,
    /// The robot that has its session there.
    pub robot: Option<RobotId>,
    /// What the robot last said of itself. Its times are by the server's clock.
    pub state: Option<State>,
    /// What the link has counted.
    pub link: Counters,
    /// Bytes sent, framing and retransmissions included.
    pub bytes_sent: u64,
}

//! State and counters of cameras and ports.

use std::collections::BTreeMap;

use crc32fast::Hasher;
use ubimap_protocol::{link::Counters, message::State, units::RobotId};

use super::port::PortId;
use crate::{
    camera::{Observation, Sighting},
    server::MessageCounters,
};

/// State and counters of a deployment.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Status {
    /// The cameras that have delivered a frame or observation, by number.
    pub cameras: BTreeMap<usize, CameraStatus>,
    /// The open ports in the order of opening.
    pub ports: Vec<PortStatus>,
}

/// Counters of a camera.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CameraStatus {
    /// Frames and observations received.
    pub observations: u64,
    /// Number of frames and observations that reported the state of cells.
    pub looks: u64,
    /// Digest of what was observed, in order: capture times, robots and cells. Cameras with the same digest have
    /// contributed the same.
    pub digest: u32,
}

impl CameraStatus {
    /// Adds an observation whose times are by the caller's clock.
    pub(super) fn add(&mut self, observation: &Observation) {
        self.observations += 1;
        self.looks += u64::from(!observation.cells.is_empty());
        let mut bytes = observation.captured.micros().to_le_bytes().to_vec();
        for Sighting { robot, pose, certainty } in &observation.robots {
            bytes.extend(robot.0.to_le_bytes());
            bytes.extend([pose.x, pose.y].iter().flat_map(|it| it.0.to_le_bytes()));
            bytes.extend(pose.heading.0.to_le_bytes());
            let certainty = [certainty.x, certainty.y, certainty.heading];
            bytes.extend(certainty.iter().flat_map(|it| it.to_le_bytes()));
        }
        for ((x, y), cell) in &observation.cells {
            bytes.extend([x, y].iter().flat_map(|it| it.to_le_bytes()));
            bytes.push(cell.code());
        }
        let mut digest = Hasher::new_with_initial(self.digest);
        digest.update(&bytes);
        self.digest = digest.finalize();
    }
}

/// State and counters of a port.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PortStatus {
    /// The port's handle.
    pub port: PortId,
    /// The robot that has a session there.
    pub robot: Option<RobotId>,
    /// The robot's last state report. Its times are by the server's clock.
    pub state: Option<State>,
    /// Counters of the link.
    pub link: Counters,
    /// Counters of the messages that had no effect.
    pub messages: MessageCounters,
    /// Bytes sent, including framing and retransmissions.
    pub bytes_sent: u64,
}

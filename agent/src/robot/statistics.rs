//! What a robot has counted.

use crate::map::PixelCounts;

/// What a robot has counted since it booted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Statistics {
    /// Scans taken in.
    pub scans: u32,
    /// Scans that went into the map.
    pub mapped: u32,
    /// Scans that the gate held back.
    pub gated: u32,
    /// Scans that were not mapped because the robot shook.
    pub shaken: u32,
    /// Scans whose pose never came.
    pub expired: u32,
    /// Scans whose pose was less sure than is allowed.
    pub unsure: u32,
    /// Scans that found as many waiting as there is room for.
    pub overflowed: u32,
    /// The readings of the scans that were mapped.
    pub pixels: PixelCounts,
    /// Cells that found no room in the pool.
    pub cells_refused: u32,
    /// Pose fixes received, each once.
    pub fixes: u32,
    /// Those of them that were too far off, and were left out.
    pub fixes_rejected: u32,
    /// Those that were believed in the end, after others that agreed had been rejected: the robot
    /// was carried off.
    pub moves: u32,
    /// Pose fixes older than what is remembered, of a moment to come, or of an unknown one.
    pub fixes_untimely: u32,
    /// Readings of the odometry older than the one before.
    pub odometry_backwards: u32,
    /// Bytes sent, framing and retransmissions included.
    pub bytes_sent: u64,
    /// Bytes of frames with tile updates among them.
    pub bytes_sent_map: u64,
    /// Messages of a kind that this version does not know.
    pub unknown_messages: u32,
    /// Messages that could not be read.
    pub malformed_messages: u32,
    /// Sessions begun.
    pub sessions: u32,
}

impl Statistics {
    /// A message could not be read.
    pub(super) fn malformed(&mut self) {
        self.malformed_messages = self.malformed_messages.wrapping_add(1);
    }

    /// A frame has been sent, with tile updates or without.
    pub(super) fn sent(&mut self, len: usize, has_tiles: bool) {
        self.bytes_sent = self.bytes_sent.wrapping_add(len as u64);
        if has_tiles {
            self.bytes_sent_map = self.bytes_sent_map.wrapping_add(len as u64);
        }
    }
}

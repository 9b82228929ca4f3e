//! A robot's counters.

use crate::map::PixelCounts;

/// A robot's counters since boot; they wrap at their maximum.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Statistics {
    /// Scans accepted.
    pub scans: u32,
    /// Scans mapped.
    pub mapped: u32,
    /// Scans skipped because the robot had neither moved enough nor seen a change.
    pub gated: u32,
    /// Scans not mapped because the robot was shaken.
    pub shaken: u32,
    /// Scans whose pose did not arrive in time.
    pub expired: u32,
    /// Scans whose pose exceeded the uncertainty limit.
    pub unsure: u32,
    /// Scans refused because the queue was full.
    pub overflowed: u32,
    /// The readings of the mapped scans.
    pub pixels: PixelCounts,
    /// Cells dropped because the tile pool was full.
    pub cells_refused: u32,
    /// Pose fixes received, without duplicates.
    pub fixes: u32,
    /// Pose fixes rejected as outliers.
    pub fixes_rejected: u32,
    /// Pose fixes accepted after several consistent ones had been rejected: the robot was carried.
    pub moves: u32,
    /// Pose fixes from the future, from a time that can't be converted, or older than the history.
    pub fixes_untimely: u32,
    /// Odometry readings older than their predecessor.
    pub odometry_backwards: u32,
    /// Bytes sent, framing and retransmissions included.
    pub bytes_sent: u64,
    /// Bytes of frames with tile updates, included in `bytes_sent`.
    pub bytes_sent_map: u64,
    /// Messages of an unknown kind.
    pub unknown_messages: u32,
    /// Malformed messages.
    pub malformed_messages: u32,
    /// Sessions opened.
    pub sessions: u32,
}

impl Statistics {
    /// Counts a malformed message.
    pub(super) fn malformed(&mut self) {
        self.malformed_messages = self.malformed_messages.wrapping_add(1);
    }

    /// Counts a sent frame, with tile updates or without.
    pub(super) fn sent(&mut self, len: usize, has_tiles: bool) {
        self.bytes_sent = self.bytes_sent.wrapping_add(len as u64);
        if has_tiles {
            self.bytes_sent_map = self.bytes_sent_map.wrapping_add(len as u64);
        }
    }
}

//! Which part of the sensor's data is mapped: the methods compared by the paper, and their
//! extension (Aluckal III.A).

/// The methods, from the one that maps everything to the one that maps least.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Policy {
    /// Maps every scan as a whole.
    Pilot,
    /// Maps a whole scan after each motion ("thresholding").
    Threshold,
    /// Like `Threshold`, without the readings that were in view before the robot turned ("selective
    /// omission", for rotations, as printed).
    Omission,
    /// The same by the letter of the paper's listing: after a turn to the right its start pixel lies
    /// beyond the last one, and nothing is mapped.
    OmissionAsPrinted,
    /// Maps a scan after each motion, or where the view has changed, without the readings that are
    /// redundant: implied by adjacent readings, by the robot's own map or by the server's. Handles
    /// any motion, which the paper leaves to future work.
    #[default]
    Full,
}

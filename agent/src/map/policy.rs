//! Which part of the sensor's data is mapped: the methods compared by the paper, and their
//! extension (Aluckal III.A).

/// From the simplest to the most economical.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Policy {
    /// Every scan, entirely.
    Pilot,
    /// A scan after each motion, entirely ("thresholding").
    Threshold,
    /// The same, without the readings already in view before the robot turned ("selective
    /// omission", for rotations, as printed).
    Omission,
    /// A scan after each motion, or where the view has changed; without readings that are redundant
    /// given the adjacent readings, the robot's own map, or the server's map. Works for any motion,
    /// the paper's future work.
    #[default]
    Full,
}

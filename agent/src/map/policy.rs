//! How much of what a sensor says is mapped: the methods that the paper compares, and what became
//! of them (Aluckal III.A).

/// From the simplest to the most thrifty.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Policy {
    /// Every scan, and all of it.
    Pilot,
    /// A scan when the robot has moved, and all of it ("thresholding").
    Threshold,
    /// The same, less what was in view before the robot turned ("selective omission", for
    /// rotation as printed).
    Omission,
    /// A scan when the robot has moved, or where something has changed in view; less every reading
    /// that could only say what is known already: by the readings beside it, by what was mapped
    /// before, by the server's map. That holds after any motion, as the paper's future work asks
    /// for.
    #[default]
    Full,
}

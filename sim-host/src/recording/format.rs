//! The formats of logs.

/// The formats that can be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// CARMEN text, `FLASER` records.
    Carmen,
    /// CoreSLAM's mine robot: 707 numbers a line.
    Mines,
    /// A folder of depth images, poses and intrinsics.
    Rgbd,
}

impl std::fmt::Display for Format {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Carmen => "carmen",
            Self::Mines => "mines",
            Self::Rgbd => "rgbd",
        })
    }
}

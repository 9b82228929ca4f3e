//! The pointset that a policy leaves (Aluckal III).

use std::fmt;

use serde::Serialize;

use crate::recording::ExposureCounts;

/// The pointset of all robots; only for simulations whose robots draw by range sensors.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct PointsSummary {
    /// Scans taken.
    pub scans: u64,
    /// Scans of which something was kept.
    pub mapped: u64,
    /// Points kept.
    pub kept: u64,
    /// Of these, points within a square of 2.5 cm that an earlier scan had already filled.
    pub redundant: u64,
    /// Roughness of walls: root mean square distance of the points within 10 cm of the surface that their
    /// rays meet, along the ray, in millimetres.
    pub rough_mm: f64,
    /// Points that lie more than 5 cm beyond the surface that their rays meet (the paper's dotted line).
    pub beyond: u64,
    /// The distance beyond it that 99 of 100 points keep, in millimetres.
    pub overshoot_mm: f64,
    /// Readings left out because of the exposure of their pixels.
    pub masked: u64,
}

/// The exposure of the pixels with a depth; only for recordings, if a rule was asked for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct ExposureSummary {
    /// Pixels with a depth.
    pub valid: u64,
    /// Of these, those left out because the picture is over- or underexposed there.
    pub masked: u64,
}

impl From<ExposureCounts> for ExposureSummary {
    fn from(ExposureCounts { valid, masked }: ExposureCounts) -> Self {
        Self { valid, masked }
    }
}

impl fmt::Display for ExposureSummary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "exposure: {} of {} depths left out", self.masked, self.valid)
    }
}

impl fmt::Display for PointsSummary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { scans, mapped, kept, redundant, rough_mm, beyond, overshoot_mm, masked } = self;
        writeln!(
            f,
            "points: {kept} kept of {mapped} of {scans} scans, {redundant} redundant; walls rough by {rough_mm:.1} mm; \
             {beyond} more than 5 cm beyond a surface, overshoot {overshoot_mm:.0} mm (99 %); {masked} masked"
        )
    }
}

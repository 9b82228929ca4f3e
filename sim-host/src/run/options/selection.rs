//! Which readings robots map (Aluckal et al.).

use clap::{Args, ValueEnum};
use ubimap_agent::map::{Gate, Policy};

/// Which readings robots map, after Aluckal et al.
#[derive(Args, Clone, Copy, Debug)]
#[command(next_help_heading = "Robots and map")]
pub struct SelectionOptions {
    /// Which readings are mapped: all; scans after a motion; without what was in view before a turn, also
    /// by the letter of the paper; without what is already known
    #[arg(long, value_name = "P", value_enum, default_value_t = PolicyName::Full)]
    pub policy: PolicyName,

    /// What counts as a motion of 3.5 cm
    #[arg(long, value_name = "G", value_enum, default_value_t)]
    pub gate: GateName,
}

impl SelectionOptions {
    /// Converts to a gate.
    pub fn gate(&self) -> Gate {
        Gate { by_axis: self.gate == GateName::ByAxis, ..Gate::default() }
    }
}

/// The names of the gates.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum GateName {
    /// In any direction
    #[default]
    Euclidean,
    /// Along x or along y, as printed
    ByAxis,
}

/// The names of the policies.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum PolicyName {
    /// All readings of all scans.
    Pilot,
    /// All readings of scans after a motion.
    Threshold,
    /// The same, without what was in view before the robot turned.
    Omission,
    /// The same, by the letter of the paper's listing.
    OmissionAsPrinted,
    /// The same, without what is already known.
    Full,
}

impl From<PolicyName> for Policy {
    fn from(name: PolicyName) -> Self {
        match name {
            PolicyName::Pilot => Self::Pilot,
            PolicyName::Threshold => Self::Threshold,
            PolicyName::Omission => Self::Omission,
            PolicyName::OmissionAsPrinted => Self::OmissionAsPrinted,
            PolicyName::Full => Self::Full,
        }
    }
}

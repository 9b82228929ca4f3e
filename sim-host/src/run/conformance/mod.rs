//! `ubimap conformance`: plays one side of the protocol against an implementation, in real time.

pub mod options;
mod wire_bench;

use std::time::{SystemTime, UNIX_EPOCH};

use self::{options::ConformanceOptions, wire_bench::WireBench};
use super::{RunError, keys};
use crate::{
    channel::{
        process,
        serial::SerialPort,
        udp::{UdpLink, UdpSocket},
        wire::{Wire, WireError},
    },
    conformance::{self, CheckResult, ConformanceReport, Keys, Role},
};

/// Runs the checks, and tells each result as it comes.
///
/// # Errors
/// [`RunError::Port`] if the wire can't be opened, [`RunError::NoCheck`] if a number names none.
pub fn run(
    options: &ConformanceOptions,
    tell: impl FnMut(&CheckResult),
) -> Result<ConformanceReport, RunError> {
    let role = options.role.into();
    let checks = conformance::checks(role).len();
    if let Some(&number) = options.only.iter().find(|&&number| number == 0 || number > checks) {
        return Err(RunError::NoCheck { number, checks });
    }
    let keys = keys(options)?;
    let mut bench = WireBench::new(open(options)?, options.slack);
    Ok(conformance::run(&mut bench, role, (&keys, &options.only), tell))
}

/// The keys of the link, with numbers that were never used with them: a random salt, and the time as
/// the boot.
fn keys(options: &ConformanceOptions) -> Result<Keys, RunError> {
    let Some(folder) = &options.keys else { return Ok(Keys::None) };
    let keys = keys::load(folder)?;
    let salt = getrandom::u64().map_err(RunError::Randomness)? >> 1;
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    Ok(Keys::Of { keys, salt, boot: since.as_secs() as u32 })
}

/// The list of checks for a role, a line for each.
pub fn list(role: Role) -> String {
    let checks = (1..).zip(conformance::checks(role));
    let lines = checks.map(|(number, check)| {
        format!("{number:>3} {:<30} SPEC {:<4} {}\n", check.name, check.section, check.rule)
    });
    lines.collect()
}

fn open(options: &ConformanceOptions) -> Result<Wire, WireError> {
    let wire = &options.wire;
    if let Some(path) = &wire.serial {
        return Ok(SerialPort::open(path, options.baud)?.into_wire());
    }
    match (&wire.exec, wire.udp) {
        (Some(command), _) => process::start(command),
        (None, Some(address)) if Role::from(options.role) == Role::Server => {
            Ok(UdpLink::open(address, None)?.into_wire())
        }
        (None, Some(address)) => Ok(UdpSocket::bind(address)?.into_wire()),
        (None, None) => Err(WireError::Open {
            name: "conformance".into(),
            reason: "give one of --serial, --udp and --exec".into(),
        }),
    }
}

//! `ubimap serve`: the camera server on serial ports and sockets, in real time.
//!
//! Drives a deployment by the wall clock. Without real cameras it serves robots on a bench: each stands
//! at a given pose, and gets fixes of it at a camera's rate.

mod attached;
mod bench_camera;
mod links;
mod station;

use std::path::Path;

use ubimap_protocol::tile::Epoch;

use super::{RunError, interruption, keeper, keys, options::ServeOptions};
use crate::{
    channel::{address::Address, serial::SerialPort},
    report::ServeReport,
};
pub use attached::{Attached, Opener};
pub use bench_camera::CAPTURE_INTERVAL;
pub use links::Door;
pub use station::Station;

/// Serves until the time is up or a signal interrupts. A port that hangs up is opened again when it
/// comes back, and a map that can't be stored is stored once that works again.
///
/// # Errors
/// [`RunError`] if a port or the store can't be opened.
pub fn run(options: &ServeOptions) -> Result<ServeReport, RunError> {
    // Before the ports, so that a key that can't be used opens none.
    let folder = options.keys.as_deref().or(options.sealed.then_some(Path::new("keys")));
    let keys = folder.map(keys::load).transpose()?;
    if let (Some(folder), Some([])) = (folder, keys.as_deref()) {
        log::warn!("{}: no robot has a key: ubimap keys make ROBOT", folder.display());
    }
    let (ports, doors) = open(options, keys.is_some())?;
    let resolution = options.resolution;
    let epoch = Epoch(random()?.max(1));
    let (keeper, mut life) = keeper::open(options.store.as_deref(), resolution, epoch)?;
    life.first_session = Some(random()?);
    life.salt = Some(u64::from(random()?) << 32 | u64::from(random()?));
    let mut station = Station::new(resolution, life, (ports, doors), keys, keeper)?;
    let end = options.duration.map(|duration| station.now() + duration);
    while !interruption::is_requested() && end.is_none_or(|end| station.now() < end) {
        station.turn();
    }
    let report = station.report();
    station.finish();
    Ok(report)
}

/// The ports that the server opens, and the sockets at which robots knock.
fn open(options: &ServeOptions, is_keyed: bool) -> Result<(Vec<Attached>, Vec<Door>), RunError> {
    let pose = |index: usize| match options.pose[..] {
        [] => None,
        [one] => Some(one),
        _ => options.pose.get(index).copied(),
    };
    let (poses, ports) = (options.pose.len(), options.ports.len());
    if poses > 1 && poses != ports {
        return Err(RunError::Poses { poses, ports });
    }
    let (mut attached, mut doors) = (Vec::new(), Vec::new());
    for (index, address) in options.ports.iter().enumerate() {
        let stands = pose(index);
        if let Address::Serial(path) = address {
            let (path, baud, name) = (path.clone(), options.baud, address.to_string());
            let opener: Opener = Box::new(move || Ok(SerialPort::open(&path, baud)?.into_wire()));
            attached.push(Attached::open(name, opener, stands)?);
        } else if !options.open && !is_keyed {
            return Err(RunError::Unsealed { address: address.to_string() });
        } else {
            if !is_keyed {
                log::warn!(
                    "{address} is open: whoever reaches it can pose as a robot and change the map"
                );
            }
            doors.extend(Door::open(address, stands)?);
        }
        log::info!("port {index} is {address}");
    }
    Ok((attached, doors))
}

/// A random number, so that no two lives of the server share an epoch and a session, whatever the clock
/// says.
fn random() -> Result<u32, RunError> {
    getrandom::u32().map_err(RunError::Randomness)
}

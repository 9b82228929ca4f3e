//! `ubimap serve`: the camera server on serial ports, in real time.
//!
//! Drives a deployment by the wall clock. Without real cameras it serves robots on a bench: each stands
//! at a given pose, and gets fixes of it at a camera's rate.

mod attached;
mod bench_camera;
mod station;

use ubimap_protocol::tile::Epoch;

use super::{RunError, interruption, keeper, options::ServeOptions};
use crate::{
    channel::{serial::SerialPort, wire::Wire},
    report::ServeReport,
};
pub use attached::{Attached, Opener};
pub use bench_camera::CAPTURE_INTERVAL;
pub use station::Station;

/// Serves until the time is up or a signal interrupts. A port that hangs up is opened again when it
/// comes back, and a map that can't be stored is stored once that works again.
///
/// # Errors
/// [`RunError`] if a port or the store can't be opened.
pub fn run(options: &ServeOptions) -> Result<ServeReport, RunError> {
    let ports = open(options)?;
    let resolution = options.resolution;
    let epoch = Epoch(random()?.max(1));
    let (keeper, mut life) = keeper::open(options.store.as_deref(), resolution, epoch)?;
    life.first_session = Some(random()?);
    let mut station = Station::new(resolution, life, ports, keeper)?;
    let end = options.duration.map(|duration| station.now() + duration);
    while !interruption::is_requested() && end.is_none_or(|end| station.now() < end) {
        station.turn();
    }
    let report = station.report();
    station.finish();
    Ok(report)
}

fn open(options: &ServeOptions) -> Result<Vec<Attached>, RunError> {
    let pose = |index: usize| match options.pose[..] {
        [] => None,
        [one] => Some(one),
        _ => options.pose.get(index).copied(),
    };
    let (poses, ports) = (options.pose.len(), options.ports.len());
    if poses > 1 && poses != ports {
        return Err(RunError::Poses { poses, ports });
    }
    let attached = options.ports.iter().enumerate().map(|(index, path)| {
        let (path, baud, name) = (path.clone(), options.baud, path.display().to_string());
        let opener: Opener =
            Box::new(move || Ok(Box::new(SerialPort::open(&path, baud)?) as Box<dyn Wire>));
        let attached = Attached::open(name, opener, pose(index))?;
        log::info!("port {index} is {}", options.ports[index].display());
        Ok(attached)
    });
    attached.collect()
}

/// A random number, so that no two lives of the server share an epoch and a session, whatever the clock
/// says.
fn random() -> Result<u32, RunError> {
    getrandom::u32().map_err(RunError::Randomness)
}

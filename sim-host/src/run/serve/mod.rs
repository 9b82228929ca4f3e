//! `ubimap serve`: the camera server in real time, on serial ports, sockets and cameras.
//!
//! Drives a deployment by the wall clock. With the file of a deployment it is the system of the papers;
//! with ports alone it serves robots on a bench: each stands at a given pose, and gets fixes of it at a
//! camera's rate.
//!
//! The core (`station`) is one thread. Others wait at each port (`links`), for each camera's frames
//! (`cameras`, from `sources`) and for commands, and one looks at the newest frames (`perceiving`); they put
//! what they have into the core's queue (`message`). `recording` is a command of its own.

mod attached;
mod bench_camera;
mod cameras;
mod clock;
mod links;
mod live_keys;
mod message;
mod perceiving;
pub mod recording;
mod results;
mod robots;
mod sources;
mod standing;
mod station;

use std::{path::Path, sync::mpsc, time};

use ubimap_protocol::{
    tile::Epoch,
    time::Duration,
    units::{Pose, RobotId},
};

use super::{
    RunError, control, deployment_file::DeploymentFile, interruption, keeper, options::ServeOptions,
};
#[cfg(unix)]
use crate::channel::socket_file::SocketFile;
use crate::{
    channel::{address::Address, serial::SerialPort},
    deployment::{self, Life},
    report::ServeReport,
    server::coordination::{Settings, settings::ExplorationRules},
};
pub use attached::{Attached, Opener};
pub use bench_camera::CAPTURE_INTERVAL;
pub use links::Door;
pub use live_keys::LiveKeys;
pub use station::Station;

use message::Message;
use results::Writer;

/// Time after which a robot that finds nothing to look at returns into the cameras' view.
const RETURNS_AFTER: Duration = Duration::from_secs(4);
/// Interval between two lines about the state in the log.
const SUMMARY: Duration = Duration::from_secs(60);
/// How long a command waits for the core.
const PATIENCE: time::Duration = time::Duration::from_secs(5);

/// Serves until the time is up or a signal interrupts. A port that hangs up is opened again when it
/// comes back, and a map that can't be stored is stored once that works again.
///
/// # Errors
/// [`RunError`] if a port or the store can't be opened.
pub fn run(options: &ServeOptions) -> Result<ServeReport, RunError> {
    match &options.ports[..] {
        [Address::Serial(path)] if path.extension().is_some_and(|it| it == "toml") => {
            serve_file(path, options)
        }
        _ => serve_bench(options),
    }
}

fn serve_bench(options: &ServeOptions) -> Result<ServeReport, RunError> {
    let keys = keyring(options, None)?;
    let pose = |index: usize| match options.pose[..] {
        [] => None,
        [one] => Some(one),
        _ => options.pose.get(index).copied(),
    };
    let (poses, ports) = (options.pose.len(), options.ports.len());
    if poses > 1 && poses != ports {
        return Err(RunError::Poses { poses, ports });
    }
    let links = open(&options.ports, options, keys.is_some(), pose)?;
    let resolution = options.resolution;
    let (keeper, life) = begin(options.store.as_deref(), resolution)?;
    let mut station = Station::new(resolution, life, links, keys, keeper)?;
    turn(&mut station, options, None)?;
    let report = station.report();
    station.finish();
    Ok(report)
}

/// The robots' keys, if the ports shall be sealed: from the folder of an option, or that of a deployment.
fn keyring(options: &ServeOptions, stated: Option<&Path>) -> Result<Option<LiveKeys>, RunError> {
    let asked = options.keys.as_deref().or(options.sealed.then_some(Path::new("keys")));
    let Some(folder) = asked.or(stated.filter(|_| !options.open)) else { return Ok(None) };
    let keys = LiveKeys::open(folder)?;
    if keys.all().next().is_none() {
        log::warn!("{}: no robot has a key: ubimap keys make ROBOT", folder.display());
    }
    Ok(Some(keys))
}

/// Serves the deployment of a file.
fn serve_file(path: &Path, options: &ServeOptions) -> Result<ServeReport, RunError> {
    let refuse =
        |reason: &str| RunError::Deployment { path: path.to_owned(), reason: reason.into() };
    if !options.pose.is_empty() {
        return Err(refuse("a deployment has cameras; --pose is for ports on a bench"));
    }
    let file = DeploymentFile::read(path)?;
    if file.ports.is_empty() && file.cameras.is_empty() {
        return Err(refuse("has neither ports nor cameras: nothing to serve"));
    }
    let mut writer = Writer::new(file.out.clone(), file.interval)?;
    // Before the ports, so that a key that can't be used opens none.
    let keys = keyring(options, file.keys.as_deref())?;
    let links = open(&file.ports, options, keys.is_some(), |_| None)?;
    let store = options.store.as_ref().or(file.store.as_ref());
    let (keeper, life) = begin(store.map(|store| store.as_path()), file.resolution)?;
    let exploration =
        ExplorationRules { returns_after: Some(RETURNS_AFTER), ..ExplorationRules::default() };
    let settings = Settings { exploration, ..Settings::default() };
    let config = deployment::Config {
        registry: file.registry.clone(),
        obstacle_heights: file.obstacles,
        coordination: Some(settings),
        floor: file.floor,
        labels: file.labels,
        ..deployment::Config::new(file.resolution)
    };
    for camera in file.cameras.iter().filter(|camera| !camera.is_placed) {
        log::warn!("camera {} has no pose: it is shown and not used", camera.name);
    }
    let mut station = Station::live(
        config,
        life,
        (links, keys),
        keeper,
        (file.cameras, file.plan),
        file.playback,
    )?;
    if options.explore {
        station.explore(file.registry.robots.iter().map(|robot| RobotId(robot.id)));
    }
    // Whoever asks after the end finds no server.
    let _control = listen(path, &station)?;
    let served = turn(&mut station, options, Some(&mut writer));
    let snapshot = station.snapshot();
    station.finish();
    served?;
    let report = writer.finish(snapshot?)?;
    log::info!("results in {}", file.out.display());
    Ok(report)
}

/// Turns until the time is up or a signal interrupts.
fn turn(
    station: &mut Station,
    options: &ServeOptions,
    mut writer: Option<&mut Writer>,
) -> Result<(), RunError> {
    let end = options.duration.map(|duration| station.now() + duration);
    let mut next_summary = station.now() + SUMMARY;
    while !interruption::is_requested() && end.is_none_or(|end| station.now() < end) {
        station.turn();
        if let Some(writer) = &mut writer
            && writer.is_due(station.now())
        {
            writer.write(station.snapshot()?, station.now());
        }
        if writer.is_some() && station.now() >= next_summary {
            next_summary = station.now() + SUMMARY;
            log::info!("{}", station.summary(&station.snapshot()?));
        }
    }
    Ok(())
}

/// Answers commands from now on.
#[cfg(unix)]
fn listen(path: &Path, station: &Station) -> Result<SocketFile, RunError> {
    let feed = station.feed();
    Ok(control::listen(&control::socket(path), move |request| {
        let (answer, answered) = mpsc::channel();
        let gone = || "the server is ending".to_owned();
        if !feed.send(Message::Request(request, answer)) {
            return Err(gone());
        }
        answered.recv_timeout(PATIENCE).map_err(|_| gone())?
    })?)
}

#[cfg(not(unix))]
fn listen(_: &Path, _: &Station) -> Result<(), RunError> {
    Ok(())
}

/// The ports that the server opens, and the sockets at which robots knock. `stands` gives the pose of the
/// robots behind each.
fn open(
    ports: &[Address],
    options: &ServeOptions,
    is_keyed: bool,
    stands: impl Fn(usize) -> Option<Pose>,
) -> Result<(Vec<Attached>, Vec<Door>), RunError> {
    let (mut attached, mut doors) = (Vec::new(), Vec::new());
    for (index, address) in ports.iter().enumerate() {
        let stands = stands(index);
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

/// Begins a life of the server.
fn begin(
    store: Option<&Path>,
    resolution: ubimap_protocol::units::Millimetres,
) -> Result<(Option<keeper::Keeper>, Life), RunError> {
    let epoch = Epoch(random()?.max(1));
    let (keeper, mut life) = keeper::open(store, resolution, epoch)?;
    life.first_session = Some(random()?);
    life.salt = Some(u64::from(random()?) << 32 | u64::from(random()?));
    Ok((keeper, life))
}

/// A random number, so that no two lives of the server share an epoch and a session, whatever the clock
/// says.
fn random() -> Result<u32, RunError> {
    getrandom::u32().map_err(RunError::Randomness)
}

//! `ubimap robot`: the robot's program on a computer with serial ports, such as a Raspberry Pi. The same
//! machine as in the firmware reads an A010 depth camera or an LD06 lidar and drives a Create 2; its link to
//! the server is a serial port, UDP or TCP.

mod contact;
mod line;
mod stored;

use std::{
    path::{Path, PathBuf},
    time,
};

use clap::Args;
use serde::{Deserialize, Serialize};
use ubimap_agent::{
    Bounds, Config, Machine, Memory, Port, Seal,
    device::{
        DepthSensor,
        create2::Create2,
        ld06::{self, Ld06},
    },
    drive::{Driving, Gaze, Motion, StopReason},
    sense::SensorModel,
};
use ubimap_protocol::{
    frame::DEFAULT_FRAME,
    time::{Duration, Instant},
    units::{Millimetres, Pose, RobotId},
};

use super::{
    RunError,
    body::{self, BUFFER, CAMERA},
    heap::{BOUNDS, Heap},
    interruption, keys,
};
use crate::{
    channel::{
        address::Address,
        intake::{Arrival, Intake, What},
        serial::SerialPort,
        tcp,
        udp::UdpLink,
    },
    files,
    report::OutputFile,
};

use contact::Contact;
use line::Line;
use stored::Stored;

/// Speed of serial ports, other than a lidar's, in bits per second.
const BAUD: u32 = 115_200;
/// The beginning of `sensor` for a lidar.
pub(in crate::run) const LIDAR: &str = "ld06:";
/// Number of readings in a lidar's scan: one per degree.
const LIDAR_READINGS: usize = 360;
/// Maximum wait for an arrival, so that signals are noticed.
const LONGEST_WAIT: Duration = Duration::from_millis(50);
/// How long a connection to the server may take.
const CONNECT: time::Duration = time::Duration::from_millis(500);
/// Number of arrivals that are handled before the ports are looked after.
const ARRIVALS: usize = 64;

/// Options of `ubimap robot`.
#[derive(Args, Clone, Debug)]
pub struct RobotOptions {
    /// The robot's configuration; `ubimap rig` writes one. Parameters that ubimap param stores are beside it, in a
    /// file with the ending .parameters
    #[arg(value_name = "TOML")]
    pub config: PathBuf,
}

/// A robot's configuration. Device paths are relative to the file.
///
/// ```toml
/// id = 1
/// server = "udp:192.168.1.10:4000"  # or tcp:..., or a serial device
/// # local = "0.0.0.0:4101"          # the UDP port to send from; with a fixed one, the server welcomes a
///                                   # robot that has just booted at once, else after 15 s
/// # keys = "keys"                   # seals the link with keys/1.key; beside this file, one with the ending
///                                   # .boot then counts the boots: keep it
/// sensor = "/dev/ttyUSB0"           # an A010 depth camera at 115,200 bits per second
///                                   # or ld06:/dev/ttyUSB0, an LD06 lidar at 230,400, its arrow ahead
/// wheels = "/dev/ttyUSB1"           # a Create 2
/// radius_m = 0.17
/// speed_m_s = 0.45
/// turn_rad_s = 1.3
/// sensor_at_m = [0.1, 0.0]          # ahead of the middle between the wheels, and to its left
/// fov_deg = 70.0                    # of the depth camera; a lidar sees all around
/// max_range_m = 2.5
/// resolution_m = 0.05               # the server's
/// ```
///
/// What `ubimap param store` has stored is in a file beside it with the ending `.parameters`, and counts more. To
/// undo it, delete that file.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct RobotFile {
    /// The robot's number.
    pub id: u16,
    /// Where the server is.
    pub server: String,
    /// The local address of a UDP link.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub local: Option<std::net::SocketAddr>,
    /// The folder with the robot's key, for a sealed link.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub keys: Option<PathBuf>,
    /// The port of the A010 depth camera; after `ld06:`, that of an LD06 lidar.
    pub sensor: PathBuf,
    /// The port of the Create 2.
    pub wheels: PathBuf,
    /// The robot's radius.
    #[serde(default = "usual::radius_m")]
    pub radius_m: f64,
    /// Its maximum speed.
    #[serde(default = "usual::speed_m_s")]
    pub speed_m_s: f64,
    /// Its maximum turn rate.
    #[serde(default = "usual::turn_rad_s")]
    pub turn_rad_s: f64,
    /// The depth camera's position, ahead of `base_link` and to its left.
    #[serde(default = "usual::sensor_at_m")]
    pub sensor_at_m: [f64; 2],
    /// The depth camera's field of view.
    #[serde(default = "usual::fov_deg")]
    pub fov_deg: f64,
    /// The depth camera's maximum range.
    #[serde(default = "usual::max_range_m")]
    pub max_range_m: f64,
    /// The side of the map's cells.
    #[serde(default = "usual::resolution_m")]
    pub resolution_m: f64,
}

/// The defaults of a Create 2 with an A010 on its front.
mod usual {
    pub(super) fn radius_m() -> f64 {
        0.17
    }
    pub(super) fn speed_m_s() -> f64 {
        0.45
    }
    pub(super) fn turn_rad_s() -> f64 {
        1.3
    }
    pub(super) fn sensor_at_m() -> [f64; 2] {
        [0.1, 0.0]
    }
    pub(super) fn fov_deg() -> f64 {
        super::RobotFile::FOV_DEG
    }
    pub(super) fn max_range_m() -> f64 {
        2.5
    }
    pub(super) fn resolution_m() -> f64 {
        0.05
    }
}

impl RobotFile {
    /// The field of view of an A010, in degrees.
    pub const FOV_DEG: f64 = 70.0;

    /// Reads a file.
    ///
    /// # Errors
    /// The problem as text, in one line.
    fn read(path: &Path) -> Result<Self, String> {
        let text = files::read_settings(path).map_err(|error| error.to_string())?;
        let file: Self = toml::from_str(&text).map_err(|error| files::toml_fault(&error, &text))?;
        let bounds = [
            ("radius_m", file.radius_m, 0.05, 2.0),
            ("speed_m_s", file.speed_m_s, 0.05, 5.0),
            ("turn_rad_s", file.turn_rad_s, 0.1, 10.0),
            ("sensor_at_m", file.sensor_at_m[0], -2.0, 2.0),
            ("sensor_at_m", file.sensor_at_m[1], -2.0, 2.0),
            ("fov_deg", file.fov_deg, 5.0, 170.0),
            ("max_range_m", file.max_range_m, 0.1, 65.0),
            ("resolution_m", file.resolution_m, 0.02, 1.0),
        ];
        let is_out =
            |(_, value, least, most): &(&str, f64, f64, f64)| !(*least..=*most).contains(value);
        match bounds.iter().find(|bound| is_out(bound)) {
            Some((key, value, least, most)) => {
                Err(format!("{key}: {value} must be from {least} to {most}"))
            }
            None => Ok(file),
        }
    }

    /// The port of the LD06, if the sensor is one.
    fn lidar(&self) -> Option<&Path> {
        self.sensor.to_str()?.strip_prefix(LIDAR).map(Path::new)
    }

    /// The sensor's model, and the number of its readings.
    fn model(&self) -> (SensorModel, usize) {
        if self.lidar().is_some() {
            return (Ld06::sensor(LIDAR_READINGS), LIDAR_READINGS);
        }
        let columns = CAMERA.binning.side();
        let focal = columns as f64 / 2.0 / (self.fov_deg / 2.0).to_radians().tan();
        let centre = (columns - 1) as f32 / 2.0;
        (SensorModel::Pinhole { focal: focal as f32, centre }, columns)
    }

    fn config(&self, boot_nonce: u32) -> Config<Option<Driving>> {
        let (model, readings) = self.model();
        let bounds = Bounds {
            readings,
            resolution: Millimetres::from_metres(self.resolution_m),
            max_range: (self.max_range_m * 1_000.0) as u16,
            ..BOUNDS
        };
        let [x, y] = self.sensor_at_m;
        let config = Config::new(RobotId(self.id), model, bounds);
        let validity = if self.lidar().is_some() { Ld06::validity() } else { config.validity };
        let mounting = Pose::from_metres(x, y, 0.0);
        let config = Config { boot_nonce, mounting, validity, ..config };
        let radius = (self.radius_m * 1_000.0).ceil() as u16;
        let motion = Motion {
            radius,
            top_speed: (self.speed_m_s * 1_000.0) as f32,
            top_turn: self.turn_rad_s as f32,
            ..Motion::default()
        };
        let view_deg = if self.lidar().is_some() { 360.0 } else { self.fov_deg };
        let half_view = (view_deg / 2.0).to_radians() as f32;
        let gaze = Gaze { half_view, reach: bounds.max_range, radius };
        config.with_drive(Some(Driving { motion, looks_at_goal: Some(gaze), ..Driving::default() }))
    }
}

type Robot<'b, S> = Machine<'b, S, Create2, Option<Driving>>;

/// Runs the robot until a signal interrupts; then its wheels stand.
///
/// # Errors
/// [`RunError`] if the configuration is invalid. Ports that can't be opened are tried again.
pub fn run(options: &RobotOptions) -> Result<(), RunError> {
    let path = &options.config;
    let refuse = |reason: String| RunError::Deployment { path: path.clone(), reason };
    let file = RobotFile::read(path).map_err(refuse)?;
    let beside = path.parent().unwrap_or(Path::new(""));
    let server: Address =
        file.server.parse().map_err(|error| refuse(format!("server: {error}")))?;
    let seal = file.keys.as_ref().map(|folder| seal(path, &beside.join(folder), file.id));
    let seal = seal.transpose()?;
    let config = file.config(getrandom::u32().map_err(RunError::Randomness)?);
    let mut config = Config { seal, keeps_parameters: true, ..config };
    let stored = Stored::beside(path, config.parameters().to_vec())?;
    if let Some(told) = stored.told() {
        log::info!("{told}");
    }
    config.set(&stored.values().collect::<Vec<_>>());
    let mut memory = Memory::<Heap, Option<Driving>>::new(&config.bounds);
    let device = |port, path: &Path, baud| {
        let path = beside.join(path);
        let name = path.display().to_string();
        Line::new(port, name, move || Ok(SerialPort::open(&path, baud)?.into_wire()))
    };
    let local = file.local;
    log::info!(
        "robot {}: sensor at {}, wheels at {}; Ctrl-C stops the wheels and ends",
        file.id,
        beside.join(file.lidar().unwrap_or(&file.sensor)).display(),
        beside.join(&file.wheels).display()
    );
    let contact = Contact::new(server.to_string(), Instant(0));
    let link = Line::new(Port::Server, server.to_string(), move || match &server {
        Address::Serial(path) => Ok(SerialPort::open(path, BAUD)?.into_wire()),
        Address::Udp(address) => Ok(UdpLink::open(*address, local)?.into_wire()),
        Address::Tcp(address) => tcp::connect(*address, CONNECT),
    });
    let wheels = device(Port::Wheels, &file.wheels, BAUD);
    let program = |sensor| Program {
        lines: [link, sensor, wheels],
        intake: Intake::default(),
        started: time::Instant::now(),
        contact,
        stored,
    };
    if let Some(path) = file.lidar() {
        let mut sectors = [0; LIDAR_READINGS];
        let lidar = Ld06::new(&mut sectors);
        let mut machine = Machine::new(config, &mut memory, lidar, Create2::new())?;
        program(device(Port::Sensor, path, ld06::BAUD)).run(&mut machine);
        return Ok(());
    }
    let mut buffer = [0; BUFFER];
    let camera = body::camera(config.sensor, &mut buffer)
        .ok_or_else(|| refuse("fov_deg: no image of the A010 has such optics".into()))?;
    let mut machine = Machine::new(config, &mut memory, camera, Create2::new())?;
    program(device(Port::Sensor, &file.sensor, BAUD)).run(&mut machine);
    Ok(())
}

/// The robot's key, and the number of this boot, which is stored before it is used.
fn seal(config: &Path, folder: &Path, robot: u16) -> Result<Seal, RunError> {
    let keys = keys::load(folder)?;
    let refuse = |path: &Path, reason: String| RunError::Deployment { path: path.into(), reason };
    let key = keys.into_iter().find(|(id, _)| *id == RobotId(robot)).map(|(_, key)| key);
    let key = key.ok_or_else(|| refuse(folder, format!("there is no {robot}.key")))?;
    let path = config.with_extension("boot");
    let last = match files::read_settings(&path) {
        Ok(text) => text.trim().parse().map_err(|_| {
            refuse(&path, "holds no number of a boot; write a higher one than ever before".into())
        })?,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => 0_u32,
        Err(error) => return Err(refuse(&path, error.to_string())),
    };
    let boot = last.checked_add(1);
    let boot = boot.ok_or_else(|| refuse(&path, "no number is left: make a new key".into()))?;
    OutputFile::create(&path)?.finish(format!("{boot}\n").as_bytes())?;
    Ok(Seal { key, boot })
}

struct Program {
    lines: [Line; 3],
    intake: Intake<()>,
    started: time::Instant,
    contact: Contact,
    stored: Stored,
}

impl Program {
    fn now(&self) -> Instant {
        Instant(self.started.elapsed().as_micros() as u64)
    }

    fn run(mut self, machine: &mut Robot<'_, impl DepthSensor>) {
        while !interruption::is_requested() {
            self.turn(machine);
        }
        let now = self.now();
        log::info!("stops the wheels and ends");
        machine.stop(StopReason::Button, None, now);
        self.drain(machine);
        // The lines are dropped when the queued bytes are written.
    }

    fn turn(&mut self, machine: &mut Robot<'_, impl DepthSensor>) {
        let now = self.now();
        for line in &mut self.lines {
            line.look_after(&mut self.intake, now);
        }
        let until_due = machine.poll_timeout().since(now).min(LONGEST_WAIT);
        let mut wait = time::Duration::from_micros(until_due.micros());
        for _ in 0..ARRIVALS {
            let Some(Arrival::Port { source, at, what }) = self.intake.next_within(wait) else {
                break;
            };
            wait = time::Duration::ZERO;
            let line = self.lines.iter_mut().find(|line| line.is_source(source));
            match (what, line) {
                (What::Bytes(bytes), Some(line)) => {
                    let since = at.saturating_duration_since(self.started);
                    let at = Instant(since.as_micros() as u64);
                    if line.port == Port::Server {
                        self.contact.hears(at);
                    }
                    machine.receive(line.port, &bytes, at);
                    self.drain(machine);
                }
                (What::Failed(error), Some(line)) => line.failed(&error),
                // From a line that was closed meanwhile.
                _ => {}
            }
        }
        let now = self.now();
        machine.timeout(now);
        if let Some(parameters) = machine.poll_store(now) {
            let is_stored = self.stored.store(&parameters);
            machine.stored(is_stored.is_ok());
            if let Err(error) = is_stored {
                log::error!("{error}");
            }
        }
        self.drain(machine);
        let robot = machine.robot();
        if let Some((level, text)) = self.contact.follow(robot.is_connected(), robot.refusal(), now)
        {
            log::log!(level, "{text}");
        }
    }

    /// Writes what is due at each port.
    fn drain(&mut self, machine: &mut Robot<'_, impl DepthSensor>) {
        let now = self.now();
        let mut bytes = [0; DEFAULT_FRAME];
        for line in &mut self.lines {
            while let Some(count) = machine.poll_transmit(line.port, now, &mut bytes) {
                line.write(&bytes[..count]);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::Folder;

    const ROBOT: &str = "id = 7\nserver = \"udp:4000\"\nsensor = \"a\"\nwheels = \"b\"\n";

    #[test]
    fn errors_name_the_place_and_the_remedy() {
        let folder = Folder::new("robot-file");
        let read = |text: &str| RobotFile::read(&folder.file("robot.toml", text.as_bytes()));
        let file = read(ROBOT).unwrap();
        let config = file.config(1);
        assert_eq!((config.robot, config.bounds.max_range), (RobotId(7), 2_500));
        assert_eq!(toml::from_str::<RobotFile>(&toml::to_string(&file).unwrap()).unwrap().id, 7);
        let lidar = read(&ROBOT.replace("\"a\"", "\"ld06:a\"")).unwrap();
        let config = lidar.config(1);
        assert_eq!(lidar.lidar(), Some(Path::new("a")));
        assert_eq!((config.sensor, config.bounds.readings), (Ld06::sensor(360), 360));
        for (text, told) in [
            ("fov_deg = 200.0", "fov_deg: 200 must be from 5 to 170"),
            ("radius = 1", "line 5: unknown field `radius`"),
            ("speed_m_s = nan", "speed_m_s: NaN must be from"),
        ] {
            let error = read(&format!("{ROBOT}{text}\n")).unwrap_err();
            assert!(error.contains(told), "{error}");
        }
    }
}

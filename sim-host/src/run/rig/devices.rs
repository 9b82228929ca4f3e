//! The devices of one robot, at pseudo-terminals.

use std::{
    fs::{self, File, OpenOptions},
    io::{Read, Write},
    os::unix::fs::{OpenOptionsExt, symlink},
    path::{Path, PathBuf},
    time,
};

use nix::fcntl::OFlag;
use serialport::{SerialPort as _, TTYPort};
use ubimap_agent::drive::DriveCommand;
use ubimap_protocol::time::Instant;

use super::files;
use crate::{
    channel::wire::WireError,
    devices::{SimA010, SimCreate2, SimLd06, Wiring},
    run::{RunError, stage::Stage},
};

/// Speed of the ports in bits per second.
const BAUD: u32 = 115_200;

/// A sensor and a Create 2.
pub(super) struct Devices {
    sensor: Terminal,
    wheels: Terminal,
    sees: Sensor,
    base: SimCreate2,
    /// The speed and the turn rate last passed to the room.
    driven: [f64; 2],
    /// Whether the robot's program has ever sent anything to the wheels.
    was_heard: bool,
}

/// A robot's sensor.
pub(super) enum Sensor {
    A010(SimA010),
    Ld06(SimLd06),
}

impl Sensor {
    /// An A010, or an LD06.
    pub(super) fn new(is_lidar: bool) -> Self {
        if is_lidar { Self::Ld06(SimLd06::new()) } else { Self::A010(SimA010::new(BAUD)) }
    }
}

/// A pseudo-terminal, with a link to its other end.
struct Terminal {
    master: TTYPort,
    /// The other end, kept open, so that the port does not hang up when the robot's program ends.
    _slave: File,
    link: PathBuf,
}

impl Terminal {
    fn open(link: PathBuf) -> Result<Self, RunError> {
        let opened = TTYPort::pair().and_then(|(mut master, slave)| {
            // Nothing waits: a line without flow control loses what its reader does not take.
            master.set_timeout(time::Duration::ZERO)?;
            let name = slave.name().unwrap_or_default();
            // A `TTYPort` is locked against the robot's program; a file is not.
            let flags = OFlag::O_NOCTTY.bits();
            let file = OpenOptions::new().read(true).write(true).custom_flags(flags).open(&name)?;
            Ok((master, file, name))
        });
        let (master, slave, name) = opened.map_err(|error| {
            let reason = format!("no pseudo-terminal: {error}");
            WireError::Open { name: link.display().to_string(), reason }
        })?;
        // A killed rig has left its links.
        if fs::symlink_metadata(&link).is_ok_and(|there| there.is_symlink()) {
            fs::remove_file(&link).map_err(|error| files::refused(&link, &error))?;
        }
        symlink(name, &link).map_err(|error| files::refused(&link, &error))?;
        Ok(Self { master, _slave: slave, link })
    }

    fn read(&mut self) -> Vec<u8> {
        let mut bytes = [0; 512];
        let count = self.master.read(&mut bytes).unwrap_or_default();
        bytes[..count].to_vec()
    }

    fn write(&mut self, bytes: &[u8]) {
        if !bytes.is_empty() {
            // What the robot does not take is lost.
            let _ = self.master.write(bytes);
        }
    }
}

impl Drop for Terminal {
    fn drop(&mut self) {
        // It leads nowhere any more.
        let _ = fs::remove_file(&self.link);
    }
}

impl Devices {
    /// Opens the ports; their links are `PREFIX-sensor` and `PREFIX-wheels`.
    pub(super) fn open(prefix: &Path, sees: Sensor, wiring: Wiring) -> Result<Self, RunError> {
        let link = |device: &str| {
            let mut name = prefix.as_os_str().to_owned();
            name.push(device);
            PathBuf::from(name)
        };
        Ok(Self {
            sensor: Terminal::open(link("-sensor"))?,
            wheels: Terminal::open(link("-wheels"))?,
            sees,
            base: SimCreate2::new().wired(wiring),
            driven: [0.0; 2],
            was_heard: false,
        })
    }

    /// Passes a scan to the sensor.
    pub(super) fn scan(&mut self, readings: &[u16], taken: Instant) {
        match &mut self.sees {
            Sensor::A010(camera) => camera.expose(readings, taken),
            Sensor::Ld06(lidar) => lidar.expose(readings, taken),
        }
    }

    /// When the base measures next.
    pub(super) fn next_measure(&self) -> Option<Instant> {
        self.base.next_frame()
    }

    /// Lets the base measure what its wheels have rolled, which it does at `now`.
    pub(super) fn measure(&mut self, robot: usize, stage: &mut dyn Stage, now: Instant) {
        if let Some((rolled, is_touching)) = stage.wheels(now, robot) {
            self.base.measure(rolled, is_touching, now);
        }
    }

    /// Moves bytes between the ports and the devices, and the wheels in the room.
    pub(super) fn exchange(&mut self, robot: usize, stage: &mut dyn Stage, now: Instant) {
        let bytes = self.wheels.read();
        if !bytes.is_empty() && !self.was_heard {
            self.was_heard = true;
            log::info!("{}: a robot's program is there", self.wheels.link.display());
        }
        self.base.receive(&bytes, now);
        let bytes = self.sensor.read();
        let seen = match &mut self.sees {
            Sensor::A010(camera) => {
                camera.receive(&bytes, now);
                camera.poll_transmit(now)
            }
            Sensor::Ld06(lidar) => lidar.poll_transmit(now),
        };
        let commanded = self.base.commanded();
        if commanded != self.driven {
            self.driven = commanded;
            let [speed, turn] = commanded.map(|it| (it * 1_000.0).round() as i16);
            stage.drive(now, robot, DriveCommand { speed, turn });
        }
        self.sensor.write(&seen);
        self.wheels.write(&self.base.poll_transmit(now));
    }
}

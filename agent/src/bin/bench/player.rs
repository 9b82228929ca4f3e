//! A robot that replays a journal, identically on a microcontroller and on a PC.
//!
//! A journal is a sequence of entries; all numbers are little-endian:
//!
//! | what | bytes |
//! |---|---|
//! | the kind of the entry | 1 |
//! | the time by the robot's clock, in microseconds | 8 |
//! | [`RECEIVED`]: the number of bytes, then the bytes | 2, any |
//! | [`ODOMETRY`]: x and y in millimetres, the heading in binary units | 4, 4, 2 |
//! | [`SCAN`]: the readings in millimetres | 200 |
//! | [`TIMEOUT`], [`TRANSMIT`], [`END`]: nothing | 0 |

use core::{array, fmt, str};

use ubimap_agent::{
    Bounds, Config, Robot,
    drive::{DriveCommand, Driving, Gaze},
    sense::SensorModel,
};
use ubimap_protocol::{
    frame::DEFAULT_FRAME,
    tile::{Layer, tile_hash},
    time::Instant,
    units::{Angle, Millimetres, Pose, RobotId},
};

/// Bytes from the server.
pub(crate) const RECEIVED: u8 = 1;
/// An odometry reading.
pub(crate) const ODOMETRY: u8 = 2;
/// A scan.
pub(crate) const SCAN: u8 = 3;
/// A call of `timeout`.
pub(crate) const TIMEOUT: u8 = 4;
/// A call of `poll_transmit`.
pub(crate) const TRANSMIT: u8 = 5;
/// The end of the journal.
pub(crate) const END: u8 = 6;

/// The sizes of the robot's memory.
pub(crate) const BOUNDS: Bounds = Bounds { own_tiles: 16, fused_tiles: 36, ..Bounds::REFERENCE };

/// The robot: a depth camera of 100 pixels with a view of 78 degrees, and wheels.
pub(crate) fn config() -> Config<Driving> {
    let sensor = SensorModel::Pinhole { focal: 61.745, centre: 49.5 };
    let gaze = Gaze { half_view: 0.68, reach: 2_000, radius: 150 };
    let driving = Driving { looks_at_goal: Some(gaze), ..Driving::default() };
    Config { boot_nonce: 77, ..Config::new(RobotId(1), sensor, BOUNDS) }.with_drive(driving)
}

/// Replays a journal and writes the robot's outputs: a line for each frame and each new wheel
/// command, and at the end a line for each tile and for the counters.
///
/// # Errors
/// The journal is incomplete, or writing fails.
pub(crate) fn play(
    robot: &mut Robot<'_, Driving>,
    byte: impl FnMut() -> Option<u8>,
    out: &mut impl fmt::Write,
) -> fmt::Result {
    let mut journal = Reader(byte);
    let mut commanded = DriveCommand::STAND;
    let mut frame = [0; DEFAULT_FRAME];
    loop {
        let [kind] = journal.bytes()?;
        let now = Instant(u64::from_le_bytes(journal.bytes()?));
        match kind {
            RECEIVED => {
                let count = u16::from_le_bytes(journal.bytes()?).into();
                let bytes = frame.get_mut(..count).ok_or(fmt::Error)?;
                journal.fill(bytes)?;
                robot.receive(bytes, now);
            }
            ODOMETRY => robot.odometry(now, journal.pose()?, now),
            SCAN => {
                let mut readings = [0; BOUNDS.readings];
                for reading in &mut readings {
                    *reading = u16::from_le_bytes(journal.bytes()?);
                }
                // Refused scans are counted.
                let _ = robot.scan(now, &readings, now);
            }
            TIMEOUT => {
                robot.timeout(now);
                if robot.command() != commanded {
                    commanded = robot.command();
                    write_command(commanded, out)?;
                }
            }
            TRANSMIT => {
                if let Some(len) = robot.poll_transmit(now, &mut frame) {
                    write_frame(frame.get(..len).unwrap_or_default(), out)?;
                }
            }
            END => return write_result(robot, out),
            _ => return Err(fmt::Error),
        }
    }
}

/// Writes the line of a wheel command.
pub(crate) fn write_command(command: DriveCommand, out: &mut impl fmt::Write) -> fmt::Result {
    writeln!(out, "wheels {} {}", command.speed, command.turn)
}

/// Writes the line of a sent frame.
pub(crate) fn write_frame(frame: &[u8], out: &mut impl fmt::Write) -> fmt::Result {
    out.write_str("sent ")?;
    for byte in frame {
        let digit = |value: u8| if value < 10 { b'0' + value } else { b'a' - 10 + value };
        let digits = [digit(byte >> 4), digit(byte & 15)];
        out.write_str(str::from_utf8(&digits).map_err(|_| fmt::Error)?)?;
    }
    out.write_str("\n")
}

/// Writes the lines of the tiles and of the counters.
fn write_result(robot: &Robot<'_, Driving>, out: &mut impl fmt::Write) -> fmt::Result {
    for tile in robot.own_tiles().tiles() {
        let (Some(id), stamp) = (tile.id(), tile.publication().version()) else { continue };
        let cells = tile.cells();
        writeln!(out, "own {} {} {} {:08x}", id.x, id.y, stamp.0, tile_hash(&cells))?;
    }
    for layer in [Layer::Fused, Layer::Coverage] {
        for (id, replica) in robot.fused_tiles().tiles(layer) {
            let (version, hash) = (replica.stamp().version.0, tile_hash(replica.tile()));
            writeln!(out, "fused {} {} {version} {hash:08x}", id.x, id.y)?;
        }
    }
    let count = robot.statistics();
    writeln!(out, "scans {} {} {} {}", count.scans, count.mapped, count.gated, count.expired)?;
    writeln!(out, "fixes {} {}", count.fixes, count.fixes_rejected)?;
    let link = robot.link_counters();
    writeln!(out, "bytes {}, {} bad frames", count.bytes_sent, link.bad)
}

/// Reads a journal byte by byte.
struct Reader<F>(F);

impl<F: FnMut() -> Option<u8>> Reader<F> {
    fn fill(&mut self, bytes: &mut [u8]) -> fmt::Result {
        bytes.iter_mut().try_for_each(|byte| {
            *byte = self.0().ok_or(fmt::Error)?;
            Ok(())
        })
    }

    fn bytes<const N: usize>(&mut self) -> Result<[u8; N], fmt::Error> {
        let mut bytes = array::from_fn(|_| 0);
        self.fill(&mut bytes)?;
        Ok(bytes)
    }

    fn pose(&mut self) -> Result<Pose, fmt::Error> {
        Ok(Pose {
            x: Millimetres(i32::from_le_bytes(self.bytes()?)),
            y: Millimetres(i32::from_le_bytes(self.bytes()?)),
            heading: Angle(u16::from_le_bytes(self.bytes()?)),
        })
    }
}

//! A robot that replays a journal, identically on a microcontroller and on a PC.

use core::{fmt, str};

use ubimap_agent::{
    Machine, Memory, Port, Robot, Storage,
    device::create2::Create2,
    drive::Driving,
    journal::{Entry, Reader},
};
use ubimap_protocol::{
    frame::DEFAULT_FRAME,
    tile::{Layer, tile_hash},
};

use crate::{configuration, driving::driving};

/// A call of the robot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Call {
    /// Bytes arrived at a port.
    Receive(Port),
    /// The work that was due: a step of the drive, unless nothing but a message was.
    Timeout,
    /// Bytes for a port.
    Transmit(Port),
}

/// Watches the calls of the robot.
pub(crate) trait Watch {
    /// Runs a call once. It returns what it was, and whether it mapped a scan.
    fn watch(&mut self, call: impl FnOnce() -> (Call, bool));
}

/// Nothing watches.
impl Watch for () {
    fn watch(&mut self, call: impl FnOnce() -> (Call, bool)) {
        call();
    }
}

/// Replays the journal of a robot in `memory`, with the firmware's configuration, and writes a line
/// for everything that it transmits, with another line if the journal says otherwise, and at the end
/// a line for each tile and for the counters.
///
/// # Errors
/// The journal is damaged or the configuration invalid, or writing fails.
pub(crate) fn play(
    memory: &mut Memory<impl Storage, Driving>,
    slice: &mut [u16],
    mut byte: impl FnMut() -> Option<u8>,
    out: &mut impl fmt::Write,
    watch: &mut impl Watch,
) -> fmt::Result {
    let mut nonce = [0; 4];
    for place in &mut nonce {
        *place = byte().ok_or(fmt::Error)?;
    }
    let config = configuration::config(u32::from_le_bytes(nonce)).with_drive(driving());
    let sensor = configuration::sensor(slice).ok_or(fmt::Error)?;
    let machine = &mut Machine::new(config, memory, sensor, Create2::new());
    let machine = machine.as_mut().map_err(|_| fmt::Error)?;
    let mut journal = Reader::new(byte);
    let mut recorded = [0; DEFAULT_FRAME];
    loop {
        let (now, entry) = journal.entry(&mut recorded).map_err(|_| fmt::Error)?;
        let mapped = machine.robot().statistics().mapped;
        match entry {
            Entry::Received(port, bytes) => watch.watch(|| {
                machine.receive(port, bytes, now);
                (Call::Receive(port), machine.robot().statistics().mapped != mapped)
            }),
            Entry::Timeout => watch.watch(|| {
                machine.timeout(now);
                (Call::Timeout, machine.robot().statistics().mapped != mapped)
            }),
            Entry::Transmitted(port, recorded) => {
                let mut bytes = [0; DEFAULT_FRAME];
                let mut count = 0;
                watch.watch(|| {
                    count = machine.poll_transmit(port, now, &mut bytes).unwrap_or_default();
                    (Call::Transmit(port), false)
                });
                let bytes = bytes.get(..count).unwrap_or_default();
                if !bytes.is_empty() {
                    write_bytes(name(port), bytes, out)?;
                }
                if bytes != recorded {
                    write_bytes("but recorded", recorded, out)?;
                }
            }
            Entry::End => return write_result(machine.robot(), out),
        }
    }
}

fn name(port: Port) -> &'static str {
    match port {
        Port::Server => "server",
        Port::Sensor => "sensor",
        Port::Wheels => "wheels",
    }
}

/// Writes the line of transmitted bytes.
fn write_bytes(name: &str, bytes: &[u8], out: &mut impl fmt::Write) -> fmt::Result {
    out.write_str(name)?;
    out.write_str(" ")?;
    for byte in bytes {
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

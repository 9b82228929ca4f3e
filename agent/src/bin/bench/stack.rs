//! Depth of a robot's stack in bytes, including the robot itself: `cargo stack`, and for a
//! Cortex-M0+ `cargo stack-m0`. The stack is painted before each stage of a drive with a scripted
//! server.
//!
//! Nothing is formatted here, so that the only panics in the image are the robot's.
#![no_std]
#![no_main]

mod ending;
mod paint;
mod server;

use cortex_m_rt::entry;
use cortex_m_semihosting::hio;
use ending::end;
use paint::{depth, paint};
use server::Server;
// Links the interrupt vectors of the chip.
#[cfg(feature = "firmware")]
use stm32f4xx_hal as _;
use ubimap_agent::{Bounds, Config, Memory, Robot, memory, sense::SensorModel};
use ubimap_protocol::{
    frame::DEFAULT_FRAME,
    message::ToRobotKind,
    tile::Layer,
    time::{Duration, Instant},
    units::{Angle, Millimetres, Pose, RobotId},
};

/// The firmware's bounds; the smallest ones on a core with less memory.
const BOUNDS: Bounds = if cfg!(feature = "firmware") { Bounds::REFERENCE } else { Bounds::SMALL };

/// Time between two scans.
const INTERVAL: Duration = Duration(66_667);

/// Number of scans of the drive. It is 12 m long, which fills the pool, so that tiles are evicted.
const SCANS: u64 = 200;

/// The stages measured.
#[derive(Clone, Copy)]
enum Stage {
    Made,
    Sent,
    Mapped,
    Welcomed,
    Told(ToRobotKind),
}

/// The names of the stages, by index.
const NAMES: [&str; 15] = [
    "a new robot",
    "a frame to send",
    "odometry and a scan",
    "a welcome",
    "the server's time",
    "a pose fix, and the scan that waits for it to tiles",
    "fused tiles and coverage",
    "their digests",
    "what cameras see now",
    "a request for its tiles",
    "what is on disk",
    "other robots",
    "obstacles",
    "a path",
    "a parameter, or a stop",
];

impl Stage {
    fn index(self) -> usize {
        match self {
            Self::Made => 0,
            Self::Sent => 1,
            Self::Mapped => 2,
            Self::Welcomed => 3,
            Self::Told(kind) => match kind {
                ToRobotKind::TimeReply => 4,
                ToRobotKind::PoseFix => 5,
                ToRobotKind::TileUpdate => 6,
                ToRobotKind::Digests => 7,
                ToRobotKind::Freshness => 8,
                ToRobotKind::Request => 9,
                ToRobotKind::Stored => 10,
                ToRobotKind::Peers => 11,
                ToRobotKind::Obstacles => 12,
                ToRobotKind::Path => 13,
                _ => 14,
            },
        }
    }
}

/// The maximum depth of each stage.
#[derive(Default)]
struct Depths([usize; NAMES.len()]);

impl Depths {
    fn measure<T>(&mut self, stage: Stage, work: impl FnOnce() -> T) -> T {
        paint();
        let result = work();
        self.note(stage);
        result
    }

    /// Records the depth of a stage; the stack must have been painted before it.
    fn note(&mut self, stage: Stage) {
        if let Some(deepest) = self.0.get_mut(stage.index()) {
            *deepest = depth().max(*deepest);
        }
    }

    fn print(&self) -> Option<()> {
        for (depth, name) in self.0.into_iter().zip(NAMES) {
            line(depth, "bytes of stack: ", name)?;
        }
        line(self.0.into_iter().max()?, "bytes of stack at the most", "")
    }
}

#[entry]
fn main() -> ! {
    static mut MEMORY: memory!(BOUNDS) = Memory::EMPTY;
    // The server is a static, so that it does not lie on the measured stack.
    static mut SERVER: Option<Server> = None;
    static mut DEPTHS: Depths = Depths([0; _]);

    paint();
    match &mut Robot::new(config(), MEMORY) {
        Ok(robot) => {
            DEPTHS.note(Stage::Made);
            end(drive(robot, Server::begin(SERVER), DEPTHS).and_then(|()| DEPTHS.print()))
        }
        Err(_) => end(None),
    }
}

fn config() -> Config {
    let centre = (BOUNDS.readings - 1) as f32 / 2.0;
    let focal = BOUNDS.readings as f32 * 0.617;
    Config::new(RobotId(1), SensorModel::Pinhole { focal, centre }, BOUNDS)
}

/// Drives along a hall, with fixes at 15 Hz. `None` if the robot has a wrong result.
#[inline(never)]
fn drive(robot: &mut Robot<'_>, server: &mut Server, depths: &mut Depths) -> Option<()> {
    let mut readings = [0; BOUNDS.readings];
    for count in 1..=SCANS {
        let now = Instant(count * INTERVAL.0);
        if count == SCANS / 2 {
            server.forget();
        }
        if let Some(reset) = server.reset() {
            depths.measure(Stage::Welcomed, || robot.receive(reset, now));
        }
        talk(robot, server, depths, now)?;
        let pose = pose(count);
        look(&mut readings, count);
        depths.measure(Stage::Mapped, || {
            robot.odometry(now, pose, now);
            // Without a session there are no poses, and the queue of scans overflows.
            let _ = robot.scan(now, &readings, now);
        });
        for kind in told(count) {
            let interest = robot.fused_tiles().interest();
            let Some(frame) = server.say(kind, count, pose, interest, now) else { continue };
            depths.measure(Stage::Told(kind), || robot.receive(frame, now));
        }
    }
    let done = robot.statistics();
    let held = robot.fused_tiles().tiles(Layer::Fused).count();
    let well = done.mapped > 100 && done.sessions == 2 && held > 0 && done.malformed_messages == 0;
    (well && robot.link_counters().retransmissions > 0).then_some(())
}

/// Sends all of the robot's frames, and receives the replies.
#[inline(never)]
fn talk(
    robot: &mut Robot<'_>,
    server: &mut Server,
    depths: &mut Depths,
    now: Instant,
) -> Option<()> {
    let mut frame = [0; DEFAULT_FRAME];
    while let Some(len) = depths.measure(Stage::Sent, || robot.poll_transmit(now, &mut frame)) {
        server.hear(frame.get(..len)?, now);
        if let Some(welcome) = server.welcome() {
            depths.measure(Stage::Welcomed, || robot.receive(welcome, now));
        }
        if let Some(reply) = server.reply(now) {
            let told = Stage::Told(ToRobotKind::TimeReply);
            depths.measure(told, || robot.receive(reply, now));
        }
    }
    Some(())
}

/// The server's messages after a scan: a fix, and one of the others in turn.
fn told(count: u64) -> [ToRobotKind; 3] {
    let other = match count % 9 {
        0 => ToRobotKind::Digests,
        1 => ToRobotKind::Freshness,
        2 => ToRobotKind::Request,
        3 => ToRobotKind::Stored,
        4 => ToRobotKind::Obstacles,
        5 => ToRobotKind::Path,
        6 => ToRobotKind::Parameter,
        7 => ToRobotKind::Stop,
        _ => ToRobotKind::Peers,
    };
    [other, ToRobotKind::TileUpdate, ToRobotKind::PoseFix]
}

/// The pose along the hall; the robot turns as it drives.
fn pose(count: u64) -> Pose {
    let along = 60 * count as i32;
    let heading = Angle((count * 700) as u16);
    Pose { x: Millimetres(along), y: Millimetres(along / 7), heading }
}

/// A scan with walls, boxes, noise and missing returns; sometimes it repeats the last one.
fn look(readings: &mut [u16], count: u64) {
    if count.is_multiple_of(8) {
        return;
    }
    for (column, reading) in (0u16..).zip(readings) {
        let noise = column.wrapping_mul(37).wrapping_add(count as u16 * 91) % 50;
        let is_box = column.wrapping_add(count as u16 * 3) % 29 < 9;
        let is_lost = column.wrapping_add(count as u16 * 7) % 41 == 7;
        *reading = if is_lost { 0 } else { noise + if is_box { 700 } else { 1_500 } };
    }
}

/// Prints a line of the table.
fn line(number: usize, what: &str, of: &str) -> Option<()> {
    let mut out = hio::hstdout().ok()?;
    let mut digits = [b' '; 12];
    let mut rest = number;
    for digit in digits.iter_mut().rev() {
        *digit = b'0' + (rest % 10) as u8;
        rest /= 10;
        if rest == 0 {
            break;
        }
    }
    for part in [&digits, &b"  "[..], what.as_bytes(), of.as_bytes(), b"\n"] {
        out.write_all(part).ok()?;
    }
    Some(())
}

//! Instruction counts of a robot's stages: `cargo instructions`.
//!
//! Requires QEMU with `-icount shift=0`, where every instruction takes one nanosecond of the
//! emulated clock, and semihosting to print the table. Counts instructions, not cycles: the same
//! number in every run on any host.
#![no_std]
#![no_main]

mod coder;
mod counter;
mod drive;
mod ending;
mod locate;
mod memory;
mod planes;
#[cfg(feature = "seals")]
mod seals;
mod sense;
mod standing;
mod table;
mod vector;

use core::hint::black_box;

use cortex_m::Peripherals;
use cortex_m_rt::entry;
use cortex_m_semihosting::hprintln;
use counter::Bench;
use ending::end;
use planes::{BOUNDS, PIXELS, POSE, local_map, rows};
// Links the interrupt vectors of the chip.
use stm32f4xx_hal as _;
use ubimap_agent::{
    Config, Memory, Robot, Slices, Storage,
    map::Surround,
    memory,
    sense::{SensorModel, fill_beams},
    share::{FusedMap, Publisher},
};
use ubimap_protocol::{
    frame::{DEFAULT_FRAME, SessionId, payload_capacity},
    link::{Answer, Endpoint, Fill, Received, Terms, answer},
    message::{Body, Certainty, FixSource, Hello, PoseFix, TimeReply, ToRobot, Writer},
    time::{Duration, Instant},
    units::{Pose, RobotId},
};

/// Focal length of the rows, in pixels: 86 degrees across (Aluckal II.D).
const FOCAL: f32 = 343.1;
/// Depth of a wall across the whole view, in millimetres.
const WALL: u16 = 3_000;
/// Boxes in front of the wall: first column, end column, depth in millimetres.
const BOXES: [(usize, usize, u16); 2] = [(150, 270, 1_200), (400, 500, 1_900)];

#[entry]
fn main() -> ! {
    static mut MEMORY: memory!(BOUNDS) = Memory::EMPTY;

    let core = Peripherals::take();
    end(core.and_then(|core| run(&mut Bench::new(core.SYST), MEMORY)))
}

/// Prints the table. `None` if a stage has a wrong result.
fn run(bench: &mut Bench, memory: &mut Memory<impl Storage>) -> Option<()> {
    hprintln!("{:>12}  stage", "instructions");
    fill_beams(memory.slices().beams, sensor(), Pose::default());

    let wall = [WALL; PIXELS];
    let mut readings = wall;
    rows(bench, memory.slices(), sensor(), "a row of 640 to planes: a wall", &readings)?;
    for (from, to, depth) in BOXES {
        readings.get_mut(from..to)?.fill(depth);
    }
    rows(
        bench,
        memory.slices(),
        sensor(),
        "a row of 640 to planes: two boxes before it",
        &readings,
    )?;

    sense::run(bench, &wall, &readings)?;

    let mut frame = [0; DEFAULT_FRAME];
    let len = publish(bench, memory.slices(), &readings, &mut frame)?;
    coder::run(bench, frame.get(..len)?)?;
    vector::of_row(bench, memory.slices().beams, &readings)?;
    vector::of_image(bench)?;
    locate::run(bench)?;
    drive::run(bench)?;
    standing::run(bench, memory, sensor(), &readings)?;
    receive(bench, memory)?;
    #[cfg(feature = "seals")]
    seals::run(bench)?;
    memory::run();
    Some(())
}

fn sensor() -> SensorModel {
    SensorModel::Pinhole { focal: FOCAL, centre: (PIXELS - 1) as f32 / 2.0 }
}

/// Measures the writing of the first message: as many of the scene's tiles as fit in one frame.
/// Returns the message's length in bytes.
fn publish(
    bench: &mut Bench,
    memory: Slices<'_>,
    readings: &[u16],
    payload: &mut [u8],
) -> Option<usize> {
    let mut map = local_map(sensor(), memory.beams, memory.scratch, memory.own);
    let merged = FusedMap::new(memory.fused);
    map.add(memory.beams, readings, (POSE, u16::MAX), |_| Surround::default())?;
    let mut publisher = Publisher::new(Duration(0));
    publisher.changed(Instant(0), None);
    let mut writer = Writer::new(payload.get_mut(..payload_capacity(DEFAULT_FRAME))?);
    bench.measure("the tiles that fit a frame, from planes to a message", || {
        publisher.fill(&mut map.pool, &merged, &mut writer, Instant(0))
    })?;
    Some(writer.len())
}

/// Measures the reception of a frame with a pose fix and its three predecessors, from bytes to the
/// robot's pose.
#[inline(never)]
fn receive(bench: &mut Bench, memory: &mut Memory<impl Storage>) -> Option<()> {
    let mut robot = Robot::new(Config::new(RobotId(1), sensor(), BOUNDS), memory).ok()?;
    let mut server = Endpoint::<ToRobot, (), 1, DEFAULT_FRAME>::new();
    let mut frame = [0; DEFAULT_FRAME];
    let mut now = Instant(0);

    let len = robot.poll_transmit(now, &mut frame)?;
    let Some(Received::Handshake(message)) = server.receive(&mut frame.get(..len)?, now) else {
        return None;
    };
    let hello = message.decode::<Hello>().ok()?;
    let terms = Terms {
        resolution: BOUNDS.resolution,
        frame: DEFAULT_FRAME as u16,
        server_epoch: 1,
        stores: false,
    };
    let Answer::Welcome(welcome) = answer(&hello, &terms, SessionId(1), 1) else { return None };
    let len = server.handshake(&welcome, &mut frame)?;
    robot.receive(frame.get(..len)?, now);
    server.begin(welcome.session, DEFAULT_FRAME);

    // The reply answers the robot's first time request, which has nonce 0.
    robot.poll_transmit(now, &mut frame)?;
    let reply = TimeReply { nonce: 0, received: now, held_micros: 0 };
    let len = datagram(&mut server, &reply, &mut frame, now)?;
    robot.receive(frame.get(..len)?, now);

    // Each message repeats the last three fixes, so after the first four messages the robot knows
    // three of four, as at 15 Hz without losses.
    for count in 1..=5u64 {
        now = Instant(count * 66_667);
        let before = (1..count).rev().map(|fix| (Instant(fix * 66_667), POSE));
        let certainty = Certainty::default();
        let fix = PoseFix::from_fixes((now, POSE), before, certainty, FixSource::Camera);
        let len = datagram(&mut server, &fix, &mut frame, now)?;
        let bytes = frame.get(..len)?;
        if count == 5 {
            let name = format_args!("a frame of {} bytes with a pose fix, received", bytes.len());
            bench.measure(name, || robot.receive(black_box(bytes), now));
        } else {
            robot.receive(bytes, now);
        }
    }
    (robot.statistics().fixes == 5 && robot.pose() == Some((now, POSE))).then_some(())
}

/// Writes a frame with one message. Returns its length.
fn datagram(
    server: &mut Endpoint<ToRobot, (), 1, DEFAULT_FRAME>,
    message: &impl Body<ToRobot>,
    frame: &mut [u8],
    now: Instant,
) -> Option<usize> {
    let sent = server.poll_transmit(now, frame, false, |writer, _| {
        if writer.push(message) { Fill::Datagram } else { Fill::Nothing }
    })?;
    Some(sent.len)
}

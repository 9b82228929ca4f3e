//! Instruction counts of the agent's stages: `cargo instructions`.
//!
//! It needs QEMU with `-icount shift=0`, where every instruction takes one nanosecond of the
//! emulated clock, and semihosting to print its table. It counts instructions, not cycles: the
//! same number in every run, whatever the host.
#![no_std]
#![no_main]

mod coder;
mod counter;
mod drive;
mod ending;
mod locate;
mod memory;
mod planes;
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
use planes::{MAX_RANGE, PIXELS, POSE, RESOLUTION, local_map, rows};
// For its table of interrupt vectors.
use stm32f4xx_hal as _;
use ubimap_agent::{
    Agent, Config, Memory,
    map::{OwnTile, RowSighting, Surround, scratch_words},
    sense::{Beam, SensorModel, fill_beams},
    share::{FusedMap, FusedTile, Publisher},
};
use ubimap_protocol::{
    frame::{DEFAULT_FRAME, SessionId, payload_capacity},
    link::{Answer, Endpoint, Fill, Received, Terms, answer},
    message::{Body, Certainty, FixSource, Hello, PoseFix, TimeReply, ToRobot, Writer},
    time::{Duration, Instant},
    units::{Pose, RobotId},
};

/// The focal length of the rows, in pixels: 86 degrees across (Aluckal II.D).
const FOCAL: f32 = 343.1;
/// A wall across the whole view, in millimetres of depth.
const WALL: u16 = 3_000;
/// Boxes before it: from column, to column, depth.
const BOXES: [(usize, usize, u16); 2] = [(150, 270, 1_200), (400, 500, 1_900)];

/// Places for tiles: more than a row touches.
const OWN_TILES: usize = 12;
const FUSED_TILES: usize = 9;

#[entry]
fn main() -> ! {
    static mut BEAMS: [Beam; PIXELS] = [Beam::NONE; PIXELS];
    static mut WAITING: [u16; PIXELS] = [0; _];
    static mut SCRATCH: [RowSighting; scratch_words(MAX_RANGE, RESOLUTION)] =
        [RowSighting { free: 0, hit: 0 }; _];
    static mut OWN: [OwnTile; OWN_TILES] = [OwnTile::FREE; _];
    static mut FUSED: [FusedTile; FUSED_TILES] = [FusedTile::FREE; _];

    let memory =
        Memory { beams: BEAMS, waiting: WAITING, scratch: SCRATCH, own: OWN, fused: FUSED };
    let core = Peripherals::take();
    end(core.and_then(|core| run(&mut Bench::new(core.SYST), memory)))
}

/// The table. `None` if a stage did not do what it is there for.
fn run(bench: &mut Bench, mut memory: Memory<'_>) -> Option<()> {
    hprintln!("{:>12}  stage", "instructions");
    fill_beams(memory.beams, sensor(), Pose::default());

    let wall = [WALL; PIXELS];
    let mut readings = wall;
    rows(bench, &mut memory, sensor(), "a row of 640 to planes: a wall", &readings)?;
    for (from, to, depth) in BOXES {
        readings.get_mut(from..to)?.fill(depth);
    }
    rows(bench, &mut memory, sensor(), "a row of 640 to planes: two boxes before it", &readings)?;

    sense::run(bench, &wall, &readings)?;

    let mut frame = [0; DEFAULT_FRAME];
    let len = publish(bench, &mut memory, &readings, &mut frame)?;
    coder::run(bench, frame.get(..len)?)?;
    vector::of_row(bench, memory.beams, &readings)?;
    vector::of_image(bench)?;
    locate::run(bench)?;
    drive::run(bench)?;
    standing::run(bench, reborrowed(&mut memory), sensor(), &readings)?;
    receive(bench, memory)?;
    memory::run();
    Some(())
}

/// The same memory for one stage.
fn reborrowed<'m>(memory: &'m mut Memory<'_>) -> Memory<'m> {
    let Memory { beams, waiting, scratch, own, fused } = memory;
    Memory { beams, waiting, scratch, own, fused }
}

fn sensor() -> SensorModel {
    SensorModel::Pinhole { focal: FOCAL, centre: (PIXELS - 1) as f32 / 2.0 }
}

/// A first message of the scene's tiles: as many as fit a frame. Its length.
fn publish(
    bench: &mut Bench,
    memory: &mut Memory<'_>,
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

/// A frame with a pose fix, and the three before it, from bytes to the agent's pose.
#[inline(never)]
fn receive(bench: &mut Bench, memory: Memory<'_>) -> Option<()> {
    let mut agent = Agent::new(Config::new(RobotId(1), sensor()), memory).ok()?;
    let mut server = Endpoint::<ToRobot, (), 1, DEFAULT_FRAME>::new();
    let mut frame = [0; DEFAULT_FRAME];
    let mut now = Instant(0);

    let len = agent.poll_transmit(now, &mut frame)?;
    let Some(Received::Handshake(message)) = server.receive(&mut frame.get(..len)?, now) else {
        return None;
    };
    let hello = message.decode::<Hello>().ok()?;
    let terms = Terms {
        resolution: RESOLUTION,
        frame: DEFAULT_FRAME as u16,
        server_epoch: 1,
        stores: false,
    };
    let Answer::Welcome(welcome) = answer(&hello, &terms, SessionId(1), 1) else { return None };
    let len = server.handshake(&welcome, &mut frame)?;
    agent.receive(frame.get(..len)?, now);
    server.begin(welcome.session, DEFAULT_FRAME);

    // The clocks agree: the first request has the nonce 0.
    agent.poll_transmit(now, &mut frame)?;
    let reply = TimeReply { nonce: 0, received: now, held_micros: 0 };
    let len = datagram(&mut server, &reply, &mut frame, now)?;
    agent.receive(frame.get(..len)?, now);

    // Each time three of four are known, as at 15 Hz without a loss.
    for count in 1..=5u64 {
        now = Instant(count * 66_667);
        let before = (1..count).rev().map(|fix| (Instant(fix * 66_667), POSE));
        let certainty = Certainty::default();
        let fix = PoseFix::from_fixes((now, POSE), before, certainty, FixSource::Camera);
        let len = datagram(&mut server, &fix, &mut frame, now)?;
        let bytes = frame.get(..len)?;
        if count == 5 {
            let name = format_args!("a frame of {} bytes with a pose fix, received", bytes.len());
            bench.measure(name, || agent.receive(black_box(bytes), now));
        } else {
            agent.receive(bytes, now);
        }
    }
    (agent.statistics().fixes == 5 && agent.pose() == Some((now, POSE))).then_some(())
}

/// A frame with one message. Its length.
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

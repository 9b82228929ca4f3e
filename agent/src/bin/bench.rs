//! Instruction counts of the agent's stages: `cargo instructions`.
//!
//! It needs QEMU with `-icount shift=0`, where every instruction takes one nanosecond of the
//! emulated clock, and semihosting to print its table. It counts instructions, not cycles: the
//! same number in every run, whatever the host.
#![no_std]
#![no_main]

use core::{hint::black_box, panic::PanicInfo};

use cortex_m::{
    Peripherals, asm,
    peripheral::{SYST, syst::SystClkSource},
};
use cortex_m_rt::entry;
use cortex_m_semihosting::{debug, hprintln};
// For its table of interrupt vectors.
use stm32f4xx_hal as _;
use ubimap_agent::{
    Agent, Config, Memory,
    map::{LocalMap, MappingConfig, Omission, OwnTile, Pool, RowSighting, scratch_words},
    sense::{Beam, SensorModel, fill_beams},
    share::{FusedMap, FusedTile, Publisher},
};
use ubimap_protocol::{
    frame::{DEFAULT_FRAME, Direction, SessionId, payload_capacity},
    link::{Answer, Endpoint, Fill, Received, Terms, answer},
    message::{
        Certainty, FixSource, Hello, Messages, PoseFix, TileUpdateHead, ToRobotKind, Writer, decode,
    },
    tile::{Epoch, Replica, Stamp, Tile, TileDecoder, TileEncoder, TileId, Version},
    time::{Duration, Instant},
    units::{Angle, Millimetres, Pose, RobotId},
};

/// Pixels of a depth row (Aluckal II.D), and their focal length: 86 degrees across.
const PIXELS: usize = 640;
const FOCAL: f32 = 343.1;
/// The range that is mapped, in millimetres, and the cells.
const MAX_RANGE: u16 = 4_000;
const RESOLUTION: Millimetres = Millimetres(50);
/// Where the rows are taken: along no axis.
const POSE: Pose = Pose { x: Millimetres(310), y: Millimetres(-170), heading: Angle(5_000) };
/// A wall across the whole view, in millimetres of depth.
const WALL: u16 = 3_000;
/// Boxes before it: from column, to column, depth.
const BOXES: [(usize, usize, u16); 2] = [(150, 270, 1_200), (400, 500, 1_900)];

/// Places for tiles: more than a row touches.
const OWN_TILES: usize = 24;
const FUSED_TILES: usize = 16;

/// SysTick's clock in the emulator.
const CORE_HZ: u64 = 168_000_000;

/// One instruction is one nanosecond.
const INSTRUCTIONS_PER_SECOND: u64 = 1_000_000_000;

/// SysTick's period, the longest it has: 99.8 million instructions.
const PERIOD: u32 = 1 << 24;

#[entry]
fn main() -> ! {
    static mut BEAMS: [Beam; PIXELS] = [Beam { forward: 0, left: 0, limit: 0 }; PIXELS];
    static mut WAITING: [u16; PIXELS] = [0; _];
    static mut SCRATCH: [RowSighting; scratch_words(MAX_RANGE, RESOLUTION)] =
        [RowSighting { free: 0, hit: 0 }; _];
    static mut OWN: [OwnTile; OWN_TILES] = [OwnTile::FREE; _];
    static mut FUSED: [FusedTile; FUSED_TILES] = [FusedTile::FREE; _];

    let memory =
        Memory { beams: BEAMS, waiting: WAITING, scratch: SCRATCH, own: OWN, fused: FUSED };
    let core = Peripherals::take();
    match core.and_then(|core| run(&mut Bench::new(core.SYST), memory)) {
        Some(()) => debug::exit(debug::EXIT_SUCCESS),
        None => debug::exit(debug::EXIT_FAILURE),
    }
    loop {
        asm::wfi();
    }
}

/// The table. `None` if a stage did not do what it is there for.
fn run(bench: &mut Bench, mut memory: Memory<'_>) -> Option<()> {
    hprintln!("{:>12}  stage", "instructions");
    fill_beams(memory.beams, sensor(), Pose::default(), MAX_RANGE);

    let mut readings = [WALL; PIXELS];
    rows(bench, &mut memory, "a wall", &readings)?;
    for (from, to, depth) in BOXES {
        readings.get_mut(from..to)?.fill(depth);
    }
    rows(bench, &mut memory, "two boxes before it", &readings)?;

    let mut frame = [0; DEFAULT_FRAME];
    let len = publish(bench, &mut memory, &readings, &mut frame)?;
    let tile = fullest_tile(frame.get(..len)?)?;
    code(bench, &tile)?;
    receive(bench, memory)
}

fn sensor() -> SensorModel {
    SensorModel::Pinhole { focal: FOCAL, centre: (PIXELS - 1) as f32 / 2.0 }
}

/// The robot layer with nothing in it.
fn local_map<'m>(
    beams: &[Beam],
    scratch: &'m mut [RowSighting],
    own: &'m mut [OwnTile],
) -> LocalMap<'m> {
    let (resolution, max_range, mounting) = (RESOLUTION, MAX_RANGE, Pose::default());
    let omission = Omission::default();
    let config = MappingConfig { resolution, max_range, mounting, omission };
    LocalMap::new(config, beams, scratch, Pool::new(own))
}

/// A row from readings to evidence planes, and the same row once more.
fn rows(
    bench: &mut Bench,
    memory: &mut Memory<'_>,
    scene: &str,
    readings: &[u16; PIXELS],
) -> Option<()> {
    let mut map = local_map(memory.beams, memory.scratch, memory.own);
    for time in ["new", "known"] {
        let mapped = bench
            .measure(format_args!("a row of {PIXELS} to planes: {scene}, {time}"), || {
                map.add(memory.beams, black_box(readings), black_box(POSE), |_| None)
            });
        (mapped?.cells_refused == 0).then_some(())?;
    }
    Some(())
}

/// A first message of the scene's tiles: as many as fit a frame. Its length.
fn publish(
    bench: &mut Bench,
    memory: &mut Memory<'_>,
    readings: &[u16],
    payload: &mut [u8],
) -> Option<usize> {
    let mut map = local_map(memory.beams, memory.scratch, memory.own);
    let merged = FusedMap::new(memory.fused);
    map.add(memory.beams, readings, POSE, |_| None)?;
    let mut publisher = Publisher::new(Duration(0));
    publisher.changed(Instant(0), None);
    let mut writer = Writer::new(payload.get_mut(..payload_capacity(DEFAULT_FRAME))?);
    bench.measure("the tiles that fit a frame, from planes to a message", || {
        publisher.fill(&mut map.pool, &merged, &mut writer, Instant(0))
    })?;
    Some(writer.len())
}

/// The whole tile of a message of which most is known.
fn fullest_tile(message: &[u8]) -> Option<Tile> {
    let message = Messages::new(message).next()?.ok()?;
    let (_, coded) = decode::<TileUpdateHead>(message.body).ok()?;
    let mut decoder = TileDecoder::new(coded);
    let mut fullest = Tile::UNKNOWN;
    while let Some(header) = decoder.header().ok()? {
        let mut replica = Replica::NOTHING;
        replica.apply(&header, &mut decoder).ok()?;
        if replica.tile().counts().0 > fullest.counts().0 {
            fullest = *replica.tile();
        }
    }
    (fullest != Tile::UNKNOWN).then_some(fullest)
}

/// An update of one tile, coded and read.
fn code(bench: &mut Bench, tile: &Tile) -> Option<()> {
    let (known, free, occupied) = tile.counts();
    let id = TileId { x: 1, y: -1 };
    let stamp = Stamp { epoch: Epoch(1), version: Version(1) };
    let mut out = [0; DEFAULT_FRAME];
    let len = bench.measure(
        format_args!("a new tile ({known} cells: {free} free, {occupied} occupied) to bytes"),
        || {
            let mut encoder = TileEncoder::new(&mut out);
            encoder.push(id, stamp, None, 0, &Tile::UNKNOWN, black_box(tile))?;
            encoder.finish()
        },
    )?;
    let coded = black_box(out.get(..len)?);
    let read = bench.measure(format_args!("its {len} bytes to a tile"), || {
        let mut decoder = TileDecoder::new(coded);
        let header = decoder.header().ok()??;
        let mut read = Tile::UNKNOWN;
        decoder.cells(&header, &mut read);
        Some(read)
    })?;
    (read == *tile).then_some(())
}

/// A frame with a pose fix, and the three before it, from bytes to the agent's pose.
fn receive(bench: &mut Bench, memory: Memory<'_>) -> Option<()> {
    let mut agent = Agent::new(Config::new(RobotId(1), sensor()), memory).ok()?;
    let mut server = Endpoint::<(), 1, DEFAULT_FRAME>::new(Direction::ToRobot);
    let mut frame = [0; DEFAULT_FRAME];
    let mut now = Instant(0);

    let len = agent.poll_transmit(now, &mut frame)?;
    let Some(Received::Handshake(message)) = server.receive(&mut frame.get(..len)?, now) else {
        return None;
    };
    let (hello, _) = decode::<Hello>(message.body).ok()?;
    let terms = Terms {
        resolution: RESOLUTION,
        frame: DEFAULT_FRAME as u16,
        server_epoch: 1,
        stores: false,
    };
    let Answer::Welcome(welcome) = answer(&hello, &terms, SessionId(1), 1) else { return None };
    let len = server.handshake(ToRobotKind::Welcome as u8, &welcome, &mut frame)?;
    agent.receive(frame.get(..len)?, now);
    server.begin(welcome.session, DEFAULT_FRAME);

    // Each time three of four are known, as at 15 Hz without a loss.
    for count in 1..=5u64 {
        now = Instant(count * 66_667);
        let fixes = (0..count).rev().map(|fix| (Instant((fix + 1) * 66_667), POSE));
        let fix = PoseFix::from_fixes(fixes, Certainty::default(), FixSource::Camera)?;
        let sent = server.poll_transmit(now, &mut frame, false, |writer, _| {
            if writer.push(ToRobotKind::PoseFix as u8, &fix) {
                Fill::Datagram
            } else {
                Fill::Nothing
            }
        })?;
        let bytes = frame.get(..sent.len)?;
        if count == 5 {
            let name = format_args!("a frame of {} bytes with a pose fix, received", bytes.len());
            bench.measure(name, || agent.receive(black_box(bytes), now));
        } else {
            agent.receive(bytes, now);
        }
    }
    (agent.statistics().fixes == 5 && agent.pose() == Some((now, POSE))).then_some(())
}

/// Measures by SysTick.
struct Bench {
    systick: SYST,
    /// What measuring nothing takes.
    overhead: u32,
}

impl Bench {
    fn new(mut systick: SYST) -> Self {
        systick.set_clock_source(SystClkSource::Core);
        systick.set_reload(PERIOD - 1);
        systick.clear_current();
        systick.enable_counter();
        // From zero it steps to the top.
        while SYST::get_current() == 0 {}
        let mut bench = Self { systick, overhead: 0 };
        bench.overhead = bench.ticks(|| ()).1.unwrap_or(0);
        bench
    }

    /// Runs a stage once and prints a line of the table, exact to a tick: six instructions.
    fn measure<T>(&mut self, name: impl core::fmt::Display, stage: impl FnOnce() -> T) -> T {
        let (result, ticks) = self.ticks(stage);
        match ticks {
            Some(ticks) => {
                let net = u64::from(ticks.saturating_sub(self.overhead));
                hprintln!("{:>12}  {}", net * INSTRUCTIONS_PER_SECOND / CORE_HZ, name);
            }
            None => hprintln!("{:>12}  {}", "too many", name),
        }
        result
    }

    /// What a stage gives, and the ticks that it takes; `None` if they may be more than a period.
    fn ticks<T>(&mut self, stage: impl FnOnce() -> T) -> (T, Option<u32>) {
        // It counts down, and wraps at most once within a period.
        self.systick.has_wrapped();
        let start = SYST::get_current();
        let result = black_box(stage());
        let end = SYST::get_current();
        let wrapped = self.systick.has_wrapped();
        let ticks = match (wrapped, start.checked_sub(end)) {
            (false, ticks) => ticks,
            (true, None) => Some(start + PERIOD - end),
            (true, Some(_)) => None,
        };
        (result, ticks)
    }
}

#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    debug::exit(debug::EXIT_FAILURE);
    loop {
        asm::wfi();
    }
}

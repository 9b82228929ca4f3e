//! Instruction counts from a row of a depth frame to the bit planes of the evidence.

use core::hint::black_box;

use ubimap_agent::{
    Bounds, Slices,
    map::{LocalMap, MappingConfig, OwnTile, Policy, Pool, RowSighting, Surround},
    sense::{Beam, SensorModel, Validity, WaitingScans},
};
use ubimap_protocol::{
    time::Instant,
    units::{Angle, Millimetres, Pose},
};

use crate::counter::Bench;

/// Pixels per depth row (Aluckal II.D).
pub(crate) const PIXELS: usize = 640;
/// Bounds with more tiles than a row touches.
pub(crate) const BOUNDS: Bounds =
    Bounds { readings: PIXELS, waiting: 1, own_tiles: 12, fused_tiles: 9, ..Bounds::DEFAULT };
/// The pose at which the rows are taken, not aligned with the axes.
pub(crate) const POSE: Pose =
    Pose { x: Millimetres(310), y: Millimetres(-170), heading: Angle(5_000) };

/// An empty robot layer.
pub(crate) fn local_map<'m>(
    sensor: SensorModel,
    beams: &[Beam],
    scratch: &'m mut [RowSighting],
    own: &'m mut [OwnTile],
) -> LocalMap<'m> {
    let (resolution, max_range, mounting) = (BOUNDS.resolution, BOUNDS.max_range, Pose::default());
    let (validity, policy) = (Validity::of(sensor), Policy::default());
    // The value that a robot with these bounds uses, in millimetres.
    let near = 703;
    let config = MappingConfig { resolution, max_range, near, mounting, validity, policy };
    LocalMap::new(config, beams, scratch, Pool::new(own))
}

/// Takes a row of a frame through the stages of a robot: it is copied, cleaned and drawn, and the
/// evidence is counted. Then does the same with the same row again.
pub(crate) fn rows(
    bench: &mut Bench,
    memory: Slices<'_>,
    sensor: SensorModel,
    scene: impl core::fmt::Display,
    readings: &[u16; PIXELS],
) -> Option<()> {
    let mut map = local_map(sensor, memory.beams, memory.scratch, memory.own);
    let mut waiting = WaitingScans::new(memory.waiting, PIXELS);
    for time in ["new", "known"] {
        let name = format_args!("{scene}, {time}");
        let mapped = bench.measure(name, || {
            waiting.push(Instant(0), black_box(readings)).ok()?;
            map.add(memory.beams, waiting.pop()?, (black_box(POSE), u16::MAX), |_| {
                Surround::default()
            })
        });
        (mapped?.cells_refused == 0).then_some(())?;
    }
    Some(())
}

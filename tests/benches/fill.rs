//! Speed of mapping a scan on a PC: the robot's polygon, compared with a line of cells per beam.

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use ubimap_agent::{
    Bounds, Config, Memory, Settings,
    map::{LocalMap, Pool, Surround},
    sense::fill_beams,
};
use ubimap_protocol::{
    time::Instant,
    units::{Pose, RobotId},
};
use ubimap_sim_host::run::heap::{BOUNDS, Heap};
use ubimap_tests::{
    boxes::{Boxes, Fan},
    per_ray,
};

/// A depth row of 640 pixels across 86 degrees, to 4 m.
const FAN: Fan = Fan { beams: 640, angle: 1.5 };

fn fill(criterion: &mut Criterion) {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let room = Boxes::random(&mut rng);
    let pose = Pose::from_metres(0.31, -0.17, 0.48);
    let readings = room.scan(FAN, pose, Instant(0));
    let bounds = Bounds { readings: FAN.beams, ..BOUNDS };
    let settings = Settings::from(&Config::new(RobotId(1), FAN.model(), bounds));
    let mut memory = Memory::<Heap>::new(&bounds);
    let memory = memory.slices();
    fill_beams(memory.beams, settings.sensor, settings.mounting);
    let mut map =
        LocalMap::new((&settings).into(), memory.beams, memory.scratch, Pool::new(memory.own));

    let mut group = criterion.benchmark_group("a scan of 640 beams");
    group.bench_function("the polygon, into evidence planes", |bench| {
        bench.iter(|| {
            map.add(memory.beams, black_box(&readings), (black_box(pose), u16::MAX), |_| {
                Surround::default()
            })
        });
    });
    group.bench_function("a line of cells for each beam, into sets", |bench| {
        bench.iter(|| {
            let beams = black_box(&readings).iter().enumerate().map(|(beam, &reading)| {
                let place = beam as f64 / (FAN.beams - 1) as f64 - 0.5;
                (pose.heading.radians() + place * FAN.angle, f64::from(reading) / 1_000.0)
            });
            per_ray::scan([pose.x.metres(), pose.y.metres()], beams, 0.05, 4.0)
        });
    });
    group.finish();
}

criterion_group!(benches, fill);
criterion_main!(benches);

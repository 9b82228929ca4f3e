//! Fusing depth images into evidence: many pixels at a time, and pixel by pixel.
//!
//! `cargo bench -p ubimap-sim-host --bench fusing` prints the throughput of both in pixels per
//! second, and their ratio; `cargo camera-server` prints only the ratio.

use std::time::{Duration, Instant as Clock};

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use ubimap_protocol::time::Instant;
use ubimap_sim_host::{
    camera::{DepthImage, DepthNoise, Intrinsics, Lens},
    perception::{Background, Evidence, RayTable, Survey},
};

#[path = "../src/perception/testing/boxes.rs"]
mod boxes;

/// Number of repetitions; the time of the fastest is reported.
const ROUNDS: usize = 200;

/// A corner of a room with a cupboard and a table, and a person unless `is_empty`.
fn room(is_empty: bool) -> Vec<boxes::Cuboid> {
    let mut room = vec![
        [[-4.0, 3.0, 0.0], [4.0, 3.1, 3.0]],
        [[3.0, -4.0, 0.0], [3.1, 4.0, 3.0]],
        [[2.4, 0.0, 0.0], [3.0, 1.2, 1.8]],
        [[0.0, 2.0, 0.70], [1.4, 2.8, 0.74]],
    ];
    if !is_empty {
        room.push([[0.5, 0.5, 0.0], [0.9, 1.0, 1.75]]);
    }
    room
}

fn fusing(criterion: &mut Criterion) {
    let lens = boxes::lens(640, 480, [-0.5, -0.5, 2.8], [1.2, 1.2, 0.0]);
    let rays = RayTable::new(&lens, &DepthNoise::D435, Survey::default());
    let mut background = Background::new(&rays);
    let empty = boxes::render(&lens, 0.0, &room(true));
    let taken = vec![false; rays.cells()];
    for frame in 0..15 {
        let image = boxes::noisy(&empty, &DepthNoise::D435, frame, 980);
        background.learn(&rays, &image, Instant(frame * 300_000), &taken);
    }
    // 2 % of the pixels are invalid.
    for (what, is_empty) in [("an empty room", true), ("a room with a person in it", false)] {
        let scene = boxes::render(&lens, 0.0, &room(is_empty));
        let images: Vec<DepthImage> =
            (100..108).map(|seed| boxes::noisy(&scene, &DepthNoise::D435, seed, 980)).collect();
        let mut group = criterion.benchmark_group(what);
        group.throughput(Throughput::Elements(640 * 480));
        let mut evidence = Evidence::default();
        let mut turn = images.iter().cycle();
        group.bench_function("by windows", |bencher| {
            bencher.iter(|| evidence.fuse(&rays, &background, turn.next().map_or(&[], |it| it)));
        });
        group.bench_function("pixel by pixel", |bencher| {
            bencher.iter(|| evidence.scatter(&rays, &background, turn.next().map_or(&[], |it| it)));
        });
        group.finish();
        // The two alternate, so that both run under the same load.
        let [mut windows, mut pixels] = [Duration::MAX; 2];
        for image in images.iter().cycle().take(ROUNDS) {
            windows = windows.min(time(|| evidence.fuse(&rays, &background, image)));
            pixels = pixels.min(time(|| evidence.scatter(&rays, &background, image)));
        }
        println!(
            "{what}: 640 x 480 depth fused in {:.2} ms, {:.1} times as fast as pixel by pixel",
            windows.as_secs_f64() * 1e3,
            pixels.as_secs_f64() / windows.as_secs_f64()
        );
    }
}

fn time(work: impl FnOnce()) -> Duration {
    let began = Clock::now();
    work();
    began.elapsed()
}

criterion_group!(benches, fusing);
criterion_main!(benches);

//! Captures the frames of simulated cameras; they may arrive late, out of order, or not at all.
//!
//! A frame is rendered only when it is polled. Until then it holds the scene, which all cameras
//! share at one time, and its own seed for the noise. So the frames of several cameras can be
//! rendered in parallel with the same result.

use std::{collections::BTreeMap, num::NonZero, sync::Arc, thread};

use nalgebra::Isometry3;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Exp1};
use ubimap_protocol::time::{Duration, Instant};

use super::{
    cadence::FrameSchedule,
    displacement::displaced,
    render::{FrameCamera, Scene},
    scenario::{CameraConfig, KnockConfig},
};
use crate::camera::{Calibration, CalibrationError, Frame};

/// All cameras and their frames in flight.
pub(super) struct Filming {
    calibrations: Vec<Calibration>,
    shutters: Vec<Shutter>,
    /// Ordered by arrival, then capture, then camera.
    under_way: BTreeMap<(Instant, Instant, usize), Shot>,
    threads: usize,
}

/// A camera and its capture times.
struct Shutter {
    camera: FrameCamera,
    times: FrameSchedule,
    knocks: Vec<KnockConfig>,
    /// Mean additional latency in microseconds.
    jitter: f64,
    lost: f64,
    dice: ChaCha8Rng,
}

/// A frame in flight.
enum Shot {
    /// Not rendered yet.
    Taken(Exposure),
    Drawn(Option<Frame>),
}

/// What a frame will show.
#[derive(Clone)]
struct Exposure {
    scene: Arc<Scene>,
    /// The true pose of the camera; `None` if it has never moved.
    pose: Option<Isometry3<f64>>,
    /// The seed of the noise.
    seed: u64,
}

/// A frame to be rendered.
struct Job<'c> {
    key: (Instant, Instant, usize),
    camera: &'c mut FrameCamera,
    exposure: Exposure,
}

impl Filming {
    /// Cameras with grey or colour pictures; `dice` gives the random numbers of each.
    pub(super) fn new(
        configs: &[CameraConfig],
        in_colour: bool,
        dice: impl Fn(usize) -> ChaCha8Rng,
    ) -> Result<Self, (usize, CalibrationError)> {
        let shutter = |(index, config): (usize, &CameraConfig)| {
            let mut dice = dice(index);
            let noise = ChaCha8Rng::seed_from_u64(dice.random());
            let camera = FrameCamera::new(config, in_colour, noise);
            Ok(Shutter {
                camera: camera.map_err(|error| (index, error))?,
                times: FrameSchedule::new(config),
                knocks: config.knocks.clone(),
                jitter: config.latency_jitter_ms * 1000.0,
                lost: config.lost_frames,
                dice,
            })
        };
        let shutters: Vec<Shutter> =
            configs.iter().enumerate().map(shutter).collect::<Result<_, _>>()?;
        Ok(Self {
            calibrations: shutters.iter().map(|shutter| shutter.camera.calibration()).collect(),
            shutters,
            under_way: BTreeMap::new(),
            threads: thread::available_parallelism().map_or(1, NonZero::get),
        })
    }

    /// The calibrations of the cameras.
    pub(super) fn calibrations(&self) -> &[Calibration] {
        &self.calibrations
    }

    /// Captures the frames that are due now.
    pub(super) fn take(&mut self, now: Instant, scene: impl FnOnce() -> Scene) {
        let mut scene = Some(scene);
        let mut taken: Option<Arc<Scene>> = None;
        for (index, shutter) in self.shutters.iter_mut().enumerate() {
            if !shutter.times.is_due(now) {
                continue;
            }
            // The same random numbers are drawn whether the frame is lost or not.
            let (late, fate): (f64, f64) =
                (Exp1.sample(&mut shutter.dice), shutter.dice.random_range(0.0..1.0));
            let seed = shutter.dice.random();
            if fate < shutter.lost || shutter.times.has_failed(now) {
                continue;
            }
            if let Some(scene) = scene.take() {
                taken = Some(Arc::new(scene()));
            }
            let delay = Duration::from_micros((late * shutter.jitter).round() as u64);
            let arrival = now + shutter.times.latency() + delay;
            if let Some(scene) = &taken {
                let exposure = Exposure { scene: scene.clone(), pose: shutter.pose(now), seed };
                self.under_way.insert((arrival, now, index), Shot::Taken(exposure));
            }
        }
    }

    /// The next frame that has arrived by `now`, in order of arrival.
    pub(super) fn poll(&mut self, now: Instant) -> Option<Frame> {
        loop {
            let (&(arrival, ..), shot) = self.under_way.first_key_value()?;
            if arrival > now {
                return None;
            }
            if matches!(shot, Shot::Taken(..)) {
                self.draw();
            }
            if let (_, Shot::Drawn(Some(frame))) = self.under_way.pop_first()? {
                return Some(frame);
            }
        }
    }

    /// Drops the frames that have arrived by `now`, without rendering them.
    pub(super) fn skip(&mut self, now: Instant) {
        while let Some(first) = self.under_way.first_entry()
            && first.key().0 <= now
        {
            first.remove();
        }
    }

    /// The earliest arrival of the next frame.
    pub(super) fn next_arrival(&self) -> Option<Instant> {
        let under_way = self.under_way.keys().map(|&(arrival, ..)| arrival).next();
        let coming = self.shutters.iter().filter_map(|shutter| shutter.times.next_arrival());
        under_way.into_iter().chain(coming).min()
    }

    /// Renders the next frame in flight of each camera.
    fn draw(&mut self) {
        let mut jobs: Vec<Job<'_>> = Vec::new();
        for (index, shutter) in self.shutters.iter_mut().enumerate() {
            let mut shots = self.under_way.iter();
            let next = shots.find_map(|(&key, shot)| match shot {
                Shot::Taken(exposure) if key.2 == index => Some((key, exposure.clone())),
                _ => None,
            });
            if let Some((key, exposure)) = next {
                jobs.push(Job { key, camera: &mut shutter.camera, exposure });
            }
        }
        let share = jobs.len().div_ceil(self.threads).max(1);
        let drawn: Vec<((Instant, Instant, usize), Option<Frame>)> = if jobs.len() <= share {
            jobs.iter_mut().map(Job::draw).collect()
        } else {
            thread::scope(|scope| {
                let at_work: Vec<_> = jobs
                    .chunks_mut(share)
                    .map(|jobs| scope.spawn(|| jobs.iter_mut().map(Job::draw).collect::<Vec<_>>()))
                    .collect();
                at_work.into_iter().flat_map(|thread| thread.join().unwrap_or_default()).collect()
            })
        };
        for (key, frame) in drawn {
            self.under_way.insert(key, Shot::Drawn(frame));
        }
    }
}

impl Shutter {
    /// The true pose at a moment; `None` for a camera that never moves.
    fn pose(&self, now: Instant) -> Option<Isometry3<f64>> {
        let stated = self.camera.stated_pose().filter(|_| !self.knocks.is_empty())?;
        Some(displaced(stated, &self.knocks, now))
    }
}

impl Job<'_> {
    fn draw(&mut self) -> ((Instant, Instant, usize), Option<Frame>) {
        let (_, captured, camera) = self.key;
        let Exposure { scene, pose, seed } = &self.exposure;
        if let Some(pose) = pose {
            self.camera.stand(pose);
        }
        let images = self.camera.take(scene, &mut ChaCha8Rng::seed_from_u64(*seed));
        let frame = images.map(|(depth, picture)| Frame {
            camera,
            captured,
            depth: self.camera.has_depth().then_some(depth),
            picture: Some(picture),
        });
        (self.key, frame)
    }
}

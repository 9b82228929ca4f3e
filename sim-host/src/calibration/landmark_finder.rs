//! Finds landmarks and the floor in the frames of cameras whose poses are unknown: the markers of
//! robots that drive about.
//!
//! A camera's depth images give the plane of its floor. A marker is level at a known height, so that
//! its place is where the rays of its points meet the plane at that height. This is far more exact than
//! the marker's size, or the depth at the marker.

use std::collections::BTreeMap;

use nalgebra::{Isometry3, Point3, Vector3};
use ubimap_protocol::time::{Duration, Instant};

use super::{
    moving_landmarks::{Trail, places},
    observations::{CameraObservations, Floor, Landmark, Observations},
    point_noise::PointNoise,
};
use crate::{
    camera::{Calibration, DepthNoise, Frame, Intrinsics, Picture},
    perception::{
        DepthSamples, FloorPlane,
        markers::{Identifier, ImageRegion, Marker, Mount, TagDetector, detect_colours},
    },
};

/// Interval at which a whole picture is searched; in between only around the last markers.
const EVERYWHERE: Duration = Duration::from_millis(500);
/// Radius of the search around a marker, in units of its size in the picture.
const REACH: f64 = 2.0;
/// Minimum interval between two depth images.
const DEPTH_INTERVAL: Duration = Duration::from_millis(900);
/// Maximum ratio of a marker's size on the assumed plane and its true size, and its inverse.
const SIZE_RATIO: f64 = 1.1;
/// Number of markers that decide whether a plane is the floor.
const JUDGES: usize = 40;
/// Standard deviation of a marker's place, across and along its ray, in metres: errors of the lens and
/// of the printed marker.
const LATERAL_M: f64 = 0.003;
const ALONG_M: f64 = 0.006;

/// Finds landmarks in frames.
#[derive(Debug)]
pub struct LandmarkFinder {
    viewers: Vec<Viewer>,
    mounts: BTreeMap<Identifier, Mount>,
    tags: TagDetector,
}

/// What one camera has seen.
#[derive(Debug)]
struct Viewer {
    samples: Option<DepthSamples>,
    next_depth: Instant,
    /// The picture's intrinsics, and its pose in the optical frame of the depth sensor.
    picture: Option<(Intrinsics, Isometry3<f64>)>,
    next_search: Instant,
    /// The regions of the last markers.
    last: Vec<ImageRegion>,
    markers: Vec<(Instant, Marker)>,
}

/// Why a camera has no landmarks.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Unseen {
    /// No depth sensor.
    #[error("it has no depth sensor, which finds the floor")]
    Depth,
    /// No picture sensor.
    #[error("it has no pictures, in which markers are found")]
    Picture,
    /// No marker was found.
    #[error("it has seen no robot's marker; drive a robot through its view")]
    Marker,
    /// No floor was found.
    #[error("its depth images show no floor on which the markers have their stated size")]
    Floor,
}

impl LandmarkFinder {
    /// A finder for cameras and the markers of robots. Of the cameras' poses only that of the picture
    /// relative to the depth sensor is used.
    pub fn new(
        cameras: &[Calibration],
        markers: impl IntoIterator<Item = (Identifier, Mount)>,
    ) -> Self {
        let viewers = cameras.iter().map(|camera| Viewer {
            samples: camera
                .depth
                .map(|lens| DepthSamples::new(lens.intrinsics(), camera.depth_noise)),
            next_depth: Instant(0),
            picture: camera.picture.map(|lens| {
                let depth = camera.depth.unwrap_or(lens);
                (*lens.intrinsics(), depth.pose().inv_mul(lens.pose()))
            }),
            next_search: Instant(0),
            last: Vec::new(),
            markers: Vec::new(),
        });
        Self {
            viewers: viewers.collect(),
            mounts: markers.into_iter().collect(),
            tags: TagDetector::default(),
        }
    }

    /// Searches a frame. Frames of one camera come in the order of their capture; one that is late
    /// is ignored.
    pub fn add(&mut self, frame: &Frame) {
        let Some(viewer) = self.viewers.get_mut(frame.camera) else { return };
        let captured = frame.captured;
        if let (Some(samples), Some(depth)) = (&mut viewer.samples, &frame.depth)
            && captured >= viewer.next_depth
            && !samples.is_full()
        {
            viewer.next_depth = captured + DEPTH_INTERVAL;
            samples.add(depth);
        }
        let Some(picture) = &frame.picture else { return };
        if viewer.markers.last().is_some_and(|(last, _)| *last >= captured) {
            return;
        }
        let regions = if captured >= viewer.next_search {
            viewer.next_search = captured + EVERYWHERE;
            vec![ImageRegion::all(picture)]
        } else {
            std::mem::take(&mut viewer.last)
        };
        let has_colours = self.mounts.keys().any(|it| matches!(it, Identifier::Colours { .. }));
        let mut found: BTreeMap<Identifier, Marker> = BTreeMap::new();
        for region in regions {
            let mut markers = self.tags.detect(picture, region);
            if let Picture::Colour(image) = picture
                && has_colours
            {
                markers.extend(detect_colours(image, region));
            }
            let known = markers.into_iter().filter(|it| self.mounts.contains_key(&it.identifier));
            found.extend(known.map(|it| (it.identifier, it)));
        }
        viewer.last = found.values().filter_map(|marker| around(marker, picture)).collect();
        viewer.markers.extend(found.into_values().map(|marker| (captured, marker)));
    }

    /// What has been seen so far, by the cameras' names, and why cameras have no landmarks.
    pub fn finish(&self, names: &[String]) -> (Observations, Vec<(usize, Unseen)>) {
        let mut trails: BTreeMap<Identifier, BTreeMap<usize, Trail>> = BTreeMap::new();
        let mut cameras = Vec::new();
        let mut unseen = Vec::new();
        for (index, (viewer, name)) in self.viewers.iter().zip(names).enumerate() {
            let mut camera =
                CameraObservations { name: name.clone(), ..CameraObservations::default() };
            match viewer.floor(&self.mounts) {
                Ok(floor) => {
                    let stated = Floor::new(floor.normal.into_inner(), floor.height_m);
                    camera.floor = stated.map(|it| Floor { placing: Some(floor.covariance), ..it });
                    for (captured, marker) in &viewer.markers {
                        if let Some(at) = viewer.place(marker, &floor, &self.mounts) {
                            let trails = trails.entry(marker.identifier).or_default();
                            trails.entry(index).or_default().insert(*captured, at);
                        }
                    }
                }
                Err(reason) => unseen.push((index, reason)),
            }
            cameras.push(camera);
        }
        // The coefficients are valid.
        let depth = DepthNoise::new(ALONG_M, 0.0).unwrap_or_default();
        let noise = PointNoise::new(LATERAL_M, depth).unwrap_or_default();
        for (identifier, trails) in &trails {
            for (moment, seen) in places(trails) {
                let robot = self.mounts.get(identifier).map_or(0, |mount| mount.robot.0);
                let label = format!("robot {robot} at {:.1} s", moment.micros() as f64 / 1e6);
                for (camera, position) in seen {
                    let label = Some(label.clone());
                    cameras[camera].landmarks.push(Landmark { position, label, noise });
                }
            }
        }
        (Observations { cameras }, unseen)
    }
}

/// The region around a marker in which it is searched in the next picture.
fn around(marker: &Marker, picture: &Picture) -> Option<ImageRegion> {
    let middle = marker.middle();
    let from_middle = |[column, row]: &[f64; 2]| libm::hypot(column - middle[0], row - middle[1]);
    let radius = marker.points.iter().map(from_middle).fold(0.0, f64::max);
    ImageRegion::about(middle, (1.0 + REACH) * radius, picture)
}

impl Viewer {
    /// The plane of the floor, on which markers have their true size.
    fn floor(&self, mounts: &BTreeMap<Identifier, Mount>) -> Result<FloorPlane, Unseen> {
        let samples = self.samples.as_ref().ok_or(Unseen::Depth)?;
        if self.picture.is_none() {
            return Err(Unseen::Picture);
        }
        if self.markers.is_empty() {
            return Err(Unseen::Marker);
        }
        let step = self.markers.len().div_ceil(JUDGES);
        let judges = || self.markers.iter().step_by(step).map(|(_, marker)| marker);
        let fits = |floor: &FloorPlane| {
            let right = judges().filter(|marker| {
                self.size_ratio(marker, floor, mounts)
                    .is_some_and(|it| (SIZE_RATIO.recip()..SIZE_RATIO).contains(&it))
            });
            2 * right.count() > judges().count()
        };
        FloorPlane::find(samples, fits).ok_or(Unseen::Floor)
    }

    /// The points of a marker at its height above the floor.
    fn points(
        &self,
        marker: &Marker,
        floor: &FloorPlane,
        mount: &Mount,
    ) -> Option<Vec<Point3<f64>>> {
        let (intrinsics, pose) = self.picture.as_ref()?;
        let from = Point3::from(pose.translation.vector);
        let point = |&pixel: &[f64; 2]| {
            let direction: Vector3<f64> = pose.rotation * intrinsics.direction(pixel);
            floor.point_at(&from, &direction, mount.height_m)
        };
        marker.points.iter().map(point).collect()
    }

    /// The middle of a marker in the optical frame of the depth sensor, in metres.
    fn place(
        &self,
        marker: &Marker,
        floor: &FloorPlane,
        mounts: &BTreeMap<Identifier, Mount>,
    ) -> Option<Point3<f64>> {
        let ratio = self.size_ratio(marker, floor, mounts)?;
        if !(SIZE_RATIO.recip()..SIZE_RATIO).contains(&ratio) {
            return None;
        }
        let points = self.points(marker, floor, mounts.get(&marker.identifier)?)?;
        let sum: Vector3<f64> = points.iter().map(|it| it.coords).sum();
        Some((sum / points.len() as f64).into())
    }

    /// The size of a marker that lies at its height above the floor, by its true size.
    fn size_ratio(
        &self,
        marker: &Marker,
        floor: &FloorPlane,
        mounts: &BTreeMap<Identifier, Mount>,
    ) -> Option<f64> {
        let mount = mounts.get(&marker.identifier)?;
        let points = self.points(marker, floor, mount)?;
        let known = mount.points(marker.identifier);
        let along = |points: &[Vector3<f64>]| -> f64 {
            points.windows(2).map(|pair| (pair[1] - pair[0]).norm()).sum()
        };
        let known: Vec<_> = known.iter().map(|&[x, y]| Vector3::new(x, y, 0.0)).collect();
        let seen: Vec<_> = points.iter().map(|it| it.coords).collect();
        Some(along(&seen) / along(&known))
    }
}

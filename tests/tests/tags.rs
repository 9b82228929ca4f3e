//! Compares the tag detector with an independent one in Rust, on photographs and on frames of the
//! simulated room. Needs the Cargo feature `kornia`, which adds 180 packages.

use std::{
    collections::{BTreeMap, BTreeSet},
    path::Path,
    time,
};

use kornia_apriltag::{AprilTagDecoder, DecodeTagsConfig, family::TagFamilyKind};
use kornia_image::{Image, ImageSize};
use ubimap_protocol::{time::Instant, units::Millimetres};
use ubimap_sim_host::{
    camera::{FrameSource, Picture},
    perception::markers::{Identifier, ImageRegion, TagDetector},
    world::{Scenario, World},
};
use ubimap_tests::data;

/// A tag's id and the mean of its corners.
type Tag = (u16, [f64; 2]);

/// Detects the tags of a picture.
type Detect = fn(&Picture) -> Vec<Tag>;

/// The tags in each photograph by file name: id and centre, as found by OpenCV.
fn listed(folder: &Path) -> BTreeMap<String, Vec<Tag>> {
    let list = std::fs::read_to_string(folder.join("IDS_opencv5.txt")).unwrap();
    let mut listed = BTreeMap::<String, Vec<Tag>>::new();
    for line in list.lines().filter(|line| !line.starts_with('#')) {
        let mut fields = line.split_whitespace();
        let (Some(name), Some(number)) = (fields.next(), fields.next()) else { continue };
        let numbers: Vec<f64> = fields.map(|it| it.parse().unwrap()).collect();
        let corners: Vec<[f64; 2]> = numbers.chunks_exact(2).map(|it| [it[0], it[1]]).collect();
        let tag = (number.parse().unwrap(), middle(&corners));
        listed.entry(name.to_owned()).or_default().push(tag);
    }
    listed
}

fn middle(corners: &[[f64; 2]]) -> [f64; 2] {
    let mean = |axis: usize| corners.iter().map(|it| it[axis]).sum::<f64>() / corners.len() as f64;
    [mean(0), mean(1)]
}

fn ours(picture: &Picture) -> Vec<Tag> {
    let markers = TagDetector::default().detect(picture, ImageRegion::all(picture));
    let tag = |identifier| match identifier {
        Identifier::Tag(number) => number,
        Identifier::Colours { .. } => panic!("a tag detector"),
    };
    markers.into_iter().map(|it| (tag(it.identifier), middle(&it.points))).collect()
}

fn theirs(picture: &Picture) -> Vec<Tag> {
    let grey = match picture {
        Picture::Grey(grey) => grey.clone(),
        Picture::Colour(colour) => image::imageops::grayscale(colour),
    };
    let size = ImageSize { width: grey.width() as usize, height: grey.height() as usize };
    let mut config = DecodeTagsConfig::new(vec![TagFamilyKind::Tag36H11]).unwrap();
    // With the default of 0.33, tags merge with their surroundings under a ceiling camera.
    config.threshold_split = 0.5;
    config.downscale_factor = 1;
    let mut decoder = AprilTagDecoder::new(config, size).unwrap();
    let image = Image::<u8, 1>::new(size, grey.into_raw()).unwrap();
    let found = decoder.decode(&image).unwrap();
    // Kornia puts the centres of pixels at 0.5.
    let pixel = |it: kornia_algebra::Vec2F32| [f64::from(it.x) - 0.5, f64::from(it.y) - 0.5];
    let corners = |it: [kornia_algebra::Vec2F32; 4]| it.map(pixel);
    found.iter().map(|it| (it.id, middle(&corners(it.quad.corners)))).collect()
}

/// The number of expected tags that were found within a distance in pixels, and the number of found
/// tags that were not expected.
fn compare(expected: &[Tag], found: &[Tag], within: f64) -> (usize, usize) {
    let same = |(a, [x, y]): &Tag, (b, [u, v]): &Tag| a == b && (x - u).hypot(y - v) <= within;
    let hits = expected.iter().filter(|tag| found.iter().any(|it| same(tag, it))).count();
    let more = found.iter().filter(|it| !expected.iter().any(|tag| same(tag, it))).count();
    (hits, more)
}

#[test]
fn our_detector_finds_all_tags_that_kornia_finds_in_photographs() {
    let Some(folder) = data::file("fiducials/apriltag") else { return };
    let detectors: [(&str, Detect); 2] = [("apriltag", ours), ("kornia-apriltag", theirs)];
    let (mut expected, mut hits) = (0, [0; 2]);
    let (mut more, mut took) = ([0; 2], [time::Duration::ZERO; 2]);
    for (name, tags) in listed(&folder) {
        let Ok(picture) = image::open(folder.join(&name)) else { continue };
        let picture = Picture::Colour(picture.to_rgb8());
        expected += tags.len();
        for (detector, (_, detect)) in detectors.iter().enumerate() {
            let began = time::Instant::now();
            let found = detect(&picture);
            took[detector] += began.elapsed();
            let (right, wrong) = compare(&tags, &found, 3.5);
            (hits[detector], more[detector]) = (hits[detector] + right, more[detector] + wrong);
        }
    }
    for (detector, (name, _)) in detectors.iter().enumerate() {
        let (hits, more, took) = (hits[detector], more[detector], took[detector]);
        println!("{name}: {hits} of {expected} tags, {more} not listed, {took:.0?}");
    }
    assert!(expected >= 18 && hits[0] == expected && hits[0] >= hits[1], "{hits:?}");
}

#[test]
fn both_detectors_find_the_same_robots_in_the_room() {
    let scenario = Scenario::built_in().unwrap();
    let mut world = World::new(&scenario, None, Millimetres(50), 1).unwrap();
    let (mut frames, mut both, mut only) = (0, 0, [0; 2]);
    let (mut robots, mut by_ours) = (BTreeSet::new(), BTreeSet::new());
    let (mut apart, mut farthest) = (0.0, 0.0_f64);
    for millis in (0..12_000).step_by(1_000) {
        let now = Instant(millis * 1_000);
        world.advance(now);
        let mut newest = BTreeMap::new();
        while let Some(frame) = FrameSource::poll(&mut world, now) {
            newest.insert(frame.camera, frame);
        }
        for picture in newest.into_values().filter_map(|frame| frame.picture) {
            frames += 1;
            let (ours, theirs) = (ours(&picture), theirs(&picture));
            let (same, missed) = compare(&ours, &theirs, 0.5);
            (both, only) = (both + same, [only[0] + ours.len() - same, only[1] + missed]);
            for (number, [x, y]) in &ours {
                by_ours.insert(*number);
                let other = theirs.iter().find(|it| it.0 == *number);
                let Some((_, [u, v])) = other else { continue };
                robots.insert(*number);
                let distance = (x - u).hypot(y - v);
                (apart, farthest) = (apart + distance * distance, farthest.max(distance));
            }
        }
    }
    let apart = (apart / both.max(1) as f64).sqrt();
    println!(
        "{frames} frames: {both} tags by both, {apart:.2} pixels apart (RMS), {farthest:.2} at most; \
         {} by ours only, {} by the other only",
        only[0], only[1]
    );
    assert!(frames > 40 && robots.len() == world.robots().len(), "{robots:?}");
    assert_eq!(by_ours, robots, "tags found only by ours belong to robots");
    assert!(farthest < 0.5 && only[1] * 100 <= both, "{both} {only:?}");
}

//! Detection on recorded pictures.

use std::collections::BTreeMap;

use super::super::*;
use crate::{camera::Picture, testing::shared_data};

/// A tag's number and corners.
type Tag = (u16, Vec<[f64; 2]>);

/// The tags detected in a picture.
fn detected(path: &std::path::Path) -> Vec<Tag> {
    let picture = Picture::Colour(image::open(path).unwrap().to_rgb8());
    let markers = TagDetector::default().detect(&picture, ImageRegion::all(&picture));
    let tag = |marker: Marker| match marker.identifier {
        Identifier::Tag(number) => (number, marker.points),
        Identifier::Colours { .. } => panic!("a tag detector"),
    };
    markers.into_iter().map(tag).collect()
}

#[test]
fn tags_in_photographs_are_found_where_opencv_finds_them() {
    let Some(folder) = shared_data("fiducials/apriltag") else { return };
    let list = std::fs::read_to_string(folder.join("IDS_opencv5.txt")).unwrap();
    let mut expected: BTreeMap<&str, Vec<Tag>> = BTreeMap::new();
    for line in list.lines().filter(|line| !line.starts_with('#')) {
        let fields: Vec<&str> = line.split_whitespace().collect();
        let [name, number, corners @ ..] = &fields[..] else { continue };
        let numbers: Vec<f64> = corners.iter().map(|it| it.parse().unwrap()).collect();
        let corners = numbers.chunks_exact(2).map(|pair| [pair[0], pair[1]]).collect();
        expected.entry(name).or_default().push((number.parse().unwrap(), corners));
    }
    let (mut pictures, mut tags, mut more) = (0, 0, Vec::new());
    for (name, expected) in expected {
        let path = folder.join(name);
        if !path.exists() {
            continue;
        }
        pictures += 1;
        let found = detected(&path);
        for (number, corners) in &expected {
            tags += 1;
            let same: Vec<_> = found.iter().filter(|it| it.0 == *number).collect();
            let [(_, points)] = &same[..] else { panic!("{name}: tag {number} {same:?}") };
            // The two libraries start at different corners.
            for point in points {
                let away = |corner: &[f64; 2]| (corner[0] - point[0]).hypot(corner[1] - point[1]);
                let nearest = corners.iter().map(away).fold(f64::INFINITY, f64::min);
                assert!(nearest < 3.5, "{name}: tag {number} by {nearest} pixels");
            }
        }
        let unlisted = found.iter().filter(|it| expected.iter().all(|listed| listed.0 != it.0));
        more.extend(unlisted.map(|it| (name, it.0)));
    }
    println!("{tags} of {tags} tags in {pictures} pictures; not in the list: {more:?}");
    assert!(tags >= 18 && more.len() <= 1, "{more:?}");
}

#[test]
fn markers_of_another_family_are_not_detected() {
    let Some(folder) = shared_data("fiducials/overhead_arena") else { return };
    for name in ["terrain_1.png", "terrain_2.png"] {
        assert_eq!(detected(&folder.join(name)), []);
    }
}

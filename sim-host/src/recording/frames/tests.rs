use std::path::Path;

use proptest::prelude::*;
use ubimap_protocol::time::Instant;

use super::*;
use crate::{
    camera::{Calibration, DepthNoise, Frame, FrameSource, Picture},
    perception::{Background, Evidence, RayTable, Survey},
    testing::{Folder, shared_frames},
};

mod foreign;

const INTRINSICS: &[u8] = b"width = 2\nheight = 1\nfx = 2\nfy = 2\ncx = 0.5\ncy = 0\n";

fn open(folder: &Path) -> Result<RecordedFrames, FramesError> {
    RecordedFrames::open(&[folder.to_owned()])
}

fn all(source: &mut RecordedFrames) -> Vec<Frame> {
    std::iter::from_fn(|| source.poll(Instant(u64::MAX))).collect()
}

/// A folder of one camera with three frames, whose images have two pixels.
fn one_camera(name: &str) -> Folder {
    let folder = Folder::new(name);
    folder.file("intrinsics.toml", INTRINSICS);
    folder.file("pose.txt", b"1 2 3 1 0 0 0\n");
    folder.file("depth/1.pgm", b"P2 2 1 65535 1000 0");
    folder.file("depth/2.pgm", b"P2 2 1 65535 2000 0");
    folder.file("depth/10.pgm", b"P2 2 1 65535 3000 4000");
    folder
}

#[test]
fn frames_are_returned_when_they_are_due() {
    let folder = one_camera("recorded-frames");
    let mut source = open(folder.path()).unwrap();
    let [camera] = source.cameras() else { panic!("one camera") };
    // The camera looks straight down.
    let floor = camera.depth.unwrap().direction([0.5, 0.0]) * 3.0;
    assert!((floor.z + 3.0).abs() < 1e-9, "{floor}");
    let first = source.poll(Instant(0)).unwrap();
    assert_eq!((first.camera, first.captured), (0, Instant(0)));
    assert_eq!(first.depth.unwrap().into_raw(), [1_000, 0]);
    assert_eq!(source.poll(Instant(999_999)), None);
    assert_eq!(source.next_arrival(), Some(Instant(1_000_000)));
    assert_eq!(source.poll(Instant(1_000_000)).unwrap().depth.unwrap().into_raw(), [2_000, 0]);
    let last = source.poll(Instant(9_000_000)).unwrap();
    assert_eq!(last.captured, Instant(2_000_000));
    assert_eq!(last.depth.unwrap().into_raw(), [3_000, 4_000]);
    assert_eq!((source.poll(Instant(9_000_000)), source.next_arrival()), (None, None));
    assert!(source.notes()[0].contains("no time stamps"), "{:?}", source.notes());
}

#[test]
fn a_camera_without_a_pose_is_looked_for_among_those_that_were_placed() {
    let folder = Folder::new("placed-cameras");
    folder.file("camera-01/depth/1.pgm", b"P2 4 2 65535 1000 0 0 0 0 0 0 0");
    let error = open(folder.path()).unwrap_err().to_string();
    assert!(error.contains("no pose.txt, trajectory.log or groundtruth.txt in it"), "{error}");
    let of = |name: &str| {
        format!(
            "[[cameras]]\nname = \"{name}\"\nposition_m = [1.0, 2.0, 3.0]\nheading_deg = 90.0\n\
             tilt_deg = 45.0\nhorizontal_fov_deg = 90.0\nvertical_fov_deg = 60.0\nrate_hz = 15.0\n"
        )
    };
    folder.file("cameras.toml", (of("camera-00") + &of("camera-01")).as_bytes());
    let source = open(folder.path()).unwrap();
    let lens = source.cameras()[0].depth.unwrap();
    // The middle of its image shows the floor 3 m to the north.
    let floor = lens.centre() + lens.direction([1.5, 0.5]) * 3.0 * 2f64.sqrt();
    assert!((floor - nalgebra::Point3::new(1.0, 5.0, 0.0)).norm() < 1e-9, "{floor}");
    assert!((lens.intrinsics().fx - 2.0).abs() < 1e-9);
    // A pose in the folder itself takes precedence.
    folder.file("camera-01/pose.txt", b"0 0 3 1 0 0 0\n");
    folder.file(
        "camera-01/intrinsics.toml",
        b"width = 4\nheight = 2\nfx = 9\nfy = 9\ncx = 1\ncy = 1\n",
    );
    let source = open(folder.path()).unwrap();
    let lens = source.cameras()[0].depth.unwrap();
    assert_eq!((lens.centre().x, lens.intrinsics().fx), (0.0, 9.0));
    std::fs::remove_file(folder.path().join("camera-01/pose.txt")).unwrap();
    folder.file("cameras.toml", b"[[cameras]]\nposition_m = 3\n");
    let error = open(folder.path()).unwrap_err().to_string();
    assert!(error.contains("cameras.toml: ") && error.lines().count() == 1, "{error}");
}

#[test]
fn cameras_share_a_clock_and_frames_are_ordered_by_arrival() {
    let folder = Folder::new("recorded-cameras");
    let camera = |name: &str, times: &[u8]| {
        folder.file(&format!("{name}/intrinsics.toml"), INTRINSICS);
        folder.file(&format!("{name}/pose.txt"), b"0 0 3 1 0 0 0\n");
        folder.file(&format!("{name}/times.txt"), times);
    };
    camera("b", b"# number captured arrived\n7.pgm 100.5\n8 101.5 103\n9 102 102.25\n10 110\n");
    for number in [7, 8, 9] {
        let image = format!("P2 2 1 65535 {number} 0");
        folder.file(&format!("b/depth/{number}.pgm"), image.as_bytes());
    }
    // One frame has only a picture; the pictures have a sensor of their own.
    camera("a", b"1 101\n3 102.5\n");
    folder.file("a/depth/1.pgm", b"P2 2 1 65535 1 0");
    folder.file("a/color/1.pgm", b"P2 1 2 255 10 20");
    folder.file("a/color/3.ppm", b"P3 1 2 255 1 2 3 4 5 6");
    folder.file("a/color/pose.txt", b"0 0.015 3 1 0 0 0\n");
    let tall = "width = 1\nheight = 2\nfx = 2\nfy = 2\ncx = 0\ncy = 1\n\
                distortion = [0.1, 0, 0.001, 0, 0]\n";
    folder.file("a/color/intrinsics.toml", tall.as_bytes());
    let mut source = open(folder.path()).unwrap();
    assert_eq!(source.names(), ["a", "b"]);
    let picture = source.cameras()[0].picture.unwrap();
    assert_eq!((picture.centre().y, picture.intrinsics().distortion[2]), (0.015, 0.001));
    assert!(source.cameras()[1].picture.is_none());
    assert_eq!(source.clock_s(source.end()), 103.0);
    let frames = all(&mut source);
    let order: Vec<_> = frames.iter().map(|it| (it.camera, it.captured.0 / 1_000)).collect();
    assert_eq!(order, [(1, 500), (0, 1_000), (1, 2_000), (0, 2_500), (1, 1_500)]);
    assert!(matches!(&frames[1].picture, Some(Picture::Grey(it)) if it.as_raw()[..] == [10, 20]));
    assert!(frames[3].depth.is_none());
    assert!(matches!(&frames[3].picture, Some(Picture::Colour(it)) if it.as_raw()[5] == 6));
    assert_eq!(source.counts().collect::<Vec<_>>(), [(2, 0), (3, 1)]);
}

#[test]
fn recorded_frames_read_back() {
    let folder = one_camera("recorder");
    folder.file("color/2.ppm", b"P3 2 1 255 1 2 3 4 5 6");
    folder.file("times.txt", b"1 0\n2 0.066667 0.2\n10 0.133333\n");
    let mut source = open(folder.path()).unwrap();
    let copy = folder.path().join("copy");
    let mut recorder = Recorder::create(&copy, source.cameras()).unwrap();
    let mut frames = Vec::new();
    while let Some(now) = source.next_arrival() {
        let frame = source.poll(now).unwrap();
        recorder.write(&frame, now).unwrap();
        frames.push(frame);
    }
    let mut again = open(&copy).unwrap();
    assert_eq!(again.cameras(), source.cameras());
    assert_eq!(all(&mut again), frames);
    assert_eq!(frames[1].captured.0, 133_333);
    // An interrupted recording: the last picture is incomplete, its depth image missing.
    let picture = copy.join("camera-00/color/000000066667.png");
    std::fs::rename(&picture, picture.with_extension("png.part")).unwrap();
    std::fs::remove_file(copy.join("camera-00/depth/000000133333.png")).unwrap();
    let mut again = open(&copy).unwrap();
    assert_eq!(all(&mut again).len(), 2);
    assert_eq!(again.counts().next(), Some((2, 1)));
    let error = Recorder::create(&copy, source.cameras()).unwrap_err().to_string();
    assert!(error.contains("not empty"), "{error}");
    folder.file("file", b"");
    assert!(Recorder::create(&folder.path().join("file/below"), source.cameras()).is_err());
}

#[test]
fn the_depth_noise_is_that_of_the_intrinsics_or_of_a_d435() {
    let folder = one_camera("recorded-noise");
    let noise = || open(folder.path()).map(|it| it.cameras()[0].depth_noise);
    assert_eq!(noise().unwrap(), DepthNoise::D435);
    let state =
        |noise: &str| folder.file("intrinsics.toml", &[INTRINSICS, noise.as_bytes()].concat());
    state("depth_noise = { constant_m = 0.02, quadratic_per_m = 0.001 }\n");
    assert_eq!(noise().unwrap(), DepthNoise::new(0.02, 0.001).unwrap());
    state("depth_noise = { constant_m = 20, quadratic_per_m = 0.001 }\n");
    expect(&folder, &["depth noise of 20 m plus 0.001/m", "give a constant from 0 to 1"]);
    state("depth_noise = { constant_m = 0.02 }\n");
    expect(&folder, &["intrinsics.toml: intrinsics: missing field `quadratic_per_m`"]);
}

#[test]
fn pictures_without_depth_have_one_pose_or_one_each() {
    let folder = Folder::new("recorded-pictures");
    folder.file("intrinsics.toml", INTRINSICS);
    for number in [1, 2, 3] {
        folder.file(&format!("color/{number}.ppm"), b"P3 2 1 255 1 2 3 4 5 6");
    }
    folder.file("pose.txt", b"5 0 0 3 1 0 0 0\n6.5 1 0 3 1 0 0 0\n9 2 0 3 1 0 0 0\n");
    let mut source = open(folder.path()).unwrap();
    let places = source.cameras().iter().map(|it| it.picture.unwrap().centre().x);
    assert_eq!(places.collect::<Vec<_>>(), [0.0, 1.0, 2.0]);
    // The times come from the poses.
    let captured = all(&mut source).iter().map(|it| it.captured.0).collect::<Vec<_>>();
    assert_eq!(captured, [0, 1_500_000, 4_000_000]);
    folder.file("pose.txt", b"0 0 3 1 0 0 0\n");
    assert_eq!(open(folder.path()).unwrap().cameras().len(), 1);
}

#[test]
fn all_frames_of_a_camera_without_images_are_lost() {
    let folder = one_camera("recorder-silent");
    folder.file("color/2.ppm", b"P3 2 1 255 1 2 3 4 5 6");
    let source = open(folder.path()).unwrap();
    let copy = folder.path().join("copy");
    Recorder::create(&copy, source.cameras()).unwrap();
    folder.file("copy/camera-00/times.txt", b"1 0.5\n2 0.6\n");
    let mut again = open(&copy).unwrap();
    assert_eq!((all(&mut again).len(), again.names()), (0, &["camera-00".to_owned()][..]));
    assert_eq!(again.counts().next(), Some((0, 2)));
    assert!(again.notes()[0].contains("camera-00: no image in it"), "{:?}", again.notes());
}

/// Checks that opening the folder fails with one line that contains all of `expected`.
fn expect(folder: &Folder, expected: &[&str]) {
    let error = open(folder.path()).unwrap_err().to_string();
    assert!(expected.iter().all(|it| error.contains(it)), "{error}");
    assert_eq!(error.lines().count(), 1, "{error}");
}

#[test]
fn faults_in_times_name_the_line() {
    let folder = one_camera("recorded-times");
    for (times, expected) in [
        ("1 1\n2 0.5\n10 2\n", ["times.txt:2: frame 2 was captured at 0.5 s", "set back"]),
        ("1 1\n2 1\n10 2\n", ["times.txt:2: ", "higher numbers"]),
        ("1 1\n2 2 1.5\n10 3\n", ["times.txt:2: arrived at 1.5 s", "before"]),
        ("1 1\n2 2\n2 3\n10 4\n", ["times.txt:3: frame 2 again", "line 2"]),
        ("1 1\n10 4\n", ["depth/2.pgm: no line in ", "times.txt for number 2; add one"]),
        ("1 1\n2 x\n", ["times.txt:2: ", "finite number"]),
        ("1 1\n2 1305031453359684000\n", ["times.txt:2: ", "no time in seconds"]),
        ("1 1\n2\n", ["times.txt:2: ", "when it was captured"]),
        ("1 1\n2 2\n10 99999\n", ["times.txt:3: frame 10 was captured", "a clock was set"]),
        ("1 1 99999\n", ["times.txt:1: ", "a day after it was captured"]),
    ] {
        folder.file("times.txt", times.as_bytes());
        expect(&folder, &expected);
    }
}

#[test]
fn faults_in_images_name_the_file() {
    let folder = one_camera("recorded-images");
    folder.file("depth/02.pgm", b"P2 2 1 65535 2000 0");
    expect(&folder, &["depth/2.pgm: has the number 2", "02.pgm has; number them apart"]);
    std::fs::remove_file(folder.path().join("depth/02.pgm")).unwrap();
    folder.file("depth/2.pgm", b"P2 2 2 65535 2000 0 0 0");
    expect(&folder, &["depth/2.pgm: 2 x 2 pixels where 2 x 1 are needed"]);
    folder.file("depth/2.pgm", b"P2 2 1 255 20 0");
    expect(&folder, &["depth/2.pgm: not a depth image (16-bit grey)"]);
    folder.file("depth/2.pgm", b"not an image");
    expect(&folder, &["depth/2.pgm: ", "remove the file to go on without it"]);
}

#[test]
fn faults_in_poses_say_what_to_write() {
    let folder = one_camera("recorded-poses");
    for (pose, height) in [("1 2 -3 0 0 0 1\n", "of -3 m;"), ("0 0 0 0 0 0 1\n", "of 0 m;")] {
        folder.file("pose.txt", pose.as_bytes());
        expect(
            &folder,
            &["its camera is at a height ", height, "must be above the floor: a pose is"],
        );
    }
    folder.file("pose.txt", b"1 2 3 1 0 0 0\n1 2 3 1 0 0 0\n");
    expect(&folder, &["pose.txt: 3 frames but 2 poses; write one pose, or one for each frame"]);
    let three = "1 2 3 1 0 0 0\n".repeat(3);
    for (depth, picture) in [(&three[..], "1 2 3 1 0 0 0\n"), ("1 2 3 1 0 0 0\n", &three)] {
        folder.file("pose.txt", depth.as_bytes());
        folder.file("color/1.ppm", b"P3 2 1 255 1 2 3 4 5 6");
        folder.file("color/pose.txt", picture.as_bytes());
        expect(&folder, &["color/pose.txt: ", "leave this one out for a camera that moves"]);
        std::fs::remove_dir_all(folder.path().join("color")).unwrap();
    }
    std::fs::remove_file(folder.path().join("pose.txt")).unwrap();
    expect(&folder, &["no pose.txt, trajectory.log or groundtruth.txt in it"]);
}

#[test]
fn faults_in_intrinsics_say_what_to_write() {
    let folder = one_camera("recorded-intrinsics");
    folder.file("intrinsics.toml", b"width = 2\nheight = 1\n");
    expect(&folder, &["intrinsics.toml: intrinsics: missing field `fx`"]);
    // A focal length given in millimetres.
    let text = "width = 640\nheight = 480\nfx = 1.93\nfy = 1.93\ncx = 320\ncy = 240\n";
    folder.file("intrinsics.toml", text.as_bytes());
    expect(
        &folder,
        &["intrinsics.toml: intrinsics: fx and fy see more than 170 degrees", "in pixels"],
    );
    // The intrinsics of a fixed camera are never guessed.
    std::fs::remove_file(folder.path().join("intrinsics.toml")).unwrap();
    expect(&folder, &["intrinsics.toml: intrinsics: missing; write width, height"]);
    folder.file("intrinsics.toml", INTRINSICS);
    std::fs::create_dir_all(folder.path().join("color")).unwrap();
    expect(&folder, &["color: no picture (.png, .jpg"]);
    std::fs::remove_dir(folder.path().join("color")).unwrap();
}

#[test]
fn folders_without_a_camera_or_a_common_clock_are_refused() {
    let folder = one_camera("recorded-folders");
    folder.file("empty/readme.txt", b"");
    let error = open(&folder.path().join("empty")).unwrap_err().to_string();
    assert!(error.contains("empty: no camera in it"), "{error}");
    let error = open(&folder.path().join("nowhere")).unwrap_err().to_string();
    assert!(error.contains("nowhere: No such file"), "{error}");
    folder.file("other/depth/1.pgm", b"P2 2 1 65535 1000 0");
    folder.file("other/intrinsics.toml", INTRINSICS);
    folder.file("other/pose.txt", b"1 2 3 1 0 0 0\n");
    folder.file("other/times.txt", b"1 5\n");
    let both = [folder.path().to_owned(), folder.path().join("other")];
    let error = RecordedFrames::open(&both).unwrap_err().to_string();
    let is_expected = error.contains("times.txt: missing, but ") && error.contains("one clock");
    assert!(is_expected, "{error}");
    folder.file("times.txt", b"1 1305031453\n2 1305031454\n10 1305031455\n");
    let error = RecordedFrames::open(&both).unwrap_err().to_string();
    assert!(error.contains("more than a day after") && error.contains("other/times"), "{error}");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]

    #[test]
    fn garbled_folders_never_panic(
        file in prop::sample::select(vec!["times.txt", "pose.txt", "intrinsics.toml"]),
        at in any::<prop::sample::Index>(),
        byte in prop::sample::select(b"0159-. e\n#xn\xff".to_vec()),
        length in any::<prop::sample::Index>(),
        is_cut in any::<bool>(),
    ) {
        let folder = one_camera("recorded-garbled");
        folder.file("times.txt", b"1 0.5\n2 0.75 0.8\n10 1.25\n");
        let mut bytes = std::fs::read(folder.path().join(file)).unwrap();
        let at = at.index(bytes.len());
        bytes[at] = byte;
        if is_cut {
            bytes.truncate(length.index(bytes.len() + 1));
        }
        folder.file(file, &bytes);
        match open(folder.path()) {
            Ok(mut source) => prop_assert!(all(&mut source).len() <= 3),
            Err(error) => prop_assert_eq!(error.to_string().lines().count(), 1),
        }
    }
}

#[test]
fn a_truncated_image_ends_playback() {
    let folder = one_camera("recorded-damage");
    folder.file("depth/2.pgm", b"P2 2 1 65535 2000");
    let mut source = open(folder.path()).unwrap();
    assert_eq!(all(&mut source).len(), 1);
    assert_eq!((source.next_arrival(), source.counts().next()), (None, Some((1, 0))));
    let error = source.take_fault().unwrap().to_string();
    assert!(error.contains("depth/2.pgm: not a readable image: "), "{error}");
}

/// `fuse` and `scatter` give the same evidence for real images with all their defects.
#[test]
fn fuse_and_scatter_agree_on_recorded_images() {
    for name in ["rgbd_redwood", "rgbd_frames/icl_nuim", "rgbd_frames/handheld"] {
        let Some(recorded) = shared_frames(name) else { continue };
        let mut source = open(recorded.path()).unwrap();
        assert_eq!(source.cameras().len(), 5, "{name}");
        let frames = all(&mut source);
        assert_eq!(frames.len(), 5, "{name}");
        let Calibration { depth, depth_noise: noise, .. } = source.cameras()[0];
        let lens = depth.unwrap();
        let rays = RayTable::new(&lens, &noise, Survey::default());
        let mut background = Background::new(&rays);
        let taken = vec![false; rays.cells()];
        let (mut fast, mut plain) = (Evidence::default(), Evidence::default());
        for turn in 0..17 {
            // Shows the first image during learning, then the others.
            let image = frames[(turn as usize).saturating_sub(14)].depth.as_ref().unwrap();
            fast.fuse(&rays, &background, image);
            plain.scatter(&rays, &background, image);
            assert_eq!(fast, plain, "{name}");
            background.learn(&rays, image, Instant(turn * 300_000), &taken);
        }
        assert!(background.is_learnt());
    }
}

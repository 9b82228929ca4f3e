//! Recordings in the layouts of others.

use super::*;
use crate::testing::shared_data;

const OPENCV: &[u8] = b"%YAML:1.0\n---\nimage_width: 2\nimage_height: 1\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   \
    cols: 3\n   dt: d\n   data: [ 2., 0., 0.5, 0., 2., 0., 0., 0., 1. ]\n";

fn open_scaled(folder: &Path, depth_per_metre: f64) -> Result<RecordedFrames, FramesError> {
    let reading = Reading { depth_per_metre: Some(depth_per_metre), ..Reading::default() };
    RecordedFrames::open_with(&[folder.to_owned()], reading)
}

/// The layout of TUM's RGB-D benchmark: the lists are complete, the pictures lie between the depth
/// images, and the ground truth begins late.
fn tum(name: &str, moves: bool) -> Folder {
    let folder = Folder::new(name);
    folder.file("camera_info.yaml", OPENCV);
    let mut lists = ["# depth\n# timestamp filename\n".to_owned(), String::new()];
    for frame in 0..4 {
        let (depth, picture) = (format!("{frame}.1"), format!("{frame}.11"));
        folder.file(
            &format!("depth/{depth}.pgm"),
            format!("P2 2 1 65535 {} 0", 5000 * frame).as_bytes(),
        );
        folder.file(&format!("rgb/{picture}.ppm"), b"P3 2 1 255 1 2 3 4 5 6");
        lists[0] += &format!("{depth} depth/{depth}.pgm\n");
        lists[1] += &format!("{picture} rgb/{picture}.ppm\n");
    }
    folder.file("depth.txt", lists[0].as_bytes());
    folder.file("rgb.txt", lists[1].as_bytes());
    let mut truth = "# timestamp tx ty tz qx qy qz qw\n".to_owned();
    for hundredth in 100..320 {
        let time = f64::from(hundredth) / 100.0;
        let x = if moves { time } else { 1.0 };
        truth += &format!("{time:.4} {x:.4} 2.0 3.0 1.0 0.0 0.0 0.0\n");
    }
    folder.file("groundtruth.txt", truth.as_bytes());
    folder
}

#[test]
fn the_layout_of_the_tum_benchmark_is_read() {
    let folder = tum("foreign-tum", true);
    let mut source = open_scaled(folder.path(), 5000.0).unwrap();
    // The frame before the first pose is left out.
    assert!(source.notes().iter().any(|note| note.contains("1 of 4 frames have no pose")));
    let places: Vec<f64> = source.cameras().iter().map(|it| it.depth.unwrap().centre().x).collect();
    assert!(places.iter().zip([1.1, 2.1, 3.1]).all(|(a, b)| (a - b).abs() < 1e-9), "{places:?}");
    assert_eq!((source.cameras().len(), source.clock_s(Instant(0))), (3, 1.0));
    let frames = all(&mut source);
    let of = |frame: &Frame| {
        let depth = frame.depth.as_ref().map(|it| it.as_raw()[0]);
        (frame.captured.0, depth, frame.picture.is_some())
    };
    let expected: Vec<_> =
        [1, 2, 3].map(|it| (it * 1_000_000 - 900_000, Some(1000 * it as u16), true)).into();
    assert_eq!(frames.iter().map(of).collect::<Vec<_>>(), expected);
    // Millimetres would be wrong in silence.
    expect(&folder, &["camera_info.yaml: intrinsics: no depth scale", "--depth-scale"]);
    let stated = [OPENCV, b"DepthMapFactor: 5000.0\n"].concat();
    folder.file("camera_info.yaml", &stated);
    assert_eq!(all(&mut open(folder.path()).unwrap()), frames);
    // A picture that is captured long after its depth image is a frame of its own.
    std::fs::rename(folder.path().join("rgb/2.11.ppm"), folder.path().join("rgb/2.5.ppm")).unwrap();
    folder.file(
        "rgb.txt",
        b"0.11 rgb/0.11.ppm\n1.11 rgb/1.11.ppm\n2.5 rgb/2.5.ppm\n3.11 rgb/3.11.ppm\n",
    );
    assert_eq!(all(&mut open(folder.path()).unwrap()).len(), 4);
}

#[test]
fn a_camera_that_stands_still_in_its_trajectory_is_one_camera() {
    let folder = tum("foreign-still", false);
    let source = open_scaled(folder.path(), 5000.0).unwrap();
    assert_eq!((source.cameras().len(), source.end()), (1, Instant(2_100_000)));
    folder.file("groundtruth.txt", b"901.0 1 2 3 1 0 0 0\n902.0 1 2 3 1 0 0 0\n");
    let error = open_scaled(folder.path(), 5000.0).unwrap_err().to_string();
    assert!(error.contains("no image has a pose") && error.lines().count() == 1, "{error}");
}

#[test]
fn the_camera_files_of_other_programs_replace_intrinsics() {
    let folder = one_camera("foreign-intrinsics");
    let ours = open(folder.path()).unwrap();
    std::fs::remove_file(folder.path().join("intrinsics.toml")).unwrap();
    let json =
        b"{\"width\": 2, \"height\": 1, \"intrinsic_matrix\": [2, 0, 0, 0, 2, 0, 0.5, 0, 1]}";
    folder.file("report.json", b"{\"cameras\": 3}");
    expect(&folder, &["intrinsics.toml: intrinsics: missing; write width", "report.json has none"]);
    for (name, content) in [("calibration.yml", OPENCV), ("camera.json", json)] {
        folder.file(name, content);
        assert_eq!(open(folder.path()).unwrap().cameras(), ours.cameras(), "{name}");
    }
    let other = String::from_utf8_lossy(OPENCV).replace("[ 2.,", "[ 3.,");
    folder.file("other.yaml", other.as_bytes());
    expect(&folder, &["other.yaml: intrinsics: ", "camera.json states others; keep one"]);
    folder.file("other.yaml", b"K: [1, 2]\nwidth: 2\nheight: 1\n");
    expect(&folder, &["other.yaml: intrinsics: the camera matrix must be [fx, 0, cx"]);
    std::fs::remove_file(folder.path().join("other.yaml")).unwrap();
    let frames = all(&mut open_scaled(folder.path(), 500.0).unwrap());
    assert_eq!(frames[0].depth.as_ref().unwrap().as_raw()[..], [2_000, 0]);
}

#[test]
fn a_pose_is_a_line_or_a_matrix() {
    let folder = one_camera("foreign-pose");
    let ours = open(folder.path()).unwrap();
    // The same in rows, in one line, and as Open3D writes it.
    let rows = "1 0 0 1\n0 -1 0 2\n0 0 -1 3\n";
    for text in [
        rows.to_owned(),
        format!("{rows}0 0 0 1\n"),
        format!("0 0 0\n{rows}0 0 0 1\n"),
        rows.replace('\n', " "),
    ] {
        folder.file("pose.txt", text.as_bytes());
        assert_eq!(open(folder.path()).unwrap().cameras(), ours.cameras(), "{text}");
    }
    folder.file("pose.txt", b"1 2 3 1 0\n");
    expect(
        &folder,
        &["pose.txt:1: 5 numbers; a pose is 7 (x y z qx qy qz qw), 8 (TUM", "4 rows of 4"],
    );
    folder.file("pose.txt", b"1 0 0 1\n0 1 0 2\n0 0 -1 3\n0 0 0 1\n");
    expect(&folder, &["pose.txt:1: not a rotation: its matrix has the determinant -1"]);
}

/// Recorded frames in TUM's layout give what they give in Redwood's.
#[test]
fn recorded_frames_are_the_same_in_another_layout() {
    let Some(path) = shared_data("rgbd_redwood") else { return };
    let mut ours = open(&path).unwrap();
    let poses: Vec<_> = ours.cameras().iter().map(|it| *it.depth.unwrap().pose()).collect();
    let folder = Folder::new("foreign-redwood");
    let json = std::fs::read_to_string(path.join("camera_primesense.json")).unwrap();
    folder.file(
        "camera.json",
        json.replace("\"width\"", "\"depth_scale\": 0.001, \"width\"").as_bytes(),
    );
    let mut truth = String::new();
    for (index, pose) in poses.iter().enumerate() {
        let copy = |from: &str, to: &str| {
            let bytes = std::fs::read(path.join(from)).unwrap();
            folder.file(to, &bytes);
        };
        copy(&format!("depth/{index:05}.png"), &format!("depth/130503110{index}.25.png"));
        copy(&format!("color/{index:05}.jpg"), &format!("rgb/130503110{index}.26.jpg"));
        let (at, turn) = (pose.translation.vector, pose.rotation.coords);
        truth += &format!(
            "130503110{index}.255 {} {} {} {} {} {} {}\n",
            at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w
        );
    }
    folder.file("groundtruth.txt", truth.as_bytes());
    let mut theirs = open(folder.path()).unwrap();
    for (ours, theirs) in ours.cameras().iter().zip(theirs.cameras()) {
        let [ours, theirs] = [ours, theirs].map(|it| it.depth.unwrap());
        assert!((ours.pose().to_homogeneous() - theirs.pose().to_homogeneous()).norm() < 1e-9);
        assert_eq!(ours.intrinsics(), theirs.intrinsics());
    }
    for (ours, theirs) in all(&mut ours).into_iter().zip(all(&mut theirs)) {
        assert!(ours.depth == theirs.depth && ours.picture == theirs.picture);
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    #[test]
    fn garbled_foreign_folders_never_panic(
        file in prop::sample::select(vec!["depth.txt", "rgb.txt", "groundtruth.txt", "camera_info.yaml"]),
        at in any::<prop::sample::Index>(),
        bytes in prop::collection::vec(prop::sample::select(b"0159-. e\n#x:[\xff".to_vec()), 1..4),
        length in any::<prop::sample::Index>(),
        is_cut in any::<bool>(),
    ) {
        let folder = tum("foreign-garbled", true);
        let mut content = std::fs::read(folder.path().join(file)).unwrap();
        let at = at.index(content.len());
        content.splice(at..at + 1, bytes);
        if is_cut {
            content.truncate(length.index(content.len() + 1));
        }
        folder.file(file, &content);
        match open_scaled(folder.path(), 5000.0) {
            Ok(mut source) => prop_assert!(all(&mut source).len() <= 8),
            Err(error) => prop_assert_eq!(error.to_string().lines().count(), 1),
        }
    }
}

//! Camera files of other programs: what they say about a sensor's intrinsics.
//!
//! | program | keys |
//! |---|---|
//! | OpenCV (`FileStorage`), ROS's `camera_calibration` | `image_width`, `image_height`, `camera_matrix`, `distortion_coefficients`, `distortion_model` |
//! | ROS's `camera_info` message | `width`, `height`, `K` or `k`, `D` or `d`, `distortion_model`; `P` or `p` without `K` |
//! | Open3D | `width`, `height`, `intrinsic_matrix`, `depth_scale` |
//! | RealSense | `width`, `height`, `fx`, `fy`, `ppx`, `ppy`, `model`, `coeffs`, `depth_scale` |
//! | ORB-SLAM | `Camera.width`, `Camera.height`, `Camera.fx` to `Camera.k3`, `DepthMapFactor` |
//!
//! All are read from YAML and from JSON, and other keys are ignored. `K` and `D` describe the raw image of
//! ROS's `camera_info`; for a rectified image leave `K` out.

use serde_json::Value;

use crate::camera;

/// What a camera file says.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct CameraForm {
    pub(super) pinhole: camera::Intrinsics,
    /// Units of the depth images per metre, if stated.
    pub(super) depth_per_metre: Option<f64>,
}

/// Why a text states no camera.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum FormFault {
    /// It may be about something else: it states no camera matrix.
    NoCamera,
    /// It is wrong; the problem on one line.
    Wrong(String),
}

/// The wanted keys.
pub(super) const WANTED: &str = "width, height and either a matrix (camera_matrix, K or intrinsic_matrix) or \
     fx, fy, cx and cy";

/// Names of the keys, the first of which that is there counts.
const WIDTH: &[&str] = &["image_width", "width", "Camera.width"];
const HEIGHT: &[&str] = &["image_height", "height", "Camera.height"];
const MATRIX: &[&str] =
    &["camera_matrix", "Camera_Matrix", "cameraMatrix", "K", "k", "intrinsic_matrix"];
const PROJECTION: &[&str] = &["projection_matrix", "P", "p"];
const PINHOLE: [&[&str]; 4] = [
    &["fx", "Camera.fx", "Camera1.fx"],
    &["fy", "Camera.fy", "Camera1.fy"],
    &["cx", "ppx", "Camera.cx", "Camera1.cx"],
    &["cy", "ppy", "Camera.cy", "Camera1.cy"],
];
const DISTORTION: &[&str] = &[
    "distortion_coefficients",
    "Distortion_Coefficients",
    "distCoeffs",
    "dist_coeffs",
    "D",
    "d",
    "coeffs",
];
const BROWN: [&[&str]; 5] = [
    &["Camera.k1", "Camera1.k1"],
    &["Camera.k2", "Camera1.k2"],
    &["Camera.p1", "Camera1.p1"],
    &["Camera.p2", "Camera1.p2"],
    &["Camera.k3", "Camera1.k3"],
];
const MODEL: &[&str] = &["distortion_model", "model", "Camera.type"];
const SCALE: &[&str] = &["depth_scale", "DepthMapFactor", "RGBD.DepthMapFactor"];

/// Distortion models whose first five coefficients are k1, k2, p1, p2 and k3.
const KNOWN_MODELS: [&str; 6] =
    ["plumb_bob", "rational_polynomial", "brown_conrady", "none", "pinhole", ""];

impl CameraForm {
    /// Parses the text of a JSON or YAML file.
    pub(super) fn parse(text: &str, is_json: bool) -> Result<Self, FormFault> {
        let wrong = |reason: String| FormFault::Wrong(reason);
        let first_line = |error: String| error.lines().next().unwrap_or_default().to_owned();
        let value: Value = if is_json {
            serde_json::from_str(text).map_err(|error| wrong(first_line(error.to_string())))?
        } else {
            serde_saphyr::from_str(&plain_yaml(text))
                .map_err(|error| wrong(first_line(error.to_string())))?
        };
        let at = |keys: &[&str]| keys.iter().find_map(|key| value.get(key));
        let named = |keys: &'static [&str]| {
            at(keys).map(|value| number(value).ok_or_else(|| wrong(not_a_number(keys[0]))))
        };
        let numbers_at = |keys: &'static [&str]| {
            at(keys).map(|value| numbers(value).ok_or_else(|| wrong(not_a_number(keys[0]))))
        };
        let matrix = numbers_at(MATRIX).transpose()?.filter(|it| it.iter().any(|it| *it != 0.0));
        let mut is_rectified = false;
        let [fx, fy, cx, cy] = if let Some(matrix) = matrix {
            of_matrix(&matrix).map_err(wrong)?
        } else if let Some(projection) = numbers_at(PROJECTION).transpose()? {
            is_rectified = true;
            of_matrix(&projection).map_err(wrong)?
        } else if PINHOLE.iter().any(|keys| at(keys).is_some()) {
            let mut pinhole = [0.0; 4];
            for (value, keys) in pinhole.iter_mut().zip(PINHOLE) {
                *value = named(keys).ok_or_else(|| wrong(format!("{} is missing", keys[0])))??;
            }
            pinhole
        } else {
            return Err(FormFault::NoCamera);
        };
        let side = |keys: &'static [&str]| {
            let side = named(keys).ok_or_else(|| wrong(format!("{} is missing", keys[0])))??;
            // Out of range and fractions: zero, which is refused later.
            Ok(if side.fract() == 0.0 { side.clamp(0.0, 1e9) as u32 } else { 0 })
        };
        let (width, height) = (side(WIDTH)?, side(HEIGHT)?);
        let distortion = if is_rectified {
            [0.0; 5]
        } else {
            let stated = match numbers_at(DISTORTION).transpose()? {
                Some(coefficients) => coefficients,
                None => {
                    let one = |keys| named(keys).unwrap_or(Ok(0.0));
                    BROWN.into_iter().map(one).collect::<Result<Vec<_>, _>>()?
                }
            };
            let model = at(MODEL).and_then(Value::as_str).unwrap_or_default();
            coefficients(&stated, model).map_err(wrong)?
        };
        let depth_per_metre = named(SCALE).transpose()?.map(units_per_metre);
        let pinhole = camera::Intrinsics { width, height, fx, fy, cx, cy, distortion };
        Ok(Self { pinhole, depth_per_metre })
    }
}

/// Units per metre, from a depth scale that is either that, or the length of a unit in metres.
pub fn units_per_metre(scale: f64) -> f64 {
    if scale > 0.0 && scale < 1.0 { scale.recip() } else { scale }
}

/// YAML without what OpenCV adds to it (a directive with a colon, tags), and only its first document.
fn plain_yaml(text: &str) -> String {
    let mut lines = text.trim_start_matches('\u{feff}').lines().peekable();
    let mut plain = String::new();
    while lines
        .next_if(|line| {
            let line = line.trim();
            line.is_empty() || line.starts_with(['%', '#']) || line == "---"
        })
        .is_some()
    {}
    for line in lines.take_while(|line| !["---", "..."].contains(&line.trim_end())) {
        plain.push_str(&line.replace("!!opencv-matrix", ""));
        plain.push('\n');
    }
    plain
}

fn not_a_number(key: &str) -> String {
    format!("{key} is not made of finite numbers")
}

/// A finite number. YAML's `0.` arrives as text.
fn number(value: &Value) -> Option<f64> {
    let number = match value {
        Value::Number(number) => number.as_f64()?,
        Value::String(text) => text.parse().ok()?,
        _ => return None,
    };
    number.is_finite().then_some(number)
}

/// The numbers of a matrix: a list, a list of rows, or a table with its `data`.
fn numbers(value: &Value) -> Option<Vec<f64>> {
    match value {
        Value::Array(rows) if rows.iter().all(Value::is_array) => {
            let rows = rows.iter().map(|row| {
                numbers(row).filter(|it| it.len() == rows[0].as_array().map_or(0, Vec::len))
            });
            Some(rows.collect::<Option<Vec<_>>>()?.concat())
        }
        Value::Array(values) => values.iter().map(number).collect(),
        Value::Object(table) => numbers(table.get("data")?),
        Value::Null => Some(Vec::new()),
        _ => None,
    }
}

/// The values fx, fy, cx and cy of a matrix of 3 x 3, or of 3 x 4 row by row. One of 3 x 3 is in the
/// order of its rows (OpenCV, ROS) or of its columns (Open3D): its zeros tell.
fn of_matrix(matrix: &[f64]) -> Result<[f64; 4], String> {
    match *matrix {
        [fx, skew, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
        | [fx, 0.0, 0.0, skew, fy, 0.0, cx, cy, 1.0]
        | [fx, skew, cx, _, 0.0, fy, cy, _, 0.0, 0.0, 1.0, _] => {
            if skew.abs() > 1e-3 * fx.abs() {
                return Err(format!(
                    "the camera matrix has a skew of {skew}, which is not supported"
                ));
            }
            Ok([fx, fy, cx, cy])
        }
        _ => Err(
            "the camera matrix must be [fx, 0, cx, 0, fy, cy, 0, 0, 1], or its columns one by one"
                .to_owned(),
        ),
    }
}

/// The coefficients k1, k2, p1, p2 and k3 of a distortion model. Other models are refused, unless all
/// their coefficients are zero.
fn coefficients(stated: &[f64], model: &str) -> Result<[f64; 5], String> {
    if stated.iter().all(|it| *it == 0.0) {
        return Ok([0.0; 5]);
    }
    let name = model.trim_start_matches("distortion.").to_ascii_lowercase();
    // Of these, OpenCV's model with thin prisms and a tilted sensor has most.
    if !KNOWN_MODELS.contains(&name.as_str()) || !(4..=14).contains(&stated.len()) {
        return Err(format!(
            "the distortion model {model:?} with {} coefficients is not supported; wanted is plumb_bob (k1, k2, p1, \
             p2, k3): rectify the images, or calibrate anew",
            stated.len()
        ));
    }
    let (brown, others) = stated.split_at(stated.len().min(5));
    if others.iter().any(|it| *it != 0.0) {
        let name = match stated.len() {
            ..=8 => "rational_polynomial (k4, k5, k6)",
            9..=12 => "thin_prism (s1 to s4)",
            _ => "tilted (tau_x, tau_y)",
        };
        return Err(format!(
            "the distortion model {name} is not supported, as its coefficients beyond the fifth aren't zero; wanted is plumb_bob \
             (k1, k2, p1, p2, k3): rectify the images, or calibrate anew"
        ));
    }
    Ok(std::array::from_fn(|index| brown.get(index).copied().unwrap_or(0.0)))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::testing::shared_data;

    fn yaml(text: &str) -> Result<CameraForm, FormFault> {
        CameraForm::parse(text, false)
    }

    fn expected(distortion: [f64; 5]) -> camera::Intrinsics {
        let (width, height) = (640, 480);
        camera::Intrinsics { width, height, fx: 525.5, fy: 524.0, cx: 319.5, cy: 239.0, distortion }
    }

    const BROWN_KINECT: [f64; 5] = [0.25, -0.9, -0.005, 0.002, 1.0];

    #[test]
    fn camera_files_of_other_programs_agree() {
        let opencv = "%YAML:1.0\n---\ncalibration_time: \"Mon 01 Jan\"\nimage_width: 640\nimage_height: 480\n\
            camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ 5.2550000000000000e+02, 0., 3.195e+02, 0.,\n       \
            524., 239., 0., 0., 1. ]\ndistortion_coefficients: !!opencv-matrix\n   rows: 5\n   cols: 1\n   dt: d\n   \
            data: [ .25, -0.9, -5.0e-03, 2.0e-03, 1. ]\navg_reprojection_error: 1.e-01\n";
        let ros = "image_width: 640\nimage_height: 480\ncamera_name: rgb\ncamera_matrix:\n  rows: 3\n  cols: 3\n  \
            data: [525.5, 0, 319.5, 0, 524, 239, 0, 0, 1]\ndistortion_model: plumb_bob\ndistortion_coefficients:\n  \
            rows: 1\n  cols: 5\n  data: [0.25, -0.9, -0.005, 0.002, 1]\nrectification_matrix:\n  rows: 3\n  cols: 3\n  \
            data: [1, 0, 0, 0, 1, 0, 0, 0, 1]\nprojection_matrix:\n  rows: 3\n  cols: 4\n  \
            data: [500, 0, 300, 0, 0, 500, 200, 0, 0, 0, 1, 0]\n";
        let echo = "header:\n  stamp:\n    sec: 1\n    nanosec: 2\n  frame_id: optical\nheight: 480\nwidth: 640\n\
            distortion_model: rational_polynomial\nd:\n- 0.25\n- -0.9\n- -0.005\n- 0.002\n- 1.0\n- 0.0\n- 0.0\n- 0.0\nk:\n- 525.5\n- 0.0\n- 319.5\n\
            - 0.0\n- 524.0\n- 239.0\n- 0.0\n- 0.0\n- 1.0\nr:\n- 1.0\nbinning_x: 0\nroi:\n  x_offset: 0\n  height: 0\n  \
            width: 0\n---\nheader:\n  stamp:\n    sec: 2\n";
        let first = "height: 480\nwidth: 640\nD: [0.25, -0.9, -0.005, 0.002, 1.0]\n\
            K: [525.5, 0.0, 319.5, 0.0, 524.0, 239.0, 0.0, 0.0, 1.0]\n";
        let orb_slam = "%YAML:1.0\n\n# TUM\nCamera.fx: 525.5\nCamera.fy: 524.0\nCamera.cx: 319.5\nCamera.cy: 239.0\n\
            Camera.k1: 0.25\nCamera.k2: -0.9\nCamera.p1: -0.005\nCamera.p2: 0.002\nCamera.k3: 1.0\nCamera.width: 640\n\
            Camera.height: 480\nDepthMapFactor: 5000.0\n";
        for text in [opencv, ros, echo, first, orb_slam] {
            let form = yaml(text).unwrap();
            assert_eq!(form.pinhole, expected(BROWN_KINECT), "{text}");
        }
        assert_eq!(yaml(orb_slam).unwrap().depth_per_metre, Some(5000.0));
        // A rectified image has the projection matrix, and no distortion.
        let rectified = "height: 480\nwidth: 640\ndistortion_model: plumb_bob\nd: [1.0, 0, 0, 0, 0]\n\
            p: [525.5, 0, 319.5, 0, 0, 524, 239, 0, 0, 0, 1, 0]\n";
        assert_eq!(yaml(rectified).unwrap().pinhole, expected([0.0; 5]));
    }

    #[test]
    fn open3d_and_realsense_write_json() {
        let json = |text| CameraForm::parse(text, true).unwrap();
        let open3d = "{\n\t\"width\": 640, \"height\": 480, \"depth_scale\": 4000.0,\n\t\"intrinsic_matrix\":\n\t[525.5, 0, 0, 0, \
                      524.0, 0, 319.5, 239.0, 1]}";
        let rows = "{\"width\": 640, \"height\": 480, \"intrinsic_matrix\": [[525.5, 0, 319.5], [0, 524, 239], [0, 0, 1]]}";
        let realsense = "{\"width\": 640, \"height\": 480, \"ppx\": 319.5, \"ppy\": 239.0, \"fx\": 525.5, \"fy\": 524, \
                         \"model\": \"distortion.inverse_brown_conrady\", \"coeffs\": [0, 0, 0, 0, 0], \"depth_scale\": 0.001}";
        for text in [open3d, rows, realsense] {
            assert_eq!(json(text).pinhole, expected([0.0; 5]), "{text}");
        }
        assert_eq!(json(open3d).depth_per_metre, Some(4000.0));
        assert!((json(realsense).depth_per_metre.unwrap() - 1000.0).abs() < 1e-9);
        assert_eq!(json(rows).depth_per_metre, None);
    }

    #[test]
    fn what_is_not_supported_is_refused_by_name() {
        let of = |rest: &str| {
            let matrix = "K: [525.5, 0, 319.5, 0, 524, 239, 0, 0, 1]";
            yaml(&format!("width: 640\nheight: 480\n{matrix}\n{rest}"))
        };
        for (rest, named) in [
            ("distortion_model: equidistant\nD: [0.1, 0, 0, 0]", "\"equidistant\" with 4"),
            (
                "distortion_model: rational_polynomial\nD: [1, 1, 0, 0, 1, 2, 0, 0]",
                "rational_polynomial (k4",
            ),
            ("D: [1, 1, 0, 0, 1, 0, 0, 0, 0.1, 0, 0, 0]", "thin_prism"),
            ("D: [1, 1, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0.1, 0]", "tilted"),
            ("D: [1, 1]", "with 2 coefficients"),
            ("D: [a]", "distortion_coefficients is not made of finite numbers"),
            ("depth_scale: .nan", "non-finite"),
        ] {
            let Err(FormFault::Wrong(reason)) = of(rest) else { panic!("{rest}") };
            assert!(reason.contains(named) && !reason.contains('\n'), "{reason}");
        }
        let zero = of("distortion_model: equidistant\nD: [0.0, 0, 0, 0]").unwrap();
        assert_eq!(zero.pinhole.distortion, [0.0; 5]);
        assert_eq!(yaml("image: map.pgm\nresolution: 0.05\n"), Err(FormFault::NoCamera));
        assert!(
            matches!(yaml("K: [1, 2, 3]\n"), Err(FormFault::Wrong(it)) if it.contains("must be [fx"))
        );
        let matrix = "K: [525.5, 5, 319.5, 0, 524, 239, 0, 0, 1]\nwidth: 640\nheight: 480";
        assert!(matches!(yaml(matrix), Err(FormFault::Wrong(it)) if it.contains("skew")));
        let size = yaml("K: [525.5, 0, 319.5, 0, 524, 239, 0, 0, 1]\nwidth: 640");
        assert!(matches!(size, Err(FormFault::Wrong(it)) if it == "image_height is missing"));
    }

    #[test]
    fn the_camera_of_recorded_photographs_is_read() {
        let Some(path) = shared_data("fiducials/apriltag/test_info.yaml") else { return };
        let text = std::fs::read_to_string(path).unwrap();
        let section = text.split("sample_test:\n").nth(1).unwrap();
        let lines = section.lines().take_while(|line| line.starts_with("  "));
        let of_one = lines.map(|line| format!("{}\n", &line[2..])).collect::<String>();
        let form = yaml(&of_one).unwrap().pinhole;
        assert_eq!((form.width, form.height), (640, 480));
        assert!((form.fx - 336.775).abs() < 1e-3 && (form.cy - 212.774).abs() < 1e-3, "{form:?}");
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(300))]

        #[test]
        fn arbitrary_text_never_panics(
            bytes in prop::collection::vec(any::<u8>(), 0..300),
            at in any::<prop::sample::Index>(),
            is_json in any::<bool>(),
        ) {
            let text = String::from_utf8_lossy(&bytes);
            let whole = "%YAML:1.0\nwidth: 4\nheight: 3\nK: !!opencv-matrix {data: [2, 0, 1, 0, 2, 1, 0, 0, 1]}\nD: [0]\n";
            let at = at.index(whole.len());
            for text in [text.to_string(), format!("{}{text}{}", &whole[..at], &whole[at..])] {
                if let Err(FormFault::Wrong(reason)) = CameraForm::parse(&text, is_json) {
                    prop_assert!(!reason.contains('\n') && !reason.is_empty());
                }
            }
        }
    }
}

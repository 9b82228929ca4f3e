//! A fixed camera in a scenario.

use serde::Deserialize;

/// A fixed camera. Its direction is given by a point, or by heading and tilt.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraConfig {
    /// The camera's name, for people; the simulation numbers its cameras.
    #[serde(default)]
    pub name: String,
    /// Position of the optical centre.
    pub position_m: [f64; 3],
    /// The point that appears in the centre of the picture.
    pub look_at_m: Option<[f64; 3]>,
    /// Heading, counter-clockwise from x; with `tilt_deg`, instead of `look_at_m`.
    pub heading_deg: Option<f64>,
    /// Downward tilt: 0 is level, 90 straight down.
    pub tilt_deg: Option<f64>,
    /// Angle by which the right side of the image is below the horizontal; with heading and tilt.
    pub roll_deg: Option<f64>,
    /// Horizontal field of view.
    #[serde(default = "defaults::horizontal_fov_deg")]
    pub horizontal_fov_deg: f64,
    /// Vertical field of view.
    #[serde(default = "defaults::vertical_fov_deg")]
    pub vertical_fov_deg: f64,
    /// Maximum range.
    #[serde(default = "defaults::range_m")]
    pub range_m: f64,
    /// Frame rate; each frame localises the robots in view.
    #[serde(default = "defaults::rate_hz")]
    pub rate_hz: f64,
    /// Maximum rate of frames that also report free and occupied cells.
    #[serde(default = "defaults::cells_rate_hz")]
    pub cells_rate_hz: f64,
    /// Minimum latency from capture to arrival.
    #[serde(default = "defaults::latency_ms")]
    pub latency_ms: f64,
    /// Standard deviation of a robot's measured x and y.
    #[serde(default)]
    pub position_noise_m: f64,
    /// Standard deviation of a robot's measured heading.
    #[serde(default)]
    pub heading_noise_deg: f64,
    /// Mean additional latency of a frame. It is exponentially distributed, so that some frames overtake
    /// others.
    #[serde(default = "defaults::latency_jitter_ms")]
    pub latency_jitter_ms: f64,
    /// Fraction of frames that are lost.
    #[serde(default = "defaults::lost_frames")]
    pub lost_frames: f64,
    /// Time of failure, after which no more frames arrive.
    pub fails_at_s: Option<f64>,
    /// Movements after the calibration, which nobody tells the server, in order of time. Frames follow
    /// them; ideal cameras stay in their place.
    #[serde(default)]
    pub knocks: Vec<KnockConfig>,
    /// Whether it has a depth sensor. Without one it localises robots but reports no cells (Ahmed et al.,
    /// 2.2).
    #[serde(default = "defaults::has_depth")]
    pub has_depth: bool,
    /// The depth sensor; its field of view and maximum range are the camera's.
    #[serde(default)]
    pub depth: DepthConfig,
    /// The picture sensor.
    #[serde(default)]
    pub picture: PictureConfig,
}

impl CameraConfig {
    /// The default camera, looking straight down from a position.
    pub(in super::super) fn looking_down(position_m: [f64; 3]) -> Self {
        Self {
            name: String::new(),
            position_m,
            look_at_m: None,
            heading_deg: Some(0.0),
            tilt_deg: Some(90.0),
            roll_deg: None,
            horizontal_fov_deg: defaults::horizontal_fov_deg(),
            vertical_fov_deg: defaults::vertical_fov_deg(),
            range_m: defaults::range_m(),
            rate_hz: defaults::rate_hz(),
            cells_rate_hz: defaults::cells_rate_hz(),
            latency_ms: defaults::latency_ms(),
            position_noise_m: 0.0,
            heading_noise_deg: 0.0,
            latency_jitter_ms: defaults::latency_jitter_ms(),
            lost_frames: defaults::lost_frames(),
            fails_at_s: None,
            knocks: Vec::new(),
            has_depth: defaults::has_depth(),
            depth: DepthConfig::default(),
            picture: PictureConfig::default(),
        }
    }
}

/// A movement of a camera that was calibrated: a knock or a drift.
#[derive(Clone, Copy, Debug, Default, Deserialize, PartialEq)]
#[serde(deny_unknown_fields)]
pub struct KnockConfig {
    /// When it begins.
    pub at_s: f64,
    /// Its duration: zero for a knock, long for a drift.
    #[serde(default)]
    pub over_s: f64,
    /// The change of the position in `map`.
    #[serde(default)]
    pub shift_m: [f64; 3],
    /// The change of the heading, counter-clockwise.
    #[serde(default)]
    pub heading_deg: f64,
    /// The change of the downward tilt.
    #[serde(default)]
    pub tilt_deg: f64,
    /// The change of the roll, by which the right side of the image is lowered.
    #[serde(default)]
    pub roll_deg: f64,
}

/// A stereo depth sensor; defaults to an Intel RealSense D435.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DepthConfig {
    /// Width of the image in pixels.
    pub width: u32,
    /// Height of the image in pixels.
    pub height: u32,
    /// Minimum range: closer surfaces have no depth.
    pub min_range_m: f64,
    /// Distance between its two imagers.
    pub baseline_m: f64,
    /// Standard deviation of a disparity, in pixels. The calibration states the resulting depth noise.
    pub noise_px: f64,
    /// Fraction of pixels without a match, independent of the scene.
    pub dropout: f64,
}

impl Default for DepthConfig {
    fn default() -> Self {
        Self {
            width: 640,
            height: 480,
            min_range_m: 0.2,
            baseline_m: 0.05,
            noise_px: 0.08,
            dropout: 0.005,
        }
    }
}

/// A picture sensor beside the depth sensor; defaults to that of a D435.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PictureConfig {
    /// Width of the image in pixels.
    pub width: u32,
    /// Height of the image in pixels.
    pub height: u32,
    /// Horizontal field of view.
    pub horizontal_fov_deg: f64,
    /// Vertical field of view.
    pub vertical_fov_deg: f64,
    /// Distance to the left of the depth sensor.
    pub left_m: f64,
    /// Standard deviation of a pixel, in grey levels (0 to 255).
    pub noise: f64,
}

impl Default for PictureConfig {
    fn default() -> Self {
        Self {
            width: 1280,
            height: 720,
            horizontal_fov_deg: 69.0,
            vertical_fov_deg: 42.0,
            left_m: 0.015,
            noise: 2.0,
        }
    }
}

/// Defaults of a camera.
mod defaults {
    /// The depth camera of an Intel RealSense D435.
    pub(super) fn horizontal_fov_deg() -> f64 {
        87.0
    }
    pub(super) fn vertical_fov_deg() -> f64 {
        58.0
    }
    pub(super) fn range_m() -> f64 {
        8.0
    }
    pub(super) fn rate_hz() -> f64 {
        15.0
    }
    pub(super) fn cells_rate_hz() -> f64 {
        2.0
    }
    pub(super) fn latency_ms() -> f64 {
        60.0
    }
    pub(super) fn latency_jitter_ms() -> f64 {
        12.0
    }
    pub(super) fn lost_frames() -> f64 {
        0.005
    }
    pub(super) fn has_depth() -> bool {
        true
    }
}

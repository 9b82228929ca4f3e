//! A fixed camera, as a scenario says it.

use serde::Deserialize;

/// A fixed camera. It looks at a point, or along a heading and a tilt.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraConfig {
    /// What it is called; the simulation numbers its cameras all the same.
    #[serde(default)]
    pub name: String,
    /// Where its optical centre is.
    pub position_m: [f64; 3],
    /// The point in the middle of its picture.
    pub look_at_m: Option<[f64; 3]>,
    /// Where it faces, counter-clockwise from x; with `tilt_deg` instead of `look_at_m`.
    pub heading_deg: Option<f64>,
    /// How far it looks down: 0 level, 90 straight down.
    pub tilt_deg: Option<f64>,
    /// From the left to the right edge of the picture.
    #[serde(default = "defaults::horizontal_fov_deg")]
    pub horizontal_fov_deg: f64,
    /// From the upper to the lower edge of the picture.
    #[serde(default = "defaults::vertical_fov_deg")]
    pub vertical_fov_deg: f64,
    /// How far it sees.
    #[serde(default = "defaults::range_m")]
    pub range_m: f64,
    /// Frames each second; each localises the robots in view.
    #[serde(default = "defaults::rate_hz")]
    pub rate_hz: f64,
    /// How often, at most, a frame also says which cells are free or occupied.
    #[serde(default = "defaults::cells_rate_hz")]
    pub cells_rate_hz: f64,
    /// From capture to arrival.
    #[serde(default = "defaults::latency_ms")]
    pub latency_ms: f64,
    /// Standard deviation of a robot's position, in x and in y.
    #[serde(default)]
    pub position_noise_m: f64,
    /// Standard deviation of a robot's heading.
    #[serde(default)]
    pub heading_noise_deg: f64,
    /// How much later than `latency_ms` a frame arrives on average; each by its own throw of an
    /// exponential distribution, so that some overtake others.
    #[serde(default = "defaults::latency_jitter_ms")]
    pub latency_jitter_ms: f64,
    /// The share of frames that never arrive.
    #[serde(default = "defaults::lost_frames")]
    pub lost_frames: f64,
    /// From when on nothing comes from it any more.
    pub fails_at_s: Option<f64>,
    /// Whether it sees depths. Without, it says where robots are, and of no cell what is there
    /// (Ahmed et al., 2.2).
    #[serde(default = "defaults::has_depth")]
    pub has_depth: bool,
    /// Its depth images; their field of view and range are the camera's.
    #[serde(default)]
    pub depth: DepthConfig,
    /// Its pictures.
    #[serde(default)]
    pub picture: PictureConfig,
}

impl CameraConfig {
    /// The usual camera, which looks straight down from there.
    pub(in super::super) fn looking_down(position_m: [f64; 3]) -> Self {
        Self {
            name: String::new(),
            position_m,
            look_at_m: None,
            heading_deg: Some(0.0),
            tilt_deg: Some(90.0),
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
            has_depth: defaults::has_depth(),
            depth: DepthConfig::default(),
            picture: PictureConfig::default(),
        }
    }
}

/// A stereo depth sensor; unless it says otherwise, that of an Intel RealSense D435.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DepthConfig {
    /// Pixels of a row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Nearer surfaces give no depth.
    pub min_range_m: f64,
    /// Between its two imagers.
    pub baseline_m: f64,
    /// Standard deviation of a disparity, in pixels. The calibration states the noise of depths that
    /// follows from it.
    pub noise_px: f64,
    /// The share of pixels that find no match, wherever they look.
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

/// A sensor of pictures beside that of depth; unless it says otherwise, that of a D435.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PictureConfig {
    /// Pixels of a row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// From the left to the right edge of the picture.
    pub horizontal_fov_deg: f64,
    /// From the upper to the lower edge of the picture.
    pub vertical_fov_deg: f64,
    /// How far it sits to the left of the depth sensor.
    pub left_m: f64,
    /// Standard deviation of a pixel, in grey levels of 256.
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

/// What a scenario need not say of a camera.
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

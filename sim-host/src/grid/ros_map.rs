//! Map files of ROS's `map_server`: a YAML file and the image that it names.
//!
//! Each pixel is a cell; the bottom row of the image is the southernmost. The darkness of a pixel
//! is its occupancy, from 0 (white) to 1 (black), inverted with `negate`. A cell above
//! `occupied_thresh` is occupied, below `free_thresh` free, and unknown between.

use std::path::{Path, PathBuf};

use image::{DynamicImage, GrayImage, Luma};
use serde::Deserialize;
use ubimap_protocol::tile::Cell;

use super::{
    occupancy::{GridError, OccupancyGrid},
    raster::{self, RasterError},
};
use crate::files::{self, MAX_SETTINGS};

/// Pixel value of a free cell in written maps, as in `map_server`'s trinary mode.
const FREE: u8 = 254;
/// Pixel value of an occupied cell.
const OCCUPIED: u8 = 0;
/// Pixel value of an unknown cell.
const UNKNOWN: u8 = 205;

/// Why a map can't be read.
#[derive(Debug, thiserror::Error)]
pub enum MapError {
    /// The YAML file can't be read.
    #[error("{path}: {error}", path = path.display())]
    Io {
        /// The YAML file.
        path: PathBuf,
        /// The operating system's error.
        error: std::io::Error,
    },
    /// The YAML file is not YAML, or a key is missing or of the wrong kind.
    #[error("{path}: {reason}", path = path.display())]
    Yaml {
        /// The YAML file.
        path: PathBuf,
        /// The problem, on one line.
        reason: String,
    },
    /// A key has an invalid value.
    #[error("{path}: {key}: {reason}", path = path.display())]
    Value {
        /// The YAML file.
        path: PathBuf,
        /// The key.
        key: &'static str,
        /// The problem with the value.
        reason: String,
    },
    /// The image can't be read.
    #[error("{image}: {error} (named by `image` in {yaml})",
        image = image.display(), yaml = yaml.display())]
    Image {
        /// The YAML file.
        yaml: PathBuf,
        /// The image file.
        image: PathBuf,
        /// The problem with the image.
        error: RasterError,
    },
    /// The size, resolution or origin is invalid.
    #[error("{path}: {error}", path = path.display())]
    Grid {
        /// The YAML file.
        path: PathBuf,
        /// The reason.
        error: GridError,
    },
}

/// Occupancy thresholds, from 0 to 1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Thresholds {
    /// Cells above this are occupied.
    pub occupied: f64,
    /// Cells below this are free.
    pub free: f64,
}

impl Thresholds {
    /// The defaults of `map_server`, used in every map written here.
    pub const MAP_SERVER: Self = Self { occupied: 0.65, free: 0.196 };

    fn cell(self, occupancy: f64) -> Cell {
        if occupancy > self.occupied {
            Cell::Occupied
        } else if occupancy < self.free {
            Cell::Free
        } else {
            Cell::Unknown
        }
    }
}

/// Reads a map from its YAML file and the image named there (relative to the YAML file).
///
/// The modes are those of nav2's `map_server`. `trinary` (the default) averages an alpha channel as
/// a fourth colour, with a warning; one that is opaque throughout is ignored, unlike in `map_server`, where it
/// brightens everything. In `scale`, pixels that are not opaque are unknown, and unlike in `map_server`
/// so are shades between the thresholds. In `raw`, a pixel's value is the occupancy in per cent,
/// unknown above 100.
pub fn read_map(yaml: &Path) -> Result<OccupancyGrid, MapError> {
    let value_error = |key, reason: &str| MapError::Value {
        path: yaml.to_owned(),
        key,
        reason: reason.to_owned(),
    };
    let text = files::read(yaml, MAX_SETTINGS)
        .map_err(|error| MapError::Io { path: yaml.to_owned(), error })?;
    let text = String::from_utf8(text).map_err(|_| MapError::Yaml {
        path: yaml.to_owned(),
        reason: "not a text file; give the .yaml file of a ROS map".to_owned(),
    })?;
    let header =
        MapYaml::parse(&text).map_err(|reason| MapError::Yaml { path: yaml.to_owned(), reason })?;
    if !(header.resolution.is_finite() && header.resolution > 0.0) {
        return Err(value_error("resolution", "must be a positive number of metres"));
    }
    let [x, y, yaw] = header.origin[..] else {
        return Err(value_error("origin", "must be three numbers: x, y and yaw"));
    };
    let thresholds = header.thresholds();
    if !(0.0 <= thresholds.free && thresholds.free <= thresholds.occupied) {
        return Err(value_error("free_thresh", "must be from 0 to occupied_thresh"));
    }
    if thresholds.occupied > 1.0 {
        return Err(value_error("occupied_thresh", "must be from free_thresh to 1"));
    }

    let image_path = yaml.parent().unwrap_or(Path::new("")).join(&header.image);
    let raster = raster::read(&image_path).map_err(|error| MapError::Image {
        yaml: yaml.to_owned(),
        image: image_path.clone(),
        error,
    })?;
    let pixels = Pixels::of(raster.image, header.mode);
    if pixels.mean_with_alpha {
        log::warn!(
            "{}: is partly transparent; as in map_server, opacity counts as a fourth colour, so that what is \
             transparent is darker",
            image_path.display()
        );
    }
    let grid_error = |error| MapError::Grid { path: yaml.to_owned(), error };
    let mut grid = OccupancyGrid::new(
        header.resolution,
        [x, y],
        pixels.width as usize,
        pixels.height as usize,
    )
    .and_then(|grid| grid.with_yaw(yaw))
    .map_err(grid_error)?;
    for row in 0..pixels.height {
        for column in 0..pixels.width {
            let pixel = pixels.at(column, row);
            let cell = header.mode.cell(pixel, header.negate.into(), thresholds);
            grid.set(column as usize, (pixels.height - 1 - row) as usize, cell);
        }
    }
    Ok(grid)
}

/// Encodes a map's image as a binary PGM: free 254, occupied (fixed or movable) 0, unknown 205.
pub fn pgm(grid: &OccupancyGrid) -> Vec<u8> {
    let (width, height) = (grid.width() as u32, grid.height() as u32);
    raster::encode_pgm(&GrayImage::from_fn(width, height, |column, row| {
        Luma([match grid.cell(column as usize, (height - 1 - row) as usize) {
            Cell::Free => FREE,
            Cell::Occupied | Cell::Movable => OCCUPIED,
            Cell::Unknown => UNKNOWN,
        }])
    }))
}

/// The YAML file for a map image ([`pgm`]) of the given name in the same folder.
pub fn yaml(grid: &OccupancyGrid, image: &str) -> String {
    let [x, y] = grid.origin_m();
    let Thresholds { occupied, free } = Thresholds::MAP_SERVER;
    format!(
        "image: {image}\nmode: trinary\nresolution: {:?}\norigin: [{x:?}, {y:?}, {:?}]\n\
         negate: 0\noccupied_thresh: {occupied:?}\nfree_thresh: {free:?}\n",
        grid.resolution_m(),
        grid.yaw_rad(),
    )
}

/// The contents of the YAML file. Unknown keys are ignored, as in `map_server`.
#[derive(Deserialize)]
struct MapYaml {
    image: PathBuf,
    resolution: f64,
    origin: Vec<f64>,
    #[serde(default)]
    negate: Switch,
    occupied_thresh: f64,
    free_thresh: f64,
    #[serde(default)]
    mode: Mode,
}

impl MapYaml {
    fn parse(text: &str) -> Result<Self, String> {
        serde_saphyr::from_str(text).map_err(|error| {
            let message = error.without_snippet().to_string();
            message.lines().next().unwrap_or("not a map's YAML").to_owned()
        })
    }

    fn thresholds(&self) -> Thresholds {
        Thresholds { occupied: self.occupied_thresh, free: self.free_thresh }
    }
}

/// `negate`: 0 or 1, or true or false.
#[derive(Clone, Copy, Deserialize)]
#[serde(untagged)]
enum Switch {
    Bool(bool),
    Number(i64),
}

impl Default for Switch {
    fn default() -> Self {
        Self::Bool(false)
    }
}

impl From<Switch> for bool {
    fn from(switch: Switch) -> Self {
        match switch {
            Switch::Bool(on) => on,
            Switch::Number(number) => number != 0,
        }
    }
}

/// How pixels are converted to cells; see [`read_map`].
#[derive(Clone, Copy, Default, Deserialize, PartialEq)]
#[serde(rename_all = "lowercase")]
enum Mode {
    #[default]
    Trinary,
    Scale,
    Raw,
}

impl Mode {
    fn cell(self, pixel: Pixel, negate: bool, thresholds: Thresholds) -> Cell {
        let shade_occupancy = if negate { pixel.shade } else { 1.0 - pixel.shade };
        match self {
            Self::Trinary => thresholds.cell(shade_occupancy),
            Self::Scale if !pixel.opaque => Cell::Unknown,
            Self::Scale => thresholds.cell(shade_occupancy),
            Self::Raw => {
                let per_cent = (pixel.shade * 255.0).round();
                if per_cent > 100.0 { Cell::Unknown } else { thresholds.cell(per_cent / 100.0) }
            }
        }
    }
}

/// A pixel as `map_server` interprets it.
#[derive(Clone, Copy)]
struct Pixel {
    /// From black (0) to white (1).
    shade: f64,
    opaque: bool,
}

/// The pixels of an image of any type.
struct Pixels {
    width: u32,
    height: u32,
    grey: Grey,
    /// Whether alpha is averaged as a fourth colour, as in `map_server`: if any pixel is not opaque.
    mean_with_alpha: bool,
}

/// Eight-bit grey is kept as it is, because maps are large.
enum Grey {
    Luma(GrayImage),
    Colour(image::ImageBuffer<image::Rgba<u16>, Vec<u16>>),
}

impl Pixels {
    fn of(image: DynamicImage, mode: Mode) -> Self {
        let (width, height) = (image.width(), image.height());
        let grey = match image {
            DynamicImage::ImageLuma8(image) => Grey::Luma(image),
            other => Grey::Colour(other.into_rgba16()),
        };
        let is_transparent = match &grey {
            Grey::Luma(_) => false,
            Grey::Colour(image) => image.pixels().any(|pixel| pixel.0[3] < u16::MAX),
        };
        let mean_with_alpha = is_transparent && mode == Mode::Trinary;
        Self { width, height, grey, mean_with_alpha }
    }

    fn at(&self, column: u32, row: u32) -> Pixel {
        match &self.grey {
            Grey::Luma(image) => {
                let shade = f64::from(image.get_pixel(column, row).0[0]) / 255.0;
                Pixel { shade, opaque: true }
            }
            Grey::Colour(image) => {
                let samples = image.get_pixel(column, row).0.map(f64::from);
                let counted = if self.mean_with_alpha { 4 } else { 3 };
                let mean = samples[..counted].iter().sum::<f64>() / counted as f64;
                Pixel { shade: mean / 65_535.0, opaque: samples[3] >= 65_535.0 }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{Folder, shared_data};

    /// Writes the files of a map and returns the path of its YAML file.
    fn map_in(folder: &Folder, yaml: &str, image: &[u8]) -> PathBuf {
        folder.file("map.pgm", image);
        folder.file("map.yaml", yaml.as_bytes())
    }

    fn yaml_with(extra: &str) -> String {
        format!(
            "image: map.pgm\nresolution: 0.1\norigin: [1, -2.5, 0.0]\nnegate: 0\n\
             occupied_thresh: 0.65\nfree_thresh: 0.196\n{extra}"
        )
    }

    #[test]
    fn a_written_map_survives_a_round_trip() {
        let folder = Folder::new("round-trip");
        let mut grid = OccupancyGrid::new(0.05, [-7.15, 3.0], 3, 2).unwrap();
        grid.set(0, 0, Cell::Free);
        grid.set(1, 0, Cell::Movable);
        grid.set(2, 1, Cell::Occupied);
        let read = read_map(&map_in(&folder, &yaml(&grid, "map.pgm"), &pgm(&grid))).unwrap();
        // Map files do not distinguish fixed and movable cells.
        grid.set(1, 0, Cell::Occupied);
        assert_eq!(read, grid);
    }

    #[test]
    fn text_images_of_any_depth_are_read() {
        let folder = Folder::new("p2");
        let path = map_in(&folder, &yaml_with(""), b"P2\n# remark\n3 1\n15\n0 12 15\n");
        let grid = read_map(&path).unwrap();
        assert_eq!(grid.cells(), [Cell::Occupied, Cell::Unknown, Cell::Free]);
        assert_eq!(grid.origin_m(), [1.0, -2.5]);
    }

    #[test]
    fn an_alpha_channel_counts_only_if_something_is_transparent() {
        let folder = Folder::new("alpha");
        let image = |pixels: &[[u8; 4]]| {
            let bytes = pixels.concat();
            let image = image::RgbaImage::from_raw(pixels.len() as u32, 1, bytes).unwrap();
            let mut png = std::io::Cursor::new(Vec::new());
            image.write_to(&mut png, image::ImageFormat::Png).unwrap();
            folder.file("map.png", &png.into_inner());
            let yaml = yaml_with("").replace("map.pgm", "map.png");
            read_map(&folder.file("map.yaml", yaml.as_bytes())).unwrap().cells().to_vec()
        };
        use Cell::{Free, Occupied, Unknown};
        // A wall is black, whether the file has an alpha channel or not.
        let opaque = [[0, 0, 0, 255], [254, 254, 254, 255], [205, 205, 205, 255]];
        assert_eq!(image(&opaque), [Occupied, Free, Unknown]);
        // map_server's mean of four: 64, 255 * 3 / 4 = 191, 218.
        let partly = [[0, 0, 0, 255], [255, 255, 255, 0], [205, 205, 205, 255]];
        assert_eq!(image(&partly), [Occupied, Unknown, Free]);
    }

    #[test]
    fn modes_and_negation_match_map_server() {
        let folder = Folder::new("modes");
        let image = b"P2 5 1 255 0 100 205 254 70";
        let read = |extra: &str| read_map(&map_in(&folder, &yaml_with(extra), image));
        use Cell::{Free, Occupied, Unknown};
        assert_eq!(
            read("mode: scale").unwrap().cells(),
            [Occupied, Unknown, Unknown, Free, Occupied]
        );
        assert_eq!(
            read("mode: raw").unwrap().cells(),
            [Free, Occupied, Unknown, Unknown, Occupied]
        );
        let negated = yaml_with("").replace("negate: 0", "negate: true");
        let grid = read_map(&map_in(&folder, &negated, image)).unwrap();
        assert_eq!(grid.cells(), [Free, Unknown, Occupied, Occupied, Unknown]);
    }

    #[test]
    fn errors_name_the_file_and_the_key_on_one_line() {
        let folder = Folder::new("errors");
        let image = &b"P2 1 1 255 0"[..];
        for (yaml, image, expected) in [
            (yaml_with("").replace("resolution: 0.1\n", ""), image, "resolution"),
            (yaml_with("").replace(": 0.1\n", ": .nan\n"), image, "resolution"),
            (yaml_with("").replace(": 0.1\n", ": -1\n"), image, "resolution"),
            (yaml_with("").replace(": 0.1\n", ": []\n"), image, "line 2"),
            (yaml_with("").replace(", 0.0]", "]"), image, "origin"),
            (yaml_with("").replace("0.0]", ".inf]"), image, "origin"),
            (yaml_with("").replace("0.196", "0.9"), image, "free_thresh"),
            (yaml_with("").replace("0.65", "65"), image, "occupied_thresh"),
            (yaml_with("").replace("map.pgm", "none.pgm"), image, "none.pgm"),
            (yaml_with("mode: sepia"), image, "sepia"),
            (yaml_with(""), b"P5 60000 60000 255\n", "too many"),
            (yaml_with(""), b"P5 2 2 255\nx", "map.pgm"),
            (yaml_with(""), b"P5 0 2 255\n", "map.pgm"),
            (yaml_with(""), b"", "map.pgm"),
            ("\u{0}\u{1}: [".to_owned(), image, "map.yaml"),
            (String::new(), image, "map.yaml"),
        ] {
            let error = read_map(&map_in(&folder, &yaml, image)).unwrap_err().to_string();
            assert!(error.contains(expected), "{error} does not name {expected}");
            assert!(error.contains("map.yaml"), "{error} does not name the file");
            assert_eq!(error.lines().count(), 1, "{error}");
        }
    }

    #[test]
    fn public_ros_maps_are_read() {
        let Some(maps) = shared_data("maps") else { return };
        // Counted from the bytes of the images, by shade. By the thresholds of Depot, its grey
        // counts as free.
        for (file, size, counts) in [
            ("depot/depot.yaml", (604, 307), (179_481, 5_947)),
            ("tb3_sandbox/tb3_sandbox.yaml", (384, 384), (7_903, 870)),
        ] {
            let grid = read_map(&maps.join(file)).unwrap();
            assert_eq!((grid.width(), grid.height()), size, "{file}");
            assert_eq!((grid.counts().free, grid.counts().occupied), counts, "{file}");
        }
        let turned = read_map(&maps.join("map_server_test/testmap.yaml")).unwrap();
        assert_eq!((turned.origin_m(), turned.yaw_rad()), ([2.0, 3.0], 1.0));
    }
}

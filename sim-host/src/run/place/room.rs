//! The files that `ubimap place` reads: the room, the camera and the critical floor.

use std::path::Path;

use image::GenericImageView;

use super::{fault::PlaceFault, options::PlaceOptions};
use crate::{
    files,
    grid::{self, OccupancyGrid, raster},
    perception::markers::LEAST_HEIGHT_PX,
    placement::{
        camera::CameraModel,
        floor_plan::{Enclosure, FloorPlan},
        obstacle::{Obstacle, Outline},
    },
    run::RunError,
    world::{CameraConfig, FixedOutline, FixedPart, Scenario},
};

/// Default height of cameras in a map, in metres.
const MAP_HEIGHT_M: f64 = 3.0;
/// Default distance of cameras from the ceiling of a scenario, in metres.
const BELOW_CEILING_M: f64 = 0.1;
/// Maximum height of robots in a map, in metres; they drive below anything higher.
const ROBOT_HEIGHT_M: f64 = 0.3;

/// Reads a room. Also returns the default height of its cameras, in metres.
pub(super) fn read_room(options: &PlaceOptions) -> Result<(FloorPlan, f64), RunError> {
    let path = &options.room;
    let is_map = path.extension().is_some_and(|it| it == "yaml" || it == "yml");
    let (enclosure, obstacles, ceiling_m, robot_height_m, height_m) = if is_map {
        let map = Enclosure::Map(straight_map(path)?);
        (map, Vec::new(), f64::INFINITY, ROBOT_HEIGHT_M, MAP_HEIGHT_M)
    } else {
        let scenario = Scenario::read(path)?;
        let enclosure = match &scenario.room.map {
            Some(map) => Enclosure::Map(straight_map(map)?),
            None => Enclosure::Outline(scenario.room.outline_m.clone()),
        };
        let obstacles = scenario.fixed_parts()?.into_iter().map(obstacle).collect();
        let ceiling_m = scenario.room.height_m;
        let height_m = ceiling_m - BELOW_CEILING_M.min(ceiling_m / 2.0);
        (enclosure, obstacles, ceiling_m, scenario.robot_height_m(), height_m)
    };
    let heights = [ceiling_m, robot_height_m];
    let plan = FloorPlan::new(enclosure, obstacles, heights, options.cell)
        .map_err(|error| PlaceFault::in_file(path, &error))?;
    Ok((plan, height_m))
}

/// Reads a ROS map that must have a yaw of 0.
fn straight_map(path: &Path) -> Result<OccupancyGrid, RunError> {
    let map = grid::read_map(path)?;
    if map.yaw_rad() != 0.0 {
        return Err(RunError::TurnedMap { path: path.to_owned(), yaw_rad: map.yaw_rad() });
    }
    Ok(map)
}

fn obstacle(part: FixedPart) -> Obstacle {
    let FixedPart { outline, bottom_m, top_m, .. } = part;
    let outline = match outline {
        FixedOutline::Disc { centre_m, radius_m } => Outline::Disc { centre_m, radius_m },
        FixedOutline::Polygon(corners) => Outline::Polygon(corners),
    };
    Obstacle { outline, bottom_m, top_m }
}

/// The camera that is placed.
pub(super) struct PlacedModel {
    /// What it sees.
    pub(super) view: CameraModel,
    /// What its pictures show.
    pub(super) picture: CameraModel,
    /// The distance in metres at which they show a marker that faces the camera just large enough to be read.
    pub(super) readable_m: f64,
    /// Its other keys of a scenario's camera.
    pub(super) keys: toml::Table,
}

/// Reads the camera.
pub(super) fn read_camera(options: &PlaceOptions) -> Result<PlacedModel, RunError> {
    let path = options.camera.as_deref();
    let mut columns = None;
    let (config, mut keys) = match path {
        None => (
            config(toml::Table::new())
                .map_err(|reason| PlaceFault::in_file(Path::new("camera"), &reason))?,
            toml::Table::new(),
        ),
        Some(path) => {
            let text =
                files::read_settings(path).map_err(|error| PlaceFault::in_file(path, &error))?;
            let refuse = |reason: String| PlaceFault::in_file(path, &reason);
            let mut keys: toml::Table = toml::from_str(&text)
                .map_err(|error| refuse(error.message().replace('\n', ", ")))?;
            if let Some(key) = [
                "name",
                "position_m",
                "look_at_m",
                "heading_deg",
                "tilt_deg",
                "roll_deg",
                "cameras",
            ]
            .into_iter()
            .find(|key| keys.contains_key(*key))
            {
                return Err(refuse(format!("{key} is a result of the placement; remove it")).into());
            }
            columns = from_intrinsics(&mut keys).map_err(refuse)?;
            (config(keys.clone()).map_err(refuse)?, keys)
        }
    };
    let CameraConfig { horizontal_fov_deg, vertical_fov_deg, range_m, ref picture, .. } = config;
    let view = CameraModel { horizontal_fov_deg, vertical_fov_deg, range_m };
    // The picture of another camera than the default one is not guessed.
    let stated = (path.is_none() || keys.contains_key("picture"))
        .then_some([picture.horizontal_fov_deg, picture.vertical_fov_deg]);
    let picture = options.picture_fov.or(stated).map_or(view, |[horizontal, vertical]| {
        CameraModel { horizontal_fov_deg: horizontal, vertical_fov_deg: vertical, range_m }
    });
    let is_picture = stated.is_some() || options.picture_fov.is_some();
    let width = match columns {
        Some(columns) if !is_picture => columns,
        _ if is_picture => f64::from(config.picture.width),
        _ => f64::from(config.depth.width),
    };
    let focal_px = width / 2.0 / libm::tan(picture.horizontal_fov_deg.to_radians() / 2.0);
    let readable_m = focal_px * options.marker / LEAST_HEIGHT_PX;
    if let Some([horizontal, vertical]) = options.picture_fov {
        let stated = keys.entry("picture").or_insert_with(|| toml::Table::new().into());
        if let Some(stated) = stated.as_table_mut() {
            stated.insert("horizontal_fov_deg".to_owned(), horizontal.into());
            stated.insert("vertical_fov_deg".to_owned(), vertical.into());
        }
    }
    let is_camera = (1.0..=170.0).contains(&horizontal_fov_deg)
        && (1.0..=170.0).contains(&vertical_fov_deg)
        && (0.01..=1000.0).contains(&range_m);
    if !is_camera {
        let reason = "fields of view must be from 1 to 170 degrees, range_m from 0.01 to 1000 m";
        let path = path.unwrap_or(Path::new("camera"));
        return Err(PlaceFault::in_file(path, &reason).into());
    }
    let rest = keys.into_iter().filter(|(key, _)| {
        !["horizontal_fov_deg", "vertical_fov_deg", "range_m"].contains(&key.as_str())
    });
    Ok(PlacedModel { view, picture, readable_m, keys: rest.collect() })
}

/// A camera of a scenario with these keys.
fn config(mut keys: toml::Table) -> Result<CameraConfig, String> {
    let pose = "position_m = [0.0, 0.0, 1.0]\nheading_deg = 0.0\ntilt_deg = 90.0";
    keys.extend(toml::from_str::<toml::Table>(pose).map_err(|error| error.to_string())?);
    keys.try_into().map_err(|error: toml::de::Error| error.message().replace('\n', ", "))
}

/// Replaces the keys of an `intrinsics.toml` by the fields of view. Returns the width of its images in pixels.
fn from_intrinsics(keys: &mut toml::Table) -> Result<Option<f64>, String> {
    if !keys.contains_key("fx") {
        return Ok(None);
    }
    let mut take = |key: &str| {
        let value = keys.remove(key);
        let number =
            value.as_ref().and_then(|it| it.as_float().or(it.as_integer().map(|it| it as f64)));
        number.filter(|it| it.is_finite()).ok_or(format!("{key} must be a number"))
    };
    let fov = |size: f64, focal: f64, centre: f64| {
        // The narrower half, which is visible on both sides.
        let half = (centre + 0.5).min(size - centre - 0.5).max(0.0);
        2.0 * libm::atan(half / focal.abs()).to_degrees()
    };
    let width = take("width")?;
    let horizontal = fov(width, take("fx")?, take("cx")?);
    let vertical = fov(take("height")?, take("fy")?, take("cy")?);
    ["distortion", "depth_per_metre", "row"].into_iter().for_each(|key| drop(keys.remove(key)));
    keys.insert("horizontal_fov_deg".to_owned(), horizontal.into());
    keys.insert("vertical_fov_deg".to_owned(), vertical.into());
    Ok(Some(width))
}

/// Reads for each cell of the floor whether an image marks it as critical.
pub(super) fn read_critical(path: &Path, plan: &FloorPlan) -> Result<Vec<bool>, RunError> {
    let refuse = |reason: String| PlaceFault::in_file(path, &reason);
    let image = raster::read(path).map_err(|error| refuse(error.to_string()))?.image;
    let found = image.dimensions();
    let (wanted, of) = match plan.enclosure() {
        Enclosure::Map(map) => ([map.width(), map.height()], "the map's image"),
        Enclosure::Outline(_) => (plan.size(), "the room in cells"),
    };
    if [found.0 as usize, found.1 as usize] != wanted {
        return Err(refuse(format!(
            "{} x {} pixels, but {of} has {} x {}",
            found.0, found.1, wanted[0], wanted[1]
        ))
        .into());
    }
    let marks = image.into_luma8();
    let is_marked = |column: usize, row: usize| {
        marks
            .get_pixel_checked(column as u32, (wanted[1] - 1 - row) as u32)
            .is_some_and(|pixel| pixel.0[0] >= 128)
    };
    let cells = plan.cells().iter().map(|cell| match plan.enclosure() {
        Enclosure::Map(map) => {
            let [column, row] = map.from_map(cell.aim_m);
            is_marked(column as usize, row as usize)
        }
        Enclosure::Outline(_) => is_marked(cell.column, cell.row),
    });
    Ok(cells.collect())
}

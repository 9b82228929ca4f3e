//! `ubimap place`: optimal camera positions for a room.

mod fault;
pub mod options;
mod progress;
mod room;

use std::time::Instant;

use image::RgbImage;
use ubimap_protocol::tile::Cell;

use super::{RunError, interruption};
use crate::{
    camera::{CamerasFile, MountedCamera},
    grid::{GridError, OccupancyGrid},
    placement::{
        camera::{CameraModel, Projection},
        candidates::Choices,
        floor_plan::{Enclosure, FloorPlan},
        milp::Milp,
        placing::{Aim, Critical, Placement, PlacementError, Request, Stage, place},
    },
    report::{
        self, Caption, FloorSummary, Marker, MarkerKind, OutputFolder, PlaceReport, PlacedCamera,
        PlacementSummary,
    },
};
pub use fault::PlaceFault;
use options::{ModelName, PlaceOptions};
use progress::PlacingProgress;
use room::PlacedModel;

/// The share of the time limit for a solver of integer programmes.
const MILP_SHARE: f64 = 0.75;

/// Side of a cell of the picture of a drawn room, in metres.
const PICTURE_CELL_M: f64 = 0.05;

/// The results of a placement.
#[derive(Clone, Debug, PartialEq)]
pub struct PlaceOutcome {
    /// The figures.
    pub report: PlaceReport,
    /// The contents of `cameras.toml`.
    pub cameras: String,
    /// A picture of the floor, coloured by the number of cameras that see it.
    pub picture: RgbImage,
}

impl PlaceOutcome {
    /// Writes `cameras.toml`, `coverage.png` and `report.json`: either all of them or
    /// none.
    ///
    /// # Errors
    /// [`RunError::Output`] or [`RunError::Picture`].
    pub fn write(&self, mut folder: OutputFolder) -> Result<(), RunError> {
        folder.add("cameras.toml", self.cameras.as_bytes())?;
        folder.add("coverage.png", &report::png(&self.picture)?)?;
        folder.add("report.json", report::json_pretty(&self.report).as_bytes())?;
        Ok(folder.finish()?)
    }
}

/// Places cameras.
///
/// # Errors
/// [`RunError`] if a file is invalid, or the request can't be met.
pub fn run(options: &PlaceOptions) -> Result<PlaceOutcome, RunError> {
    let started = Instant::now();
    let (plan, height_m) = room::read_room(options)?;
    let camera = room::read_camera(options)?;
    let request = request(options, &plan, &camera, height_m)?;
    let progress = PlacingProgress::new(request.aim);
    let mut solved_s = 0.0;
    let placement = place(&plan, &request, &mut |stage| {
        progress.show(&stage);
        let elapsed = started.elapsed().as_secs_f64();
        if let Stage::Solving(_) = stage {
            solved_s = elapsed;
        }
        if interruption::is_requested() { f64::INFINITY } else { elapsed / options.time_limit }
    });
    progress.finish();
    let placement = placement.map_err(|error| match error {
        PlacementError::NotFound { .. } | PlacementError::Milp(_) => {
            PlaceFault::unanswered(&options.room, &error)
        }
        error => PlaceFault::in_file(&options.room, &error),
    })?;
    let mut report = summarise(options, &plan, &request, &placement);
    report.solved_s = solved_s;
    report.was_interrupted = interruption::is_requested();
    report.elapsed_s = started.elapsed().as_secs_f64();
    let caption = Caption { subject: options.room.display().to_string(), ..Caption::default() };
    Ok(PlaceOutcome {
        cameras: cameras_file(&report, &request.model, &camera.keys),
        picture: picture(&plan, &placement, &report.cameras, &caption)?,
        report,
    })
}

fn request(
    options: &PlaceOptions,
    plan: &FloorPlan,
    camera: &PlacedModel,
    height_m: f64,
) -> Result<Request, RunError> {
    let is_paper = options.model == ModelName::Paper;
    let or = |given: &[f64], default: &[f64]| {
        if given.is_empty() { default.to_vec() } else { given.to_vec() }
    };
    let critical = options.critical.as_deref().map(|path| {
        let cells = room::read_critical(path, plan)?;
        Ok::<_, RunError>(Critical { cells, rule: options.critical_rule.into() })
    });
    Ok(Request {
        projection: options.model.into(),
        model: camera.view,
        picture: camera.picture,
        // The paper's cameras see all that they cover.
        readable_m: if is_paper { f64::INFINITY } else { camera.readable_m },
        choices: Choices {
            heights_m: or(&options.height, &[height_m]),
            tilts_deg: or(&options.tilt, if is_paper { &[90.0] } else { &[90.0, 60.0, 45.0] }),
            headings: options.headings.unwrap_or(if is_paper { 4 } else { 8 }).into(),
            spacing_m: options.spacing,
        },
        at_least: options.min_overlap,
        at_most: options.max_overlap,
        aim: options.aim(),
        critical: critical.transpose()?,
        connect: options.connect,
        milp: options
            .solver
            .milp()
            .map(|solver| Milp { solver, seconds: options.time_limit * MILP_SHARE }),
        seed: options.seed,
    })
}

fn summarise(
    options: &PlaceOptions,
    plan: &FloorPlan,
    request: &Request,
    placement: &Placement,
) -> PlaceReport {
    let cells = placement.overlap.len();
    let is_covered = |overlap: &&u16| **overlap >= request.at_least;
    let most = placement.overlap.iter().copied().max().unwrap_or(0);
    let cameras = placement.cameras.iter().enumerate().map(|(number, camera)| PlacedCamera {
        name: format!("camera-{number:02}"),
        position_m: camera.position_m,
        heading_deg: camera.heading_deg,
        tilt_deg: camera.tilt_deg,
    });
    let mut by_overlap = vec![0; usize::from(most) + 1];
    placement.overlap.iter().for_each(|&overlap| by_overlap[usize::from(overlap)] += 1);
    PlaceReport {
        room: options.room.display().to_string(),
        model: match request.projection {
            Projection::Pinhole => "true",
            Projection::Paper => "paper",
        },
        goal: match request.aim {
            Aim::Cover => "fewest cameras that cover the floor",
            Aim::Share(_) => "fewest cameras that cover a share of the floor",
            Aim::Cameras(_) => "greatest coverage with a number of cameras",
        },
        min_overlap: request.at_least,
        max_overlap: request.at_most,
        floor: FloorSummary {
            cell_m: plan.side_m(),
            cells: cells as u64,
            blind: placement.seen_by.iter().filter(|&&seen_by| seen_by == 0).count() as u64,
            lowered: placement.lowered as u64,
            left_out: plan.left_out() as u64,
        },
        placement: PlacementSummary {
            candidates: placement.candidates as u64,
            spacing_m: placement.spacing_m,
            cameras: placement.cameras.len() as u64,
            added: placement.added as u64,
            covered: placement.overlap.iter().filter(is_covered).count() as u64,
            coverage: placement.overlap.iter().filter(is_covered).count() as f64 / cells as f64,
            by_overlap,
            value: placement.value,
            bound: placement.bound,
            gap: placement.gap(),
            is_optimal: placement.is_optimal(),
            pieces: placement.pieces as u64,
            fewest_pieces: placement.fewest_pieces as u64,
        },
        cameras: cameras.collect(),
        ..PlaceReport::default()
    }
}

/// The cameras as a `cameras.toml`.
fn cameras_file(report: &PlaceReport, model: &CameraModel, keys: &toml::Table) -> String {
    let cameras = report.cameras.iter().map(|camera| MountedCamera {
        name: camera.name.clone(),
        position_m: camera.position_m,
        heading_deg: Some(camera.heading_deg),
        tilt_deg: Some(camera.tilt_deg),
        horizontal_fov_deg: Some(model.horizontal_fov_deg),
        vertical_fov_deg: Some(model.vertical_fov_deg),
        range_m: Some(model.range_m),
        rest: keys.clone(),
        ..MountedCamera::default()
    });
    let file = CamerasFile { cameras: cameras.collect() };
    let heading: String =
        report.describe_placement().lines().map(|line| format!("# {line}\n")).collect();
    format!("{heading}\n{}", file.to_toml())
}

/// The picture of the floor, by the number of cameras that see each cell, with the cameras.
fn picture(
    plan: &FloorPlan,
    placement: &Placement,
    cameras: &[PlacedCamera],
    caption: &Caption,
) -> Result<RgbImage, GridError> {
    let background = background(plan)?;
    let markers: Vec<Marker> = cameras
        .iter()
        .map(|camera| {
            let looks_down = camera.tilt_deg == 90.0;
            let kind = if looks_down { MarkerKind::CameraDown } else { MarkerKind::Camera };
            let [x_m, y_m, ..] = camera.position_m;
            Marker::new(kind, [x_m, y_m], camera.heading_deg.to_radians())
        })
        .collect();
    let [origin, side] = [plan.origin_m(), [plan.side_m(); 2]];
    let floor = |[x, y]: [f64; 2]| {
        let place = |at: f64, axis: usize| ((at - origin[axis]) / side[axis]).floor();
        let (column, row) = (place(x, 0), place(y, 1));
        if column < 0.0 || row < 0.0 {
            return None;
        }
        let cell = plan.cell_at(column as usize, row as usize)?;
        Some((placement.overlap[cell], placement.seen_by[cell] > 0))
    };
    Ok(report::render_overlap(&background, &markers, floor, caption))
}

/// The room as a map, in which obstacles that reach the floor are occupied.
fn background(plan: &FloorPlan) -> Result<OccupancyGrid, GridError> {
    if let Enclosure::Map(map) = plan.enclosure() {
        let mut map = map.clone();
        draw_obstacles(plan, &mut map);
        return Ok(map);
    }
    let [columns, rows] = plan.size();
    let scale = (plan.side_m() / PICTURE_CELL_M).round().max(1.0);
    let resolution = plan.side_m() / scale;
    let [width, height] = [columns, rows].map(|it| it * scale as usize);
    // A room too large for fine cells gets a coarser picture.
    let mut grid = OccupancyGrid::new(resolution, plan.origin_m(), width, height)
        .or_else(|_| OccupancyGrid::new(plan.side_m(), plan.origin_m(), columns, rows))?;
    draw_obstacles(plan, &mut grid);
    Ok(grid)
}

fn draw_obstacles(plan: &FloorPlan, grid: &mut OccupancyGrid) {
    for obstacle in plan.obstacles() {
        let [low, high] = obstacle.bounds();
        let [first, last] = [low, high].map(|corner| grid.from_map(corner));
        for row in first[1].max(0.0) as usize..=last[1].max(0.0) as usize {
            for column in first[0].max(0.0) as usize..=last[0].max(0.0) as usize {
                let centre = grid.to_map([column as f64 + 0.5, row as f64 + 0.5]);
                if !obstacle.contains(centre) {
                    continue;
                }
                if obstacle.bottom_m == 0.0 {
                    grid.set(column, row, Cell::Occupied);
                } else if grid.cell(column, row) != Cell::Occupied {
                    grid.set(column, row, Cell::Movable);
                }
            }
        }
    }
}

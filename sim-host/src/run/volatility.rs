//! How often each cell changes, for the picture.

use ubimap_protocol::{
    tile::{Cell, TILE_SIDE, TileId},
    time::Instant,
};

use crate::{
    deployment::Deployment,
    grid::OccupancyGrid,
    mapping::{CellLabel, MapTime, interval_s},
};

/// The last known code of each cell of a deployment's map, and the expected time in seconds between its
/// changes, row by row; `now` is by the deployment's caller. `None` for cells that were never known.
pub(super) fn intervals(
    deployment: &Deployment,
    map: &OccupancyGrid,
    now: Instant,
) -> Vec<Option<(Cell, f64)>> {
    let server = deployment.server();
    let time = MapTime::at(deployment.server_time(now));
    let side = deployment.resolution().metres();
    let interval = |index: usize| {
        let [column, row] = [index % map.width(), index / map.width()].map(|at| at as f64 + 0.5);
        let [x, y] = map.to_map([column, row]).map(|metres| (metres / side).floor() as i32);
        let id = TileId::of_cell(x, y)?;
        let within = |cell: i32| cell.rem_euclid(TILE_SIDE as i32) as usize;
        let cell = within(y) * TILE_SIDE + within(x);
        let label =
            server.priors().get(id).map_or(CellLabel::None, |priors| priors.get(cell).label);
        let (code, changes, observed_s) = server.volatility().get(id, cell, time);
        (code != Cell::Unknown).then(|| (code, interval_s(label, observed_s, changes)))
    };
    (0..map.width() * map.height()).map(interval).collect()
}

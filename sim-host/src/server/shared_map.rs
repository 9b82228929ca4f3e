//! The map: the layers of the cameras and of each robot, and the fused layer.

use std::collections::{BTreeMap, BTreeSet};

use ubimap_protocol::{
    message::DistanceVector,
    tile::{Epoch, Tile, TileId},
    time::Instant,
    units::{Millimetres, Pose, RobotId},
};

use crate::{
    camera::Observation,
    mapping::{
        Agreements, CameraLayer, CameraTile, MapTime, Mask, PlacedLayer, Placement, PriorLayer,
        RobotLayer, SeenTile, ServedLayer, Sight, TileRecord, Updated, Volatility, Weight, clear,
        fuse, hollow,
    },
    timing::ROBOT_GONE,
};

/// Memory in bytes that is reserved for each robot: some ten tiles.
const SHARE: usize = 64 << 10;
/// Memory in bytes that robots share beyond their reserved memory: some 10,000 tiles, or 3,400 whose
/// cells were moved.
const COMMON: usize = 64 << 20;

/// The layers and everything derived from them.
#[derive(Debug, Default)]
pub(super) struct SharedMap {
    cameras: CameraLayer,
    layers: BTreeMap<RobotId, RobotLayer>,
    /// Where what robots have drawn belongs, if that is known better.
    placed: BTreeMap<RobotId, PlacedLayer>,
    /// Robots whose placement has changed since it was stored.
    unkept_placements: BTreeSet<RobotId>,
    agreements: Agreements,
    /// Weights in the current step of the map's time; robots without an entry have the full weight.
    weights: BTreeMap<RobotId, Weight>,
    /// Tiles with robots' observations that have changed since the weights were computed.
    unweighed: BTreeSet<TileId>,
    time: MapTime,
    priors: PriorLayer,
    volatility: Volatility,
    /// Each fused tile before [`hollow`] and [`clear`], and its cells that cameras have seen.
    whole: BTreeMap<TileId, (Tile, Sight)>,
    fused: ServedLayer,
    /// Tiles with movable or labelled cells, which expire.
    ageing: BTreeSet<TileId>,
    /// Tiles with cells that cameras have seen recently, which expire.
    in_sight: BTreeSet<TileId>,
    /// Where cameras last saw each robot.
    standing: BTreeMap<RobotId, Standing>,
    /// Tiles whose published cells depend on robots standing on them.
    hiding: BTreeSet<TileId>,
}

impl SharedMap {
    pub(super) fn fused(&self) -> &ServedLayer {
        &self.fused
    }

    pub(super) fn time(&self) -> MapTime {
        self.time
    }

    /// Sets what is known beforehand of the cells. Call it before anything is restored or observed.
    pub(super) fn expect(&mut self, priors: PriorLayer) {
        self.priors = priors;
    }

    pub(super) fn priors(&self) -> &PriorLayer {
        &self.priors
    }

    pub(super) fn volatility(&self) -> &Volatility {
        &self.volatility
    }

    /// Notes where a robot has looked, and thereby confirmed what is likely to move.
    pub(super) fn look_along(&mut self, vector: &DistanceVector, side: Millimetres) {
        let seen = self.priors.look(vector, side);
        self.ageing.extend(seen.into_iter().filter(|id| self.whole.contains_key(id)));
    }

    /// A robot's layer.
    pub(super) fn layer(&self, robot: RobotId) -> Option<&RobotLayer> {
        self.layers.get(&robot)
    }

    /// A robot's layer for writing; call [`SharedMap::changed`] with the tiles that have changed.
    pub(super) fn layer_mut(&mut self, robot: RobotId) -> &mut RobotLayer {
        self.layers.entry(robot).or_default()
    }

    /// A robot's layer for an update, with the memory that is left for this robot as its limit.
    /// Epochs below `barrier` may soon be void.
    pub(super) fn limited_layer_mut(
        &mut self,
        robot: RobotId,
        barrier: Option<Epoch>,
    ) -> &mut RobotLayer {
        let moved = |robot: &RobotId| self.placed.get(robot).map_or(0, PlacedLayer::memory);
        let others = self.layers.iter().filter(|(other, _)| **other != robot);
        let used = others.map(|(it, layer)| (layer.memory() + moved(it)).saturating_sub(SHARE));
        let limit = SHARE + COMMON.saturating_sub(used.sum());
        let limit = limit.saturating_sub(moved(&robot));
        let layer = self.layer_mut(robot);
        layer.set_limit(limit);
        layer.set_barrier(barrier);
        layer
    }

    /// Forgets a robot that has drawn nothing. Returns whether it did.
    pub(super) fn forget(&mut self, robot: RobotId) -> bool {
        let is_empty = |layer: &RobotLayer| layer.memory() == 0 && layer.next_epoch() <= Epoch(1);
        let is_idle = self.layers.get(&robot).is_some_and(is_empty);
        if is_idle {
            self.layers.remove(&robot);
            self.placed.remove(&robot);
            self.weights.remove(&robot);
            self.agreements.forget(robot);
        }
        is_idle
    }

    /// All robots' layers.
    pub(super) fn layers(&self) -> &BTreeMap<RobotId, RobotLayer> {
        &self.layers
    }

    /// The weight of a robot's claims.
    pub(super) fn weight(&self, robot: RobotId) -> Weight {
        self.weights.get(&robot).copied().unwrap_or(Weight::FULL)
    }

    /// The first epoch after all that the robot is known to have used for its tiles.
    pub(super) fn next_epoch(&self, robot: RobotId) -> Epoch {
        self.layers.get(&robot).map_or(Epoch(1), RobotLayer::next_epoch)
    }

    /// The robot's tiles of epochs below this one are void.
    pub(super) fn first_epoch(&self, robot: RobotId) -> Epoch {
        self.layers.get(&robot).map_or(Epoch(0), RobotLayer::first_epoch)
    }

    /// The cells of a tile that are below robots, as cameras last saw the robots.
    pub(super) fn under(&self, id: TileId) -> Mask {
        union(self.standing.values().map(|it| &it.under), id)
    }

    /// A tile fused without the layer of `robot`, or from all layers if `None`.
    pub(super) fn without(&self, robot: Option<RobotId>, id: TileId) -> Tile {
        self.fused_with(&self.cameras.seen(id), robot, id)
    }

    /// What a robot has drawn of a tile, where it belongs.
    pub(super) fn drawn(&self, robot: RobotId, id: TileId) -> Option<&SeenTile> {
        match self.placed.get(&robot) {
            Some(placed) => placed.tile(id),
            None => self.layers.get(&robot)?.seen(id),
        }
    }

    /// The seconds in which the cells were drawn that a robot has drawn.
    pub(super) fn seconds(&self, robot: RobotId) -> BTreeSet<u32> {
        let tiles = self.layers.get(&robot).into_iter().flat_map(RobotLayer::tiles);
        tiles.flat_map(|(_, seen)| seen.seconds).collect()
    }

    /// How far, in metres, what a robot drew was moved at most.
    pub(super) fn farthest_moved(&self, robot: RobotId) -> f64 {
        self.placed.get(&robot).map_or(0.0, PlacedLayer::farthest_moved)
    }

    /// What is known of where a robot was; `None` if it always was where it believed.
    pub(super) fn placement(&self, robot: RobotId) -> Option<&Placement> {
        self.placed.get(&robot).map(PlacedLayer::placement)
    }

    /// Puts what a robot has drawn where it belongs. Nothing changes until the first robot was wrong; from then on the
    /// ground that others saw counts as well, as they don't report what the map has.
    pub(super) fn place(&mut self, robot: RobotId, placement: Placement, resolution: Millimetres) {
        let Some(layer) = self.layers.get(&robot) else { return };
        let is_first = !self.placed.contains_key(&robot);
        let is_right = placement.corrections.iter().all(|it| it.by == Pose::default());
        if self.placed.is_empty() && is_right {
            return;
        }
        let placed = self.placed.entry(robot).or_insert_with(|| PlacedLayer::new(resolution));
        self.unkept_placements.extend((*placed.placement() != placement).then_some(robot));
        let mut changed = placed.place(placement, layer);
        if is_first {
            changed.extend(layer.tiles().map(|(id, _)| id));
        }
        self.changed(&changed);
    }

    /// Returns the robots' placements that have changed since the last call.
    pub(super) fn take_unkept_placements(&mut self) -> Vec<(RobotId, Placement)> {
        let robots = core::mem::take(&mut self.unkept_placements);
        let placement = |robot| Some((robot, self.placement(robot)?.clone()));
        robots.into_iter().filter_map(placement).collect()
    }

    /// Marks what [`SharedMap::take_unkept_placements`] has returned of these robots as not stored.
    pub(super) fn not_kept_placements(&mut self, robots: impl Iterator<Item = RobotId>) {
        self.unkept_placements.extend(robots);
    }

    /// Whether [`SharedMap::take_unkept_placements`] would return anything.
    pub(super) fn has_unkept_placements(&self) -> bool {
        !self.unkept_placements.is_empty()
    }

    fn fused_with(&self, cameras: &SeenTile, robot: Option<RobotId>, id: TileId) -> Tile {
        let others = self.layers.iter().filter(|(other, _)| Some(**other) != robot);
        let others: Vec<(Weight, &SeenTile)> = others
            .filter_map(|(&other, _)| Some((self.weight(other), self.drawn(other, id)?)))
            .collect();
        fuse(cameras, &others, self.priors.get(id), self.time)
    }

    /// What the cameras know of a tile, with robots as movable cells.
    pub(super) fn in_view(&self, id: TileId) -> Tile {
        let mut tile = self.cameras.tile(id);
        for (y, mask) in self.under(id).into_iter().enumerate() {
            let mut row = tile.row(y);
            (row.low, row.high) = (row.low | mask, row.high | mask);
            tile.set_row(y, row);
        }
        tile
    }

    /// Adds the cells of a frame. Returns the changed tiles, for [`SharedMap::changed`].
    pub(super) fn see(&mut self, observation: &Observation) -> BTreeSet<TileId> {
        self.cameras.observe(observation)
    }

    /// Forgets what a camera has seen after `since`. Returns the changed tiles, for
    /// [`SharedMap::changed`].
    pub(super) fn forget_camera(&mut self, camera: usize, since: Instant) -> BTreeSet<TileId> {
        self.cameras.forget(camera, since)
    }

    /// Voids a robot's tiles of epochs below `first_epoch`. Returns the changed tiles and the
    /// epochs that were closed.
    pub(super) fn retire(&mut self, robot: RobotId, first_epoch: Epoch) -> Updated {
        let retired = self.layer_mut(robot).retire(first_epoch);
        self.drew(robot, &retired.tiles);
        retired
    }

    /// Marks a robot's tile as stored on disk.
    pub(super) fn stored(&mut self, robot: RobotId, record: &TileRecord) {
        if let Some(layer) = self.layers.get_mut(&robot) {
            layer.kept(record);
        }
    }

    /// Restores a robot's tile. Returns the tile with its newest closed epoch if one was closed.
    pub(super) fn restore(
        &mut self,
        robot: RobotId,
        record: &TileRecord,
    ) -> BTreeSet<(TileId, Epoch)> {
        let restored = self.layer_mut(robot).restore(record);
        self.drew(robot, &restored.tiles);
        restored.folded
    }

    /// Restores a camera tile.
    pub(super) fn restore_camera_tile(&mut self, tile: &CameraTile) {
        self.cameras.restore(tile);
        self.changed(&BTreeSet::from([tile.id]));
    }

    /// Returns the camera tiles that were observed since the last call.
    pub(super) fn take_unkept(&mut self) -> Vec<CameraTile> {
        self.cameras.take_unkept()
    }

    /// Marks camera tiles that could not be stored, so that the next [`SharedMap::take_unkept`]
    /// returns them again.
    pub(super) fn not_kept(&mut self, tiles: &[CameraTile]) {
        self.cameras.not_kept(tiles);
    }

    /// Whether [`SharedMap::take_unkept`] would return anything.
    pub(super) fn has_unkept(&self) -> bool {
        self.cameras.has_unkept()
    }

    /// Fuses the given tiles again, which a robot has changed in its layer.
    pub(super) fn drew(&mut self, robot: RobotId, ids: &BTreeSet<TileId>) {
        match (self.placed.get_mut(&robot), self.layers.get(&robot)) {
            (Some(placed), Some(layer)) => {
                let changed = placed.drawn(ids, layer);
                self.changed(&changed);
            }
            _ => self.changed(ids),
        }
    }

    /// Fuses the given tiles again after a change of a layer.
    pub(super) fn changed(&mut self, ids: &BTreeSet<TileId>) {
        for &id in ids {
            if self.layers.keys().any(|robot| self.drawn(*robot, id).is_some()) {
                self.unweighed.insert(id);
            }
            self.fuse(id);
        }
    }

    fn fuse(&mut self, id: TileId) {
        let cameras = self.cameras.seen(id);
        let tile = self.fused_with(&cameras, None, id);
        let has_movable = (0..).zip(tile.high).any(|(y, high)| high & tile.low[y] != 0);
        set_member(&mut self.ageing, id, has_movable || self.priors.get(id).is_some());
        self.look(id, tile, &cameras);
    }

    /// Keeps a newly fused tile, and publishes it and its neighbours if it has changed.
    fn look(&mut self, id: TileId, tile: Tile, cameras: &SeenTile) {
        let sight = Sight::of(&tile, cameras, self.time);
        set_member(&mut self.in_sight, id, !sight.is_empty());
        if self.whole.insert(id, (tile, sight)) == Some((tile, sight)) {
            return;
        }
        for (east, north) in (-1..=1).flat_map(|north| (-1..=1).map(move |east| (east, north))) {
            if let Some(id) = beside(id, east, north).filter(|id| self.whole.contains_key(id)) {
                self.publish(id);
            }
        }
    }

    fn publish(&mut self, id: TileId) {
        let Some(&(mut tile, sight)) = self.whole.get(&id) else { return };
        hollow(&mut tile, &sight, |east, north| {
            let (tile, sight) = self.whole.get(&beside(id, east, north)?)?;
            Some((tile, sight))
        });
        // Other robots draw a robot's outline, and no camera sees beside it that nothing else is there.
        let mut clears = union(self.standing.values().map(|it| &it.around), id);
        let seen = self.cameras.tile(id);
        for (y, (mask, under)) in clears.iter_mut().zip(self.under(id)).enumerate() {
            let row = seen.row(y);
            *mask = *mask & row.low & !row.high | under;
        }
        let hides = clear(&mut tile, &clears);
        set_member(&mut self.hiding, id, hides);
        self.volatility.note(id, &tile, self.time);
        self.fused.set(id, tile);
    }

    /// Records that a camera saw a robot at `captured` on the cells `under`, and that it may touch those `around`.
    pub(super) fn stands(
        &mut self,
        robot: RobotId,
        captured: Instant,
        under: impl Iterator<Item = (i32, i32)>,
        around: impl Iterator<Item = (i32, i32)>,
    ) {
        let standing = Standing { captured, under: masks(under), around: masks(around) };
        let last = self.standing.entry(robot).or_default();
        if captured < last.captured {
            return;
        }
        let before = core::mem::replace(last, standing);
        let after = &self.standing[&robot];
        if before.under == after.under && before.around == after.around {
            return;
        }
        let mut other: BTreeSet<TileId> =
            before.around.into_keys().filter(|id| self.hiding.contains(id)).collect();
        other.extend(after.around.iter().filter_map(|(&id, mask)| {
            let (_, tile) = self.fused.get(id)?;
            let hides = mask.iter().zip(tile.high).any(|(mask, high)| mask & high != 0);
            (hides || self.hiding.contains(&id)).then_some(id)
        }));
        other.into_iter().for_each(|id| self.publish(id));
    }

    /// Adds a distance vector: `agree` of its points are on surfaces that cameras see, `contradict`
    /// are in free ground.
    pub(super) fn looked(&mut self, robot: RobotId, agree: u32, contradict: u32) {
        self.agreements.looked(robot, agree, contradict);
    }

    /// Updates the map to `now`. At each step of the map's time, recomputes the robots' weights and
    /// forgets expired movable cells. Returns the robots that have just lost their full weight.
    pub(super) fn age(&mut self, now: Instant) -> Vec<RobotId> {
        let time = MapTime::at(now);
        if time <= self.time {
            return Vec::new();
        }
        self.time = time;
        let mut bared = BTreeSet::new();
        self.standing.retain(|_, standing| {
            let stands = now.since(standing.captured) <= ROBOT_GONE;
            if !stands {
                bared.extend(standing.around.keys().filter(|id| self.hiding.contains(id)));
            }
            stands
        });
        bared.into_iter().for_each(|id| self.publish(id));
        let mut other = core::mem::take(&mut self.ageing);
        for id in core::mem::take(&mut self.unweighed) {
            let robots = self.layers.keys();
            let robots: Vec<(RobotId, Tile)> =
                robots.filter_map(|&robot| Some((robot, self.drawn(robot, id)?.tile))).collect();
            let robots: Vec<(RobotId, &Tile)> =
                robots.iter().map(|(robot, tile)| (*robot, tile)).collect();
            self.agreements.count(id, &self.cameras.tile(id), &robots);
        }
        let mut disagree = Vec::new();
        for (&robot, layer) in &self.layers {
            let weight = self.agreements.weight(robot);
            let last = self.weights.insert(robot, weight).unwrap_or(Weight::FULL);
            if weight != last {
                match self.placed.get(&robot) {
                    Some(placed) => other.extend(placed.tiles()),
                    None => other.extend(layer.tiles().map(|(id, _)| id)),
                }
                disagree.extend((last == Weight::FULL).then_some(robot));
            }
        }
        // All other tiles keep their fused cells, but some may no longer be in view.
        for id in self.in_sight.difference(&other).copied().collect::<Vec<_>>() {
            if let Some(&(tile, _)) = self.whole.get(&id) {
                self.look(id, tile, &self.cameras.seen(id));
            }
        }
        other.into_iter().for_each(|id| self.fuse(id));
        disagree
    }

    /// The deadline for the next call of [`SharedMap::age`].
    pub(super) fn poll_timeout(&self) -> Option<Instant> {
        let waits = !(self.unweighed.is_empty()
            && self.ageing.is_empty()
            && self.hiding.is_empty()
            && self.in_sight.is_empty());
        waits.then(|| self.time.next())
    }
}

/// Where a robot stands.
#[derive(Debug, Default)]
struct Standing {
    captured: Instant,
    /// The cells below the robot.
    under: BTreeMap<TileId, Mask>,
    /// These, and those that it touches or almost touches.
    around: BTreeMap<TileId, Mask>,
}

/// Cells by tile; those beyond the map's range are left out.
fn masks(cells: impl Iterator<Item = (i32, i32)>) -> BTreeMap<TileId, Mask> {
    let mut masks = BTreeMap::<TileId, Mask>::new();
    for (x, y) in cells {
        if let Some(id) = TileId::of_cell(x, y) {
            let (west, south) = id.first_cell();
            masks.entry(id).or_default()[(y - south) as usize] |= 1 << (x - west);
        }
    }
    masks
}

/// The cells of a tile that are in any of the masks.
fn union<'a>(masks: impl Iterator<Item = &'a BTreeMap<TileId, Mask>>, id: TileId) -> Mask {
    let mut all = Mask::default();
    for mask in masks.filter_map(|masks| masks.get(&id)) {
        all.iter_mut().zip(mask).for_each(|(row, more)| *row |= more);
    }
    all
}

/// The tile at this offset in tiles; `None` beyond the map's range.
fn beside(id: TileId, east: i16, north: i16) -> Option<TileId> {
    Some(TileId { x: id.x.checked_add(east)?, y: id.y.checked_add(north)? })
}

fn set_member(set: &mut BTreeSet<TileId>, id: TileId, is_member: bool) {
    if is_member {
        set.insert(id);
    } else {
        set.remove(&id);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ubimap_protocol::tile::{Cell, Stamp, TILE_CELLS, TILE_SIDE, Version};

    #[test]
    fn an_outline_drawn_by_others_is_cleared_where_cameras_see_floor() {
        const ROBOT: RobotId = RobotId(7);
        let (wall, ring) = ((12, 8), (10, 8));
        let mut map = SharedMap::default();
        let cells = (0..TILE_SIDE as i32).flat_map(|y| (0..TILE_SIDE as i32).map(move |x| (x, y)));
        let cells = cells.map(|at| (at, if at == wall { Cell::Occupied } else { Cell::Free }));
        let captured = Instant(1_000_000);
        let seen = map.see(&Observation { captured, cells: cells.collect(), ..Default::default() });
        map.changed(&seen);

        let id = TileId { x: 0, y: 0 };
        let mut drawn = Tile::UNKNOWN;
        [ring, wall, (20, 20)]
            .iter()
            .for_each(|&(x, y)| drawn.set(x as usize, y as usize, Cell::Occupied));
        let stamp = Stamp { epoch: Epoch(1), version: Version(1) };
        let seconds = [5; TILE_CELLS as usize];
        map.restore(RobotId(2), &TileRecord { id, stamp, cells: drawn, known: drawn, seconds });
        let cell = |map: &SharedMap, (x, y): (i32, i32)| {
            map.fused().get(id).unwrap().1.cell(x as usize, y as usize)
        };
        assert_eq!(cell(&map, ring), Cell::Occupied);

        let square = |reach: i32| {
            (8 - reach..=8 + reach).flat_map(move |y| (8 - reach..=8 + reach).map(move |x| (x, y)))
        };
        map.stands(ROBOT, Instant(6_000_000), square(1), square(4));
        assert_eq!(cell(&map, ring), Cell::Free);
        assert_eq!(cell(&map, wall), Cell::Occupied, "the cameras see it");
        assert_eq!(cell(&map, (20, 20)), Cell::Occupied, "beyond the robot");
        // It comes back when the robot leaves.
        map.stands(ROBOT, Instant(7_000_000), [].into_iter(), [].into_iter());
        assert_eq!(cell(&map, ring), Cell::Occupied);
    }
}

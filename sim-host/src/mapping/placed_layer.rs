//! What a robot drew, at the places where it belongs by what is known now.
//!
//! A robot draws at the pose in which it believes, and nothing that it has drawn is ever drawn anew. When the server
//! learns that the robot was somewhere else, the cells move: all that it drew in a second by one rigid motion.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::Point2;
use ubimap_protocol::{
    tile::{Cell, TILE_SIDE, TileId},
    units::{Millimetres, Pose},
};

use super::{
    mask::Mask,
    robot_layer::{RobotLayer, SeenTile},
    submaps::{Motion, motion},
};

/// Estimated memory of a tile in bytes: its cells where they were drawn, and where they belong.
const TILE_MEMORY: usize = 13 << 10;
/// The second of ground that the robot saw, but did not draw, where it belongs: what anybody draws is newer.
const LOOKED: u32 = 1;

/// From a second on, by how much the robot was off.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Correction {
    /// Second of the server's clock.
    pub since: u32,
    /// The motion in `map` from where the robot drew to where it was.
    pub by: Pose,
}

/// What is known of where a robot was.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Placement {
    /// By how much it was off, in order of time.
    pub corrections: Vec<Correction>,
    /// The ground that it saw to be free, by tile.
    pub ground: BTreeMap<TileId, Mask>,
}

/// A robot's corrections, and the tiles that they change.
#[derive(Clone, Debug)]
pub struct PlacedLayer {
    resolution: Millimetres,
    placement: Placement,
    /// The corrections as motions; `None` for none at all.
    motions: Vec<Option<Motion>>,
    /// Where the cells of each tile that the robot drew belong, by tile.
    moved: BTreeMap<TileId, BTreeMap<TileId, Vec<Moved>>>,
    /// How far in metres any cell of each of those tiles was moved.
    farthest: BTreeMap<TileId, f64>,
    /// The tiles from which cells come into each tile.
    sources: BTreeMap<TileId, BTreeSet<TileId>>,
    placed: BTreeMap<TileId, Box<SeenTile>>,
}

/// A cell that belongs somewhere in a tile.
#[derive(Clone, Copy, Debug)]
struct Moved {
    /// Its index there.
    cell: u16,
    code: Cell,
    second: u32,
}

impl PlacedLayer {
    /// Nothing is corrected.
    pub fn new(resolution: Millimetres) -> Self {
        Self {
            resolution,
            placement: Placement::default(),
            motions: Vec::new(),
            moved: BTreeMap::new(),
            farthest: BTreeMap::new(),
            sources: BTreeMap::new(),
            placed: BTreeMap::new(),
        }
    }

    /// What is known of where the robot was.
    pub fn placement(&self) -> &Placement {
        &self.placement
    }

    /// Estimated memory in bytes.
    pub fn memory(&self) -> usize {
        self.moved.len().max(self.placed.len()) * TILE_MEMORY
    }

    /// A tile at its place. `None` if nothing that the robot has drawn belongs there.
    pub fn tile(&self, id: TileId) -> Option<&SeenTile> {
        self.placed.get(&id).map(Box::as_ref)
    }

    /// The tiles with anything in them.
    pub fn tiles(&self) -> impl Iterator<Item = TileId> {
        self.placed.keys().copied()
    }

    /// How far, in metres, what the robot drew was moved at most.
    pub fn farthest_moved(&self) -> f64 {
        self.farthest.values().copied().fold(0.0, f64::max)
    }

    /// Replaces what is known of where the robot was. Returns the tiles that change. Cost: some 0.1 ms for each of the
    /// tiles with cells that move.
    pub fn place(&mut self, placement: Placement, layer: &RobotLayer) -> BTreeSet<TileId> {
        let Placement { corrections: old, ground } =
            core::mem::replace(&mut self.placement, placement);
        let corrections = &self.placement.corrections;
        let by = |motions: &[Correction], index: Option<usize>| {
            index.map_or(Pose::default(), |index| motions[index].by)
        };
        let seconds: BTreeSet<u32> = old.iter().chain(corrections).map(|it| it.since).collect();
        // The first second of each time in which the correction has changed, and the one after its last.
        let mut changed: Vec<(u32, u32)> = Vec::new();
        let mut ends = seconds.iter().skip(1).copied().chain([u32::MAX]);
        for &since in &seconds {
            let until = ends.next().unwrap_or(u32::MAX);
            if by(&old, index_at(&old, since)) != by(corrections, index_at(corrections, since)) {
                match changed.last_mut().filter(|last| last.1 == since) {
                    Some(last) => last.1 = until,
                    None => changed.push((since, until)),
                }
            }
        }
        self.motions = corrections
            .iter()
            .map(|it| (it.by != Pose::default()).then(|| motion(it.by)))
            .collect();
        let is_changed = |second: u32| {
            let after = changed.partition_point(|&(since, _)| since <= second);
            after.checked_sub(1).is_some_and(|index| second < changed[index].1)
        };
        let tiles: BTreeSet<TileId> = layer
            .tiles()
            .filter(|(id, seen)| {
                !self.moved.contains_key(id) || seen.seconds.iter().any(|it| is_changed(*it))
            })
            .map(|(id, _)| id)
            .collect();
        let now = &self.placement.ground;
        let bare = ground.keys().chain(now.keys()).filter(|id| ground.get(id) != now.get(id));
        let mut concerned: BTreeSet<TileId> = bare.copied().collect();
        concerned.append(&mut self.project_all(&tiles, layer));
        self.compose(&concerned)
    }

    /// Takes over tiles that the robot has drawn in. Returns the tiles that change.
    pub fn drawn(&mut self, tiles: &BTreeSet<TileId>, layer: &RobotLayer) -> BTreeSet<TileId> {
        let concerned = self.project_all(tiles, layer);
        self.compose(&concerned)
    }

    /// Finds where the cells of tiles belong. Returns the tiles that it concerns.
    fn project_all(&mut self, tiles: &BTreeSet<TileId>, layer: &RobotLayer) -> BTreeSet<TileId> {
        let mut concerned = BTreeSet::new();
        for &source in tiles {
            let Some(seen) = layer.seen(source) else { continue };
            let (moved, farthest) = self.project(source, seen);
            self.farthest.insert(source, farthest);
            concerned.extend(moved.keys().copied());
            for &target in moved.keys() {
                self.sources.entry(target).or_default().insert(source);
            }
            for target in self.moved.insert(source, moved).into_iter().flatten().map(|it| it.0) {
                concerned.insert(target);
                if !self.moved[&source].contains_key(&target)
                    && let Some(sources) = self.sources.get_mut(&target)
                {
                    sources.remove(&source);
                }
            }
        }
        concerned
    }

    /// Where the cells of a tile belong, and how far in metres any of them is moved.
    fn project(&self, id: TileId, seen: &SeenTile) -> (BTreeMap<TileId, Vec<Moved>>, f64) {
        let mut moved: BTreeMap<TileId, Vec<Moved>> = BTreeMap::new();
        let mut farthest = 0.0_f64;
        let mut put = |(x, y): (i32, i32), code, second| {
            let Some(id) = TileId::of_cell(x, y) else { return };
            let (west, south) = id.first_cell();
            let cell = (y - south) as u16 * TILE_SIDE as u16 + (x - west) as u16;
            moved.entry(id).or_default().push(Moved { cell, code, second });
        };
        let side = self.resolution.metres();
        let middle = |(x, y): (i32, i32)| {
            Point2::new((f64::from(x) + 0.5) * side, (f64::from(y) + 0.5) * side)
        };
        let floor = |it: f64| it as i32 - i32::from(it < f64::from(it as i32));
        let cell = |at: Point2<f64>| (floor(at.x / side), floor(at.y / side));
        let (west, south) = id.first_cell();
        for (index, &second) in seen.seconds.iter().enumerate() {
            let (x, y) = (index % TILE_SIDE, index / TILE_SIDE);
            let code = seen.tile.cell(x, y);
            if code == Cell::Unknown {
                continue;
            }
            let here = (west + x as i32, south + y as i32);
            let by =
                index_at(&self.placement.corrections, second).and_then(|index| self.motions[index]);
            let Some(by) = by else {
                put(here, code, second);
                continue;
            };
            // Back from where a cell comes to, so that a turn leaves no gaps.
            let there = by * middle(here);
            farthest = farthest.max((there - middle(here)).norm());
            let (x, y) = cell(there);
            let back = by.inverse();
            for there in (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| (x + dx, y + dy))) {
                if cell(back * middle(there)) == here {
                    put(there, code, second);
                }
            }
        }
        (moved, farthest)
    }

    /// Puts tiles together again, and those beside them. Returns those that have changed.
    fn compose(&mut self, targets: &BTreeSet<TileId>) -> BTreeSet<TileId> {
        let concerned: BTreeSet<TileId> = targets
            .iter()
            .flat_map(|id| [*id].into_iter().chain(beside(*id).into_iter().flatten()))
            .collect();
        let mut torn: BTreeMap<TileId, Box<SeenTile>> = BTreeMap::new();
        for &id in &concerned {
            for id in [Some(id)].into_iter().chain(beside(id)).flatten() {
                torn.entry(id).or_insert_with(|| self.joined(id));
            }
        }
        let nothing = SeenTile::NOTHING;
        let at = |id: Option<TileId>| id.and_then(|id| torn.get(&id)).map_or(&nothing, Box::as_ref);
        let mut changed = BTreeSet::new();
        for id in concerned {
            let mut tile = Box::new(at(Some(id)).clone());
            let [west, east, south, north] = beside(id).map(at);
            close(&mut tile, [west, at(Some(id)), east], |way, along| (along, way));
            close(&mut tile, [south, at(Some(id)), north], |way, along| (way, along));
            let before = match tile.tile == nothing.tile {
                true => self.placed.remove(&id),
                false => self.placed.insert(id, tile),
            };
            if before.as_ref() != self.placed.get(&id) {
                changed.insert(id);
            }
        }
        changed
    }

    /// The cells that belong in a tile: of each the newest claim, or of the same second, occupied before free.
    fn joined(&self, id: TileId) -> Box<SeenTile> {
        let mut tile = Box::new(SeenTile::NOTHING);
        let sources = self.sources.get(&id).into_iter().flatten();
        let cells = sources.filter_map(|source| self.moved.get(source)?.get(&id));
        for &Moved { cell, code, second } in cells.flatten() {
            let index = usize::from(cell);
            let (x, y) = (index % TILE_SIDE, index / TILE_SIDE);
            let before = tile.tile.cell(x, y);
            let is_newer = (second, code.code()) > (tile.seconds[index], before.code());
            if before == Cell::Unknown || is_newer {
                tile.tile.set(x, y, code);
                tile.seconds[index] = second;
            }
        }
        for (y, mask) in self.placement.ground.get(&id).into_iter().flatten().enumerate() {
            let mut row = tile.tile.row(y);
            let bare = mask & !row.known();
            row.low |= bare;
            tile.tile.set_row(y, row);
            let bare = (0..TILE_SIDE).filter(|x| bare & 1 << x != 0);
            bare.for_each(|x| tile.seconds[y * TILE_SIDE + x] = LOOKED);
        }
        tile
    }
}

/// The tiles in the west, east, south and north of a tile.
fn beside(TileId { x, y }: TileId) -> [Option<TileId>; 4] {
    [
        (x.checked_sub(1), Some(y)),
        (x.checked_add(1), Some(y)),
        (Some(x), y.checked_sub(1)),
        (Some(x), y.checked_add(1)),
    ]
    .map(|(x, y)| Some(TileId { x: x?, y: y? }))
}

/// Closes gaps of a cell in free ground and in walls, along the lines through three tiles in a row:
/// what was drawn at different times is moved by different motions. `place` returns x and y from
/// the number of a line and the place on it.
fn close(
    tile: &mut SeenTile,
    torn: [&SeenTile; 3],
    place: impl Fn(usize, usize) -> (usize, usize),
) {
    for line in 0..TILE_SIDE {
        let code = |along: usize| {
            let (x, y) = place(line, along % TILE_SIDE);
            torn[along / TILE_SIDE].tile.cell(x, y)
        };
        let second = |along: usize| {
            let (x, y) = place(line, along % TILE_SIDE);
            torn[along / TILE_SIDE].seconds[y * TILE_SIDE + x]
        };
        for along in TILE_SIDE..2 * TILE_SIDE {
            let (x, y) = place(line, along - TILE_SIDE);
            let beside = code(along - 1);
            if tile.tile.cell(x, y) == Cell::Unknown && beside == code(along + 1) {
                tile.tile.set(x, y, beside);
                tile.seconds[y * TILE_SIDE + x] = second(along - 1).min(second(along + 1));
            }
        }
    }
}

/// The index of the correction that holds at a second.
fn index_at(corrections: &[Correction], second: u32) -> Option<usize> {
    corrections.partition_point(|it| it.since <= second).checked_sub(1)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use ubimap_protocol::tile::{Epoch, Stamp, Tile, Version};

    use super::*;
    use crate::mapping::TileRecord;

    const CELL: Millimetres = Millimetres(50);

    /// What a robot has drawn: the cells of tiles, each in its second.
    fn drawn(cells: &[((i32, i32), Cell, u32)]) -> RobotLayer {
        let mut tiles: BTreeMap<TileId, SeenTile> = BTreeMap::new();
        for &((x, y), code, second) in cells {
            let id = TileId::of_cell(x, y).unwrap();
            let (west, south) = id.first_cell();
            let (x, y) = ((x - west) as usize, (y - south) as usize);
            let seen = tiles.entry(id).or_insert(SeenTile::NOTHING);
            seen.tile.set(x, y, code);
            seen.seconds[y * TILE_SIDE + x] = second;
        }
        let mut layer = RobotLayer::default();
        for (id, SeenTile { tile, seconds }) in tiles {
            let stamp = Stamp { epoch: Epoch(1), version: Version(1) };
            layer.restore(&TileRecord { id, stamp, cells: tile, known: tile, seconds });
        }
        layer
    }

    fn corrections(all: &[(u32, f64, f64, f64)]) -> Placement {
        let correction = |&(since, x, y, degrees): &(u32, f64, f64, f64)| Correction {
            since,
            by: Pose::from_metres(x, y, degrees.to_radians()),
        };
        Placement { corrections: all.iter().map(correction).collect(), ..Placement::default() }
    }

    fn cells(placed: &PlacedLayer, wanted: Cell) -> BTreeSet<(i32, i32)> {
        let mut found = BTreeSet::new();
        for id in placed.tiles() {
            let (west, south) = id.first_cell();
            let tile: &Tile = &placed.tile(id).unwrap().tile;
            for (x, y) in (0..TILE_SIDE).flat_map(|x| (0..TILE_SIDE).map(move |y| (x, y))) {
                if tile.cell(x, y) == wanted {
                    found.insert((west + x as i32, south + y as i32));
                }
            }
        }
        found
    }

    #[test]
    fn a_wall_that_was_drawn_twice_is_one() {
        let first = (0..40).map(|y| ((10, y), Cell::Occupied, 5));
        let second = (0..40).map(|y| ((14, y), Cell::Occupied, 60));
        let layer = drawn(&first.chain(second).collect::<Vec<_>>());
        let mut placed = PlacedLayer::new(CELL);
        placed.place(corrections(&[(0, 0.0, 0.0, 0.0), (50, -0.2, 0.0, 0.0)]), &layer);
        assert_eq!(cells(&placed, Cell::Occupied), (0..40).map(|y| (10, y)).collect());
        // It was the first that was wrong.
        let changed = placed.place(corrections(&[(0, 0.2, 0.0, 0.0)]), &layer);
        let moved = [10, 14].map(|x| x + 4).into_iter();
        let expected = moved.flat_map(|x| (0..40).map(move |y| (x, y))).collect();
        assert_eq!(cells(&placed, Cell::Occupied), expected);
        assert_eq!(changed.len(), 2);
        // What stays as it is is no change.
        assert_eq!(placed.place(corrections(&[(0, 0.2, 0.0, 0.0)]), &layer).len(), 0);
        assert!((placed.farthest_moved() - 0.2).abs() < 1e-9);
        assert_eq!(placed.place(corrections(&[]), &layer).len(), 2);
        assert_eq!(placed.farthest_moved(), 0.0);
    }

    #[test]
    fn ground_that_was_seen_is_free_where_nothing_was_drawn() {
        let west = (0..12).map(|x| ((x, 3), Cell::Free, 5));
        let east = (12..20).map(|x| ((x, 3), Cell::Free, 60));
        let wall = [((20, 3), Cell::Occupied, 60)];
        let layer = drawn(&west.chain(east).chain(wall).collect::<Vec<_>>());
        let mut placed = PlacedLayer::new(CELL);
        let moved = corrections(&[(50, 0.2, 0.0, 0.0)]);
        placed.place(moved.clone(), &layer);
        let torn = (0..12).chain(16..24).map(|x| (x, 3));
        assert_eq!(cells(&placed, Cell::Free), torn.collect());
        let mut rows = [0; TILE_SIDE];
        rows[3] = 0x03FF_FFFF;
        let ground = BTreeMap::from([(TileId { x: 0, y: 0 }, rows)]);
        let changed = placed.place(Placement { ground, ..moved.clone() }, &layer);
        assert_eq!(changed, BTreeSet::from([TileId { x: 0, y: 0 }]));
        assert_eq!(cells(&placed, Cell::Free), (0..24).chain([25]).map(|x| (x, 3)).collect());
        assert_eq!(cells(&placed, Cell::Occupied), BTreeSet::from([(24, 3)]));
        assert_eq!(placed.place(moved, &layer), changed);
    }

    proptest! {
        /// However the corrections came about, and whatever was drawn meanwhile, the result is that of the last ones.
        #[test]
        fn the_way_does_not_matter(
            all in proptest::collection::vec((-40..40i32, -40..40i32, any::<bool>(), 0..9u32), 1..60),
            ground in proptest::collection::btree_map((-2..2i16, -2..2i16), any::<[u32; TILE_SIDE]>(), 0..4),
            early in proptest::collection::vec((0..9u32, -0.9..0.9f64, -0.9..0.9f64, -20.0..20.0f64), 0..4),
            late in proptest::collection::vec((0..9u32, -0.9..0.9f64, -0.9..0.9f64, -20.0..20.0f64), 0..4),
            part in 0..60usize,
        ) {
            let code = |occupied| if occupied { Cell::Occupied } else { Cell::Free };
            let all: Vec<_> = all.into_iter().map(|(x, y, it, second)| ((x, y), code(it), second)).collect();
            let sorted = |mut them: Vec<(u32, f64, f64, f64)>| {
                them.sort_by_key(|it| it.0);
                them.dedup_by_key(|it| it.0);
                corrections(&them)
            };
            let ground = ground.into_iter().map(|((x, y), rows)| (TileId { x, y }, rows)).collect();
            let (early, late) = (Placement { ground, ..sorted(early) }, sorted(late));
            let (some, whole) = (drawn(&all[..part.min(all.len())]), drawn(&all));
            let mut placed = PlacedLayer::new(CELL);
            placed.place(early, &some);
            placed.drawn(&whole.tiles().map(|(id, _)| id).collect(), &whole);
            placed.place(late.clone(), &whole);
            let mut direct = PlacedLayer::new(CELL);
            direct.place(late, &whole);
            prop_assert_eq!(
                placed.tiles().map(|id| (id, placed.tile(id).cloned())).collect::<Vec<_>>(),
                direct.tiles().map(|id| (id, direct.tile(id).cloned())).collect::<Vec<_>>()
            );
        }

        /// A turn leaves no gaps: a square of cells stays one.
        #[test]
        fn ground_stays_whole(x in -0.9..0.9f64, y in -0.9..0.9f64, degrees in -180.0..180.0f64) {
            let square: Vec<_> =
                (-20..20).flat_map(|x| (-20..20).map(move |y| ((x, y), Cell::Free, 1))).collect();
            let layer = drawn(&square);
            let mut placed = PlacedLayer::new(CELL);
            placed.place(corrections(&[(0, x, y, degrees)]), &layer);
            let there = cells(&placed, Cell::Free);
            let motion = motion(Pose::from_metres(x, y, degrees.to_radians()));
            for (x, y) in (-18..18).flat_map(|x| (-18..18).map(move |y| (x, y))) {
                let at = motion * Point2::new((f64::from(x) + 0.5) * 0.05, (f64::from(y) + 0.5) * 0.05);
                let cell = ((at.x / 0.05).floor() as i32, (at.y / 0.05).floor() as i32);
                prop_assert!(there.contains(&cell), "{cell:?}");
            }
            prop_assert!((1_500..1_700).contains(&there.len()), "{}", there.len());
        }
    }
}

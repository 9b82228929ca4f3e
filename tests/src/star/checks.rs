//! Invariants that hold at any time, and conditions that hold once everything has settled.

use std::{
    collections::{BTreeMap, BTreeSet},
    iter, mem,
};

use ubimap_agent::Robot;
use ubimap_protocol::{
    link::Counters,
    tile::{Cell, Layer, Stamp, TILE_SIDE, Tile, TileId, tile_hash},
    units::RobotId,
};
use ubimap_sim_host::mapping::{SeenTile, Sight, clear, fuse, hollow};

use super::{Member, Star};
use crate::{disk::Disk, plain_map::PlainMap};

impl<'b> Star<'b> {
    /// Why the robots' maps have not converged yet; `None` if they have.
    pub fn behind(&self) -> Option<String> {
        if self.server.is_moving() {
            return Some("what robots have drawn still moves".into());
        }
        self.members.iter().find_map(|member| {
            let robot = member.robot.as_ref()?;
            let why = self.behind_at(member, robot)?;
            Some(format!("robot {}: {why}", member.id.0))
        })
    }

    fn behind_at(&self, member: &Member<'b>, robot: &Robot<'b>) -> Option<String> {
        if !robot.is_connected() || self.server.robot_at(member.port) != Some(member.id) {
            return Some(format!(
                "no session, port {} has {:?}",
                member.port,
                self.server.robot_at(member.port)
            ));
        }
        if robot.session() != self.server.session_at(member.port) {
            return Some("it uses another session than the server".into());
        }
        if self.server.state(member.id).is_none() {
            return Some("the server has heard nothing of it in this session".into());
        }
        if !robot.is_idle() {
            let dirty: Vec<_> = robot.own_tiles().tiles().filter(|tile| tile.is_dirty()).collect();
            let dirty: Vec<_> =
                dirty.iter().map(|tile| (tile.id(), tile.publication().is_ready())).collect();
            return Some(format!("it has more to tell: {dirty:?}"));
        }
        if !self.server.is_level(member.id) {
            return Some("the server has more to tell it".into());
        }
        for tile in robot.own_tiles().tiles() {
            let stamp = Stamp { epoch: tile.epoch(), version: tile.publication().version() };
            let layer = self.server.layer(member.id);
            let held = layer.zip(tile.id()).and_then(|(layer, id)| layer.held(id, tile.epoch()));
            let hash = tile_hash(tile.publication().sent());
            if held.is_none_or(|(held, cells)| held != stamp || tile_hash(cells) != hash) {
                let held = held.map(|(held, _)| held);
                return Some(format!(
                    "of its {:?} at {stamp:?} the server holds {held:?}",
                    tile.id()
                ));
            }
        }
        if self.curing.contains(&member.id) {
            return Some("its cure is not over".into());
        }
        let own = self.untold_by(member, robot);
        own.or_else(|| self.missing_at(robot, Layer::Fused))
            .or_else(|| self.missing_at(robot, Layer::Coverage))
    }

    /// A tile of the server that a robot holds in another state, or lacks in its window.
    fn missing_at(&self, robot: &Robot<'b>, layer: Layer) -> Option<String> {
        let served = match layer {
            Layer::Coverage => self.server.coverage(),
            _ => self.server.fused(),
        };
        let epoch = self.server.epoch();
        for (id, replica) in robot.fused_tiles().tiles(layer) {
            let newest = served.get(id);
            let same = newest.is_some_and(|(version, cells)| {
                replica.stamp() == Stamp { epoch, version }
                    && tile_hash(replica.tile()) == tile_hash(cells)
            });
            if !same || replica.is_partial() {
                let newest = newest.map(|(version, _)| version);
                return Some(format!(
                    "of {id:?} of the {layer:?} layer at {newest:?} it holds {:?}, partial {}",
                    replica.stamp(),
                    replica.is_partial()
                ));
            }
        }
        let window = robot.fused_tiles().interest()?;
        let mut wanted = served.within(&window).map(|(id, ..)| id);
        let lacks = |id: &TileId| !robot.fused_tiles().tiles(layer).any(|(held, _)| held == *id);
        wanted.find(lacks).map(|id| format!("it lacks {id:?} of the {layer:?} layer"))
    }

    /// A cell that the robot knows and the server's layer of it lacks or contradicts, unless
    /// another robot has reported it. Nothing is checked if this life of the server repeats an
    /// epoch: a robot may then believe for ever that the map has what an earlier life's map had.
    fn untold_by(&self, member: &Member<'b>, robot: &Robot<'b>) -> Option<String> {
        if self.repeats_epoch {
            return None;
        }
        for tile in robot.own_tiles().tiles() {
            let Some(id) = tile.id() else { continue };
            let known = tile.cells();
            let held = self.server.layer(member.id).and_then(|layer| layer.held(id, tile.epoch()));
            let layers = self.members.iter().filter_map(|it| self.server.layer(it.id)?.seen(id));
            let layers: Vec<&Tile> = layers.map(|seen| &seen.tile).collect();
            let put = self.checked.put.get(&id).copied().unwrap_or_default();
            for (x, y) in (0..TILE_SIDE).flat_map(|y| (0..TILE_SIDE).map(move |x| (x, y))) {
                let known = known.cell(x, y);
                let held = held.map_or(Cell::Unknown, |(_, cells)| cells.cell(x, y));
                let is_told = match held {
                    // A robot does not report a cell that the map already has, or had while it was
                    // believed to be there.
                    Cell::Unknown => {
                        layers.iter().any(|it| it.cell(x, y) != Cell::Unknown)
                            || put[y] >> x & 1 == 1
                    }
                    held => known == held,
                };
                if known != Cell::Unknown && !is_told {
                    return Some(format!(
                        "it knows ({x}, {y}) of {id:?} as {known:?}, and its layer has {held:?}"
                    ));
                }
            }
        }
        None
    }

    /// A robot's own tile that is acknowledged but, as far as the robot knows, not stored.
    pub fn unstored(&self) -> Option<String> {
        self.disk.as_ref()?;
        self.members.iter().find_map(|member| {
            let mut tiles = member.robot.as_ref()?.own_tiles().tiles();
            let tile = tiles.find(|tile| tile.stored() != tile.publication().version())?;
            let (stored, version) = (tile.stored(), tile.publication().version());
            let robot = member.id.0;
            Some(format!("{:?} of robot {robot}: {stored:?} of {version:?} is stored", tile.id()))
        })
    }

    /// Whether a robot holds every fused tile of its window in the server's version. `None` before
    /// it has a window.
    pub fn holds_its_window(&self, member: usize) -> Option<bool> {
        let robot = self.members[member].robot.as_ref()?;
        let window = robot.fused_tiles().interest()?;
        let epoch = self.server.epoch();
        let level = self.server.fused().within(&window).all(|(id, version, cells)| {
            let mut held = robot.fused_tiles().tiles(Layer::Fused).filter(|(held, _)| *held == id);
            held.any(|(_, replica)| {
                let newest = replica.stamp() == Stamp { epoch, version };
                newest && !replica.is_partial() && replica.tile() == cells
            })
        });
        Some(level)
    }

    /// Total bytes of the robots' frames with tiles, and the number of retransmitted frames.
    pub fn effort(&self) -> Vec<(u64, u32)> {
        let robots = self.members.iter().filter_map(|member| member.robot.as_ref());
        robots
            .map(|robot| (robot.statistics().bytes_sent_map, robot.link_counters().retransmissions))
            .collect()
    }

    /// Checks the invariants.
    pub(super) fn check(&mut self) {
        self.check_robots();
        if mem::take(&mut self.server_changed) {
            self.check_layers();
            self.check_acknowledged();
            self.check_ports();
        }
    }

    /// Records the lengths of the queues before they are drained.
    pub(super) fn watch_queues(&mut self) {
        let waiting = self.members.iter().map(|member| self.server.waiting(member.id));
        let writes = self.disk.as_ref().map_or(0, Disk::writes);
        let queues = [waiting.max().unwrap_or(0), writes];
        self.longest_queues = core::array::from_fn(|at| self.longest_queues[at].max(queues[at]));
    }

    /// Checks that known cells of a robot's layer never become unknown at the server, and that the
    /// fused layer is the fusion of the layers.
    fn check_layers(&mut self) {
        let seconds = (self.server_now().micros() / 1_000_000) as u32 + 1;
        let mut changed = BTreeSet::new();
        for robot in self.robots() {
            let Some(layer) = self.server.layer(robot) else { continue };
            let first_epoch = layer.first_epoch();
            let checked = self.checked.first_epochs.insert(robot, first_epoch);
            let is_voided = checked.is_some_and(|checked| checked != first_epoch);
            for (id, seen) in layer.tiles() {
                let before = self.checked.layers.entry((robot, id));
                let before = before.or_insert(SeenTile::NOTHING);
                if before.tile == seen.tile {
                    assert!(before.seconds == seen.seconds, "a time without a change: {id:?}");
                    continue;
                }
                let newest = seen.seconds.iter().max().copied().unwrap_or(0);
                assert!(newest <= seconds, "{id:?} was seen at {newest} s, it is {seconds} s now");
                let known = |tile: &Tile, y: usize| tile.row(y).known();
                let kept =
                    (0..TILE_SIDE).all(|y| known(&before.tile, y) & !known(&seen.tile, y) == 0);
                assert!(kept || is_voided, "{id:?} of robot {} has forgotten cells", robot.0);
                *before = seen.clone();
                changed.insert(id);
            }
        }
        changed.into_iter().for_each(|id| self.check_fused(id));
        for robot in self.robots() {
            let Some(_) = self.server.placement(robot) else { continue };
            for (id, ..) in self.server.fused().tiles() {
                let Some(seen) = self.server.drawn(robot, id) else { continue };
                let put = self.checked.put.entry(id).or_default();
                put.iter_mut().enumerate().for_each(|(y, row)| *row |= seen.tile.row(y).known());
            }
        }
    }

    fn check_fused(&self, id: TileId) {
        let mut expected = self.whole(id);
        let beside = |east: i16, north: i16| {
            Some(self.whole(TileId { x: id.x.checked_add(east)?, y: id.y.checked_add(north)? }))
        };
        let beside: BTreeMap<(i16, i16), Tile> = (-1..=1)
            .flat_map(|north| (-1..=1).map(move |east| (east, north)))
            .filter_map(|at| Some((at, beside(at.0, at.1)?)))
            .collect();
        let unseen = Sight::default();
        hollow(&mut expected, &unseen, |east, north| Some((beside.get(&(east, north))?, &unseen)));
        clear(&mut expected, &self.server.under(id));
        let found = self.server.fused().get(id).map(|(_, tile)| tile);
        // What is drawn may belong elsewhere at once, and its tile is never made.
        let found = found.copied().unwrap_or(Tile::UNKNOWN);
        assert!(found == expected, "{id:?} is not what the layers make");
    }

    /// The fusion of all robots' layers in a tile, and the free ground that cameras have seen where no
    /// robot has.
    fn whole(&self, id: TileId) -> Tile {
        let server = &self.server;
        let robots = self.robots();
        let layers = robots
            .iter()
            .filter_map(|&robot| Some((server.weight(robot), server.drawn(robot, id)?)));
        let layers: Vec<_> = layers.collect();
        let mut whole = fuse(&SeenTile::NOTHING, &layers, None, server.map_time());
        let side = TILE_SIDE as i32;
        for (x, y) in &self.seen_free {
            if (x.div_euclid(side), y.div_euclid(side)) == (i32::from(id.x), i32::from(id.y)) {
                whole.set(x.rem_euclid(side) as usize, y.rem_euclid(side) as usize, Cell::Free);
            }
        }
        whole
    }

    /// The ids of all robots, each once: two robots may share one.
    fn robots(&self) -> BTreeSet<RobotId> {
        self.members.iter().map(|member| member.id).collect()
    }

    /// Checks that the layers match the disk, and that the fused layer is what a plain fusion makes
    /// of the layers, cell by cell.
    pub fn check_all(&self) {
        self.disk.iter().for_each(|disk| disk.check_server(&self.server));
        let robots = self.robots();
        let plain = PlainMap::of(&self.server, &robots, &self.seen_free);
        for (id, _, tile) in self.server.fused().tiles() {
            assert!(*tile == plain.fused(id), "{id:?} is not what a plain fusion makes");
        }
    }

    /// Checks that everything acknowledged by the robot's knowledge has arrived.
    fn check_acknowledged(&self) {
        if self.repeats_epoch {
            return;
        }
        for member in &self.members {
            let Some(robot) = &member.robot else { continue };
            // The epochs of a robot's tiles may be closed by another one with its number.
            let is_number_shared =
                self.members.iter().filter(|other| other.id == member.id).count() > 1;
            if is_number_shared {
                continue;
            }
            // A welcome of the server's previous epoch may arrive late.
            if robot.server_epoch() != Some(self.server.epoch()) || !robot.is_connected() {
                continue;
            }
            let Some(layer) = self.server.layer(member.id) else { continue };
            for tile in robot.own_tiles().tiles().filter(|it| it.publication().is_acknowledged()) {
                let held = tile.id().and_then(|id| layer.held(id, tile.epoch()));
                let version = tile.publication().version();
                assert!(
                    held.is_some_and(|(stamp, _)| stamp.version >= version),
                    "{:?} of robot {} at {version:?} is acknowledged, the server holds {:?}",
                    tile.id(),
                    member.id.0,
                    held.map(|(stamp, _)| stamp)
                );
            }
        }
    }

    fn check_ports(&mut self) {
        for port in 0..self.ports {
            let now = self.server.link_counters(port);
            let last = self.checked.ports.insert(port, now).unwrap_or_default();
            check_counters(last, now);
            let messages = self.server.message_counters(port);
            assert_eq!((messages.unknown, messages.malformed), (0, 0), "at port {port}");
        }
    }

    pub(super) fn check_robots(&mut self) {
        for member in &mut self.members {
            let Some(robot) = &member.robot else { continue };
            if let Some(disk) = &self.disk {
                // The robot has discarded tiles that it drew from wrong poses, or does not know yet
                // which tiles the server has lost.
                let is_excused = self.curing.contains(&member.id)
                    || robot.server_epoch() != Some(self.server.epoch());
                disk.check_robot(member.id, robot.own_tiles(), &mut member.own, is_excused);
            }
            let (now, link) = (robot.statistics(), robot.link_counters());
            let (before, link_before) = mem::replace(&mut member.last, (now, link));
            check_counters(link_before, link);
            assert_eq!((now.unknown_messages, now.malformed_messages), (0, 0));
            assert_eq!(now.bytes_sent, member.up.bytes() - member.bytes_at_boot);
            assert!(now.bytes_sent_map <= now.bytes_sent && now.bytes_sent >= before.bytes_sent);
            let settled = now.mapped + now.gated + now.shaken + now.unsure + now.expired;
            assert!((settled..=settled + 4).contains(&now.scans), "{now:?}");
            assert_eq!(now.pixels.seen, now.pixels.kept + now.pixels.omitted + now.pixels.invalid);
        }
    }
}

fn check_counters(before: Counters, now: Counters) {
    let fields = |it: Counters| {
        [it.sent, it.retransmissions, it.received, it.duplicates, it.bad, it.refused]
    };
    let grown = iter::zip(fields(before), fields(now)).all(|(before, now)| before <= now);
    let sound = now.retransmissions <= now.sent && now.duplicates <= now.received;
    assert!(grown && sound, "{before:?} became {now:?}");
    assert_eq!(now.refused, 0, "a good frame is never refused");
}

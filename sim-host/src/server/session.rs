//! The server's end of a conversation with one robot.

use std::collections::{BTreeMap, VecDeque};

use ubimap_protocol::{
    frame::MAX_FRAME,
    link::{Endpoint, Fill},
    message::{
        Certainty, DistanceVector, FixSource, Interest, MAX_REQUESTS, MAX_STORED, ParameterCommand,
        ParameterReport, PoseFix, Request, State, Stored, TimeReply, ToRobot, Writer,
    },
    tile::{Layer, Stamp, TileId},
    time::{Duration, Instant},
    units::RobotId,
};

use super::{
    aligning::Aligning, budget::Budget, command::Command, events::EventLog, news::News,
    publishing::Publishing, scene::Scene,
};
use crate::camera::Sighting;

/// Reliable frames under way to one robot.
const WINDOW: usize = 16;
/// The token of frames in which no tile travels.
const NO_TILES: u16 = 0;
/// Changes of a fused tile are gathered this long, and those of a coverage tile.
const FUSED_HOLD: Duration = Duration::from_secs(1);
const COVERAGE_HOLD: Duration = Duration::from_millis(500);
/// Tiles are sent together, and then not for a while: the robot must acknowledge each frame.
const TILES_INTERVAL: Duration = Duration::from_millis(400);
/// However many cameras see the robot, fixes are sent no sooner after each other; each message has
/// those before it as well.
const FIX_INTERVAL: Duration = Duration::from_millis(60);
/// Answers to one robot that wait, and tiles to ask it for: an agent makes fewer.
const MOST_WAITING: usize = 256;

pub(super) type Link = Endpoint<ToRobot, u16, WINDOW, MAX_FRAME>;

/// One robot's session.
#[derive(Debug)]
pub(super) struct Session {
    pub(super) robot: RobotId,
    /// The nonce of the hello that it answers.
    pub(super) nonce: u32,
    pub(super) state: Option<State>,
    /// When something of it was last heard.
    pub(super) heard: Instant,
    interest: Option<Interest>,
    fused_tiles: u16,
    /// What the robot holds of the fused and the coverage layer.
    fused: Publishing,
    coverage: Publishing,
    frame: u16,
    next_tiles: Instant,
    /// Newest first.
    fixes: Vec<(Instant, Sighting)>,
    fix_due: bool,
    /// A fix that comes of a match with the map.
    matched: Option<PoseFix>,
    next_fix: Instant,
    times: Vec<(u16, Instant)>,
    /// Commands that have not been sent yet, in order.
    commands: VecDeque<Command>,
    /// The newest of each command that holds until it is replaced: a new session repeats them.
    standing: Vec<Command>,
    /// The command about parameters that has been sent and is not answered yet. The robot answers the
    /// newest alone: the next one waits.
    asked: Option<ParameterCommand>,
    /// What the robot last reported of its parameters.
    pub(super) parameters: Option<ParameterReport>,
    /// The newest distance vector, and how many have come.
    pub(super) distance_vector: Option<DistanceVector>,
    pub(super) distance_vectors: u32,
    /// The last one, until something has been made of it.
    pub(super) new_vector: Option<DistanceVector>,
    /// The answer to the newest of the server's own commands about parameters.
    pub(super) own_report: Option<ParameterReport>,
    /// States of the robot's tiles that are on disk, and of which it has not been told.
    stored: Vec<(TileId, Stamp)>,
    /// The last state of each tile that was put there.
    stored_last: BTreeMap<TileId, Stamp>,
    pub(super) time_requests: u32,
    /// Tiles of the robot's layer to ask for; no tile means all of them.
    requests: Vec<TileId>,
    pub(super) news: News,
    pub(super) events: EventLog,
    pub(super) budget: Budget,
}

impl Session {
    pub(super) fn new(robot: RobotId, nonce: u32, fused_tiles: u16, now: Instant) -> Self {
        Self {
            robot,
            nonce,
            state: None,
            heard: now,
            interest: None,
            fused_tiles,
            fused: Publishing::new(Layer::Fused, FUSED_HOLD, now),
            coverage: Publishing::new(Layer::Coverage, COVERAGE_HOLD, now),
            frame: 0,
            next_tiles: now,
            fixes: Vec::new(),
            fix_due: false,
            matched: None,
            next_fix: now,
            times: Vec::new(),
            commands: VecDeque::new(),
            standing: Vec::new(),
            asked: None,
            parameters: None,
            distance_vector: None,
            distance_vectors: 0,
            new_vector: None,
            own_report: None,
            stored: Vec::new(),
            stored_last: BTreeMap::new(),
            time_requests: 0,
            requests: Vec::new(),
            news: News::default(),
            events: EventLog::default(),
            budget: Budget::default(),
        }
    }

    /// A fix of this robot, later than all before.
    pub(super) fn fix(&mut self, moment: Instant, sighting: Sighting) {
        if self.fixes.first().is_some_and(|&(newest, _)| newest >= moment) {
            return;
        }
        self.fixes.insert(0, (moment, sighting));
        self.fixes.truncate(1 + ubimap_protocol::message::MAX_EARLIER_FIXES);
        self.fix_due = true;
    }

    /// Where the robot was, by what it saw.
    pub(super) fn matched(&mut self, fix: PoseFix) {
        self.matched = Some(fix);
    }

    /// A command for the robot. One that has not been sent gives way to a newer one of its kind.
    pub(super) fn command(&mut self, command: Command) {
        self.commands.retain(|waiting| !waiting.is_replaced_by(&command));
        if command.stands() {
            self.standing.retain(|standing| !standing.is_replaced_by(&command));
            self.standing.push(command.clone());
        }
        if command.is_urgent() {
            self.commands.push_front(command);
        } else {
            self.commands.push_back(command);
        }
    }

    /// Takes over what an earlier session of the same robot left: commands that have not been sent,
    /// those that stand, and what was reported.
    pub(super) fn continue_from(&mut self, earlier: Self) {
        self.parameters = earlier.parameters;
        self.events = earlier.events;
        let asked = earlier.asked.map(Command::Parameter);
        for command in earlier.standing.into_iter().chain(asked).chain(earlier.commands) {
            self.command(command);
        }
    }

    /// Whether something waits that must go before frames that are sent again: a pose, a stop.
    pub(super) fn is_urgent(&self, now: Instant) -> bool {
        self.fix_due(now)
            || self.matched.is_some()
            || self.commands.front().is_some_and(Command::is_urgent)
    }

    fn fix_due(&self, now: Instant) -> bool {
        self.fix_due && self.next_fix <= now
    }

    pub(super) fn time_requested(&mut self, nonce: u16, now: Instant) {
        if self.times.len() < MOST_WAITING {
            self.times.push((nonce, now));
        }
        self.time_requests = self.time_requests.saturating_add(1);
    }

    /// A distance vector of the robot; they may overtake one another.
    pub(super) fn looked(&mut self, vector: DistanceVector) {
        self.distance_vectors = self.distance_vectors.saturating_add(1);
        self.new_vector = Some(vector.clone());
        if self.distance_vector.as_ref().is_none_or(|last| last.time < vector.time) {
            self.distance_vector = Some(vector);
        }
    }

    /// The robot's window has moved: it has dropped what lies outside.
    pub(super) fn interested(&mut self, interest: Interest) {
        let newer = self.interest.is_none_or(|now| now.number < interest.number);
        if !newer || interest.tiles() > u32::from(self.fused_tiles) {
            return;
        }
        // Of a window in between, of which nothing was heard, the robot has dropped tiles as well.
        let next = self.interest.is_none_or(|now| now.number.wrapping_add(1) == interest.number);
        self.fused.retain(|id| next && interest.contains(id));
        self.coverage.retain(|id| next && interest.contains(id));
        self.interest = Some(interest);
    }

    /// The robot lacks tiles of the server's.
    pub(super) fn requested(&mut self, request: &Request) {
        match request.layer {
            Layer::Robot => {}
            Layer::Fused => self.fused.requested(request),
            Layer::Coverage => self.coverage.requested(request),
        }
    }

    pub(super) fn ask_for(&mut self, id: TileId) {
        // The robot's digests bring up what finds no room.
        if self.requests.len() < MOST_WAITING && !self.requests.contains(&id) {
            self.requests.push(id);
        }
    }

    /// A state of a tile is on disk. The robot is told once in a session.
    pub(super) fn stored(&mut self, id: TileId, stamp: Stamp) {
        if self.stored_last.insert(id, stamp) != Some(stamp) {
            self.stored.push((id, stamp));
        }
    }

    pub(super) fn acknowledged(&mut self, frame: u16) {
        self.fused.acknowledged(frame);
        self.coverage.acknowledged(frame);
    }

    /// The robot's answer to a command about parameters.
    pub(super) fn reported(&mut self, report: ParameterReport) {
        self.asked.take_if(|asked| asked.number == report.number);
        if Aligning::is_own(&report) {
            self.own_report = Some(report);
        } else {
            self.parameters = Some(report);
        }
    }

    /// The next command that may be sent.
    fn next_command(&self) -> Option<usize> {
        let waits =
            |command: &Command| self.asked.is_some() && matches!(command, Command::Parameter(_));
        self.commands.iter().position(|command| !waits(command))
    }

    /// Puts what is due into a frame: what is urgent and stale soon first.
    pub(super) fn fill(
        &mut self,
        scene: &Scene<'_>,
        now: Instant,
        writer: &mut Writer<'_, ToRobot>,
        reliable: bool,
    ) -> Fill<u16> {
        if reliable
            && self.commands.front().is_some_and(Command::is_urgent)
            && self.commands.front().is_some_and(|command| command.write(writer))
        {
            self.commands.pop_front();
            return Fill::Reliable(NO_TILES);
        }
        let before = writer.len();
        if self.fix_due(now)
            && let Some((newest, before)) = self.fixes.split_first()
        {
            self.next_fix = now + FIX_INTERVAL;
            let placed = |&(moment, sighting): &(Instant, Sighting)| (moment, sighting.pose);
            let told = writer.push_longest(0..=before.len(), |count| {
                let (before, certainty) = (&before[..count], least_certain(&self.fixes[..=count]));
                let before = before.iter().map(placed);
                PoseFix::from_fixes(placed(newest), before, certainty, FixSource::Camera)
            });
            self.fix_due = told.is_none();
        }
        self.matched.take_if(|fix| writer.push(fix));
        while let Some(&(nonce, received)) = self.times.first() {
            let held_micros = now.since(received).micros() as u32;
            let reply = TimeReply { nonce, received, held_micros };
            if !writer.push(&reply) {
                break;
            }
            self.times.remove(0);
        }
        let affordable = self.budget.ready_at() <= now;
        if affordable {
            if let Some(interest) = &self.interest {
                self.coverage.fill_confirmation(scene, interest, now, writer);
            }
            let alone = writer.len() == before;
            self.news.fill(scene.surroundings, self.robot, now, writer, alone);
        }
        if writer.len() > before || !reliable {
            return Fill::Datagram;
        }
        if let Some(index) = self.next_command()
            && self.commands[index].write(writer)
        {
            if let Some(Command::Parameter(command)) = self.commands.remove(index) {
                self.asked = Some(command);
            }
            return Fill::Reliable(NO_TILES);
        }
        let stored = writer.push_longest(1..=self.stored.len().min(MAX_STORED), |count| Stored {
            tiles: self.stored[..count].iter().copied().collect(),
        });
        if let Some(count) = stored {
            self.stored.drain(..count);
            return Fill::Reliable(NO_TILES);
        }
        let asked = writer.push_longest(1..=self.requests.len().min(MAX_REQUESTS), |count| {
            let tiles = self.requests[..count].iter().copied().collect();
            Request { layer: Layer::Robot, tiles }
        });
        if let Some(count) = asked {
            self.requests.drain(..count);
            return Fill::Reliable(NO_TILES);
        }
        let Some(interest) = self.interest.filter(|_| affordable) else { return Fill::Nothing };
        let empty = writer.len();
        let frame = if self.frame == u16::MAX { NO_TILES + 1 } else { self.frame + 1 };
        let mut all = true;
        let gathered = self.next_tiles <= now;
        for layer in self.in_turns().into_iter().filter(|_| gathered) {
            all &= layer.fill(scene, &interest, now, frame, writer, empty);
        }
        if writer.len() > empty {
            self.next_tiles = if all { now + TILES_INTERVAL } else { now };
            self.frame = frame;
            return Fill::Reliable(frame);
        }
        for layer in self.in_turns() {
            layer.fill_digests(scene, &interest, now, writer);
        }
        Fill::Datagram
    }

    /// The layers; now the one comes first, now the other.
    fn in_turns(&mut self) -> [&mut Publishing; 2] {
        if self.frame.is_multiple_of(2) {
            [&mut self.fused, &mut self.coverage]
        } else {
            [&mut self.coverage, &mut self.fused]
        }
    }

    /// When there is something to send.
    pub(super) fn poll_timeout(
        &self,
        scene: &Scene<'_>,
        reliable: bool,
        now: Instant,
    ) -> Option<Instant> {
        if !self.times.is_empty() || self.matched.is_some() {
            return Some(now);
        }
        let told =
            self.next_command().is_none() && self.stored.is_empty() && self.requests.is_empty();
        if reliable && !told {
            return Some(now);
        }
        let fix = self.fix_due.then_some(self.next_fix);
        let news = self.news.poll_timeout(scene.surroundings, self.robot);
        let tiles = self.interest.as_ref().and_then(|interest| {
            let confirmation = self.coverage.next_confirmation(scene, interest);
            let layers = [&self.fused, &self.coverage].into_iter().filter(|_| reliable);
            let due = layers.flat_map(|layer| {
                let tile = layer.next_tile(scene, interest);
                tile.map(|due| due.max(self.next_tiles)).into_iter().chain([layer.next_digests()])
            });
            due.chain(confirmation).min()
        });
        let waiting = news.into_iter().chain(tiles).min();
        waiting.map(|due| due.max(self.budget.ready_at())).into_iter().chain(fix).min()
    }

    /// Messages that wait to be sent, tiles aside: of these the newest state alone is sent.
    pub(super) fn waiting(&self) -> usize {
        let fix = usize::from(self.fix_due) + usize::from(self.matched.is_some());
        fix + self.times.len() + self.commands.len() + self.stored.len() + self.requests.len()
    }

    /// Whether the robot has acknowledged the newest state of every fused tile that it wants.
    pub(super) fn is_level(&self, scene: &Scene<'_>) -> bool {
        self.interest.as_ref().is_none_or(|interest| self.fused.is_level(scene, interest))
    }
}

/// What holds for each of some fixes.
fn least_certain(fixes: &[(Instant, Sighting)]) -> Certainty {
    fixes.iter().fold(Certainty::default(), |least, (_, Sighting { certainty, .. })| Certainty {
        x: least.x.max(certainty.x),
        y: least.y.max(certainty.y),
        heading: least.heading.max(certainty.heading),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    use crate::{mapping::ServedLayer, server::surroundings::Surroundings};
    use ubimap_protocol::{
        message::{Digests, Freshness, Messages},
        tile::{Cell, Epoch, Tile},
        units::Pose,
    };

    const ID: TileId = TileId { x: 1, y: 0 };

    fn window(number: u32, west: i16) -> Interest {
        let from = TileId { x: west, y: 0 };
        Interest { number, from, to: TileId { x: west + 1, y: 1 } }
    }

    /// Nothing but a fused layer.
    fn scene(fused: &ServedLayer) -> Scene<'_> {
        let (coverage, surroundings) = Box::leak(Box::default());
        Scene { epoch: Epoch(1), fused, coverage, surroundings }
    }

    /// Sends what is due, and has it acknowledged.
    fn tell(session: &mut Session, fused: &ServedLayer, now: Instant) {
        let mut buffer = [0u8; 200];
        let mut writer = Writer::new(&mut buffer);
        let filled = session.fill(&scene(fused), now, &mut writer, true);
        let Fill::Reliable(frame) = filled else { panic!("{filled:?}") };
        session.acknowledged(frame);
        assert!(session.is_level(&scene(fused)));
    }

    /// A session whose robot has the only fused tile.
    fn level(fused: &ServedLayer) -> Session {
        let mut session = Session::new(RobotId(1), 7, 4, Instant(0));
        session.interested(window(1, 0));
        tell(&mut session, fused, Instant(0));
        session
    }

    #[test]
    fn what_is_long_is_cut_to_a_small_frame() {
        let mut session = Session::new(RobotId(1), 7, 4, Instant(0));
        let far = Sighting::usual(RobotId(1), Pose::from_metres(-900.0, 900.0, 3.0));
        (0..4).for_each(|hour| session.fix(Instant((hour + 1) * 3_600_000_000), far));
        (0..8).for_each(|x| session.ask_for(TileId { x: 30_000 + x, y: -30_000 }));
        let fused = ServedLayer::default();
        let mut frames = 0;
        let now = Instant(0);
        while session.poll_timeout(&scene(&fused), true, now).is_some_and(|due| due <= now) {
            let mut buffer = [0u8; 24];
            let mut writer = Writer::new(&mut buffer);
            let filled = session.fill(&scene(&fused), now, &mut writer, true);
            assert!(!writer.is_empty(), "{filled:?} stands still");
            frames += 1;
        }
        assert_eq!(frames, 1 + 3, "one with a fix, and three tiles in each of the others");
    }

    #[test]
    fn in_small_frames_the_digests_of_all_tiles_take_turns() {
        let mut tile = Tile::UNKNOWN;
        tile.set(3, 3, Cell::Free);
        let mut fused = ServedLayer::default();
        let ids = window(1, 0).ids().inspect(|&id| assert!(fused.set(id, tile)));
        let ids: BTreeSet<TileId> = ids.collect();
        let mut session = Session::new(RobotId(1), 7, 4, Instant(0));
        session.interested(window(1, 0));
        tell(&mut session, &fused, Instant(0));
        let mut told = Vec::new();
        for second in 1..60 {
            let mut buffer = [0u8; 24];
            let mut writer = Writer::new(&mut buffer);
            session.fill(&scene(&fused), Instant(second * 1_000_000), &mut writer, true);
            let len = writer.len();
            for message in Messages::<ToRobot>::new(&buffer[..len]).map(Result::unwrap) {
                let digests = message.decode::<Digests>().unwrap();
                told.extend(digests.tiles.iter().map(|told| told.id));
            }
        }
        assert!(told.iter().take(4).eq(&ids), "{told:?}");
    }

    #[test]
    fn a_tile_that_has_changed_back_is_sent_for_its_version() {
        let mut fused = ServedLayer::default();
        let (mut tile, mut other) = (Tile::UNKNOWN, Tile::UNKNOWN);
        tile.set(3, 3, Cell::Free);
        other.set(3, 3, Cell::Occupied);
        fused.set(ID, tile);
        let mut session = level(&fused);
        fused.set(ID, other);
        fused.set(ID, tile);
        tell(&mut session, &fused, Instant(0) + FUSED_HOLD);
    }

    #[test]
    fn what_a_window_that_was_never_heard_of_left_out_is_sent_again() {
        let mut tile = Tile::UNKNOWN;
        tile.set(3, 3, Cell::Free);
        let mut fused = ServedLayer::default();
        fused.set(ID, tile);
        let mut session = level(&fused);
        session.interested(window(2, 1));
        assert!(session.is_level(&scene(&fused)), "it has kept the tile");
        // The third window may have been elsewhere.
        session.interested(window(4, 0));
        assert!(!session.is_level(&scene(&fused)));
        assert!(session.poll_timeout(&scene(&fused), true, Instant(0)).is_some());
    }

    #[test]
    fn what_is_said_of_several_fixes_holds_for_the_least_certain() {
        let of = |x, y, heading| {
            let certainty = Certainty { x, y, heading };
            let robot = Sighting::usual(RobotId(1), Pose::default());
            (Instant::default(), Sighting { certainty, ..robot })
        };
        let (first, second) = (of(5, 30, 7), of(9, 4, 8));
        assert_eq!(least_certain(&[first, second]), Certainty { x: 9, y: 30, heading: 8 });
        assert_eq!(least_certain(&[first]), first.1.certainty);
    }

    #[test]
    fn many_cameras_make_no_more_messages() {
        let mut session = Session::new(RobotId(1), 7, 4, Instant(0));
        let fused = ServedLayer::default();
        let mut sent = Vec::new();
        for step in 0..200u64 {
            let now = Instant(step * 5_000);
            // Four cameras, each at 12.5 Hz.
            if step % 4 == 0 {
                session.fix(now, Sighting::usual(RobotId(1), Pose::default()));
            }
            let mut buffer = [0u8; 200];
            let mut writer = Writer::new(&mut buffer);
            session.fill(&scene(&fused), now, &mut writer, true);
            let len = writer.len();
            for message in Messages::<ToRobot>::new(&buffer[..len]) {
                let fix = message.unwrap().decode::<PoseFix>().unwrap();
                sent.push(fix.fixes().map(|(moment, _)| moment).collect::<Vec<_>>());
            }
        }
        assert!(sent.len() <= 17, "{}", sent.len());
        let told: BTreeSet<Instant> = sent.into_iter().flatten().collect();
        assert_eq!(told.len(), 49, "all of fifty but the newest");
    }

    #[test]
    fn coverage_is_confirmed_while_the_robot_holds_it() {
        let mut tile = Tile::UNKNOWN;
        tile.set(3, 3, Cell::Free);
        let (fused, mut coverage) = (ServedLayer::default(), ServedLayer::default());
        coverage.set(ID, tile);
        let surroundings = Surroundings::default();
        let mut session = Session::new(RobotId(1), 7, 4, Instant(0));
        session.interested(window(1, 0));
        // The tiles that are confirmed until then, and by when; frames with tiles get lost if so.
        let mut confirmed = |coverage: &ServedLayer, until: u64, lost: bool| {
            let scene =
                Scene { epoch: Epoch(1), fused: &fused, coverage, surroundings: &surroundings };
            let until = Instant(until * 1_000);
            let mut newest = None;
            while let Some(due) =
                session.poll_timeout(&scene, true, until).filter(|it| *it <= until)
            {
                let mut buffer = [0u8; 200];
                let mut writer = Writer::new(&mut buffer);
                let filled = session.fill(&scene, due, &mut writer, true);
                let len = writer.len();
                if let (Fill::Reliable(frame), false) = (filled, lost) {
                    session.acknowledged(frame);
                }
                for message in Messages::<ToRobot>::new(&buffer[..len]).map(Result::unwrap) {
                    if let Ok(freshness) = message.decode::<Freshness>() {
                        assert_eq!((freshness.interest, freshness.first), (1, 0));
                        assert_eq!(&freshness.tiles[..], [0b10], "the second tile of the window");
                        newest = Some(freshness.time.0 / 1_000);
                    }
                }
            }
            newest
        };
        assert_eq!(confirmed(&coverage, 3_000, false), Some(2_500));
        tile.set(4, 3, Cell::Free);
        coverage.set(ID, tile);
        // What it holds was the newest until now.
        assert_eq!(confirmed(&coverage, 6_000, true), Some(3_000));
    }
}

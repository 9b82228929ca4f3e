//! The runner as a robot of a server.

use ubimap_protocol::{
    frame::{DEFAULT_FRAME, MIN_VERSION, VERSION},
    message::{
        Hello, Interest, Message, Refusal, RefusalReason, Request, State, TileUpdateHead, ToRobot,
        ToServer, Welcome,
    },
    tile::{Cell, Epoch, Layer, Stamp, TILE_SIDE, Tile, TileId, Version},
    time::Duration,
};

use super::{
    frames::{Note, tile_note},
    halt::{Halt, fail},
    talk::{Seen, Talk},
};

/// The step from one attempt's nonce to the next.
const NONCE_STEP: u32 = 0x9E37_79B9;
/// The tiles of questions lie from here on eastwards.
const QUESTIONS_FROM: i16 = 8_000;
/// Pause before another Hello.
const OLDER: Duration = Duration::from_millis(20);
/// Number of tiles that the runner can hold.
pub(super) const FUSED_TILES: u16 = 64;

/// A tile that is free up to a column, then has a wall of two cells.
pub(super) fn room(column: usize) -> Tile {
    let mut tile = Tile::UNKNOWN;
    for y in 0..TILE_SIDE {
        for x in 0..column {
            tile.set(x, y, Cell::Free);
        }
        tile.set(column, y, Cell::Occupied);
        tile.set(column + 1, y, Cell::Occupied);
    }
    tile
}

/// A tile whose cells follow no pattern, which takes several frames.
pub(super) fn noise(seed: u32) -> Tile {
    let mut tile = Tile::UNKNOWN;
    let mut state = seed | 1;
    for y in 0..TILE_SIDE {
        for x in 0..TILE_SIDE {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            tile.set(x, y, if state >> 31 == 0 { Cell::Free } else { Cell::Occupied });
        }
    }
    tile
}

/// A server's answer to a Hello.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Said {
    Welcome(Welcome),
    Refusal(RefusalReason),
    Nothing,
}

impl Talk<'_> {
    /// A Hello of another attempt.
    pub(super) fn next_hello(&mut self) -> Hello {
        self.robot.nonce = self.robot.nonce.wrapping_add(NONCE_STEP);
        Hello {
            version: VERSION,
            min_version: MIN_VERSION,
            robot: self.robot.robot,
            nonce: self.robot.nonce,
            frame: DEFAULT_FRAME as u16,
            resolution: self.robot.resolution,
            fused_tiles: FUSED_TILES,
        }
    }

    /// A Hello of another boot.
    pub(super) fn reboot(&mut self) {
        self.robot.nonce = self.robot.nonce.wrapping_mul(0x0101_0101).wrapping_add(0x2468_ACE1);
    }

    /// Says hello, and returns the Welcome.
    pub(super) fn must_welcome(&mut self, hello: &Hello) -> Result<Welcome, Halt> {
        match self.said_to(hello)? {
            Said::Welcome(welcome) => Ok(welcome),
            Said::Refusal(RefusalReason::Resolution(side)) if side != self.robot.resolution => {
                // The first contact: from here on the runner's map has the server's cells.
                self.robot.resolution = side;
                self.must_welcome(&Hello { resolution: side, ..*hello })
            }
            Said::Refusal(reason) => fail("4.3: a Welcome", format!("a Refusal: {reason}")),
            Said::Nothing => fail("4.3: a Welcome with the nonce of the Hello", "none"),
        }
    }

    /// Says hello, and returns the answer with its nonce.
    pub(super) fn said_to(&mut self, hello: &Hello) -> Result<Said, Halt> {
        self.older()?;
        self.handshake(Note::new::<ToServer, _>(hello))?;
        self.said(hello.nonce)
    }

    /// Says nothing for a moment: a session's last frame must be older than an offer that may end it.
    fn older(&mut self) -> Result<(), Halt> {
        let was_polite = std::mem::replace(&mut self.is_polite, false);
        let waited = self.wait(OLDER);
        self.is_polite = was_polite;
        waited
    }

    /// The answer to the Hello with a nonce.
    pub(super) fn said(&mut self, nonce: u32) -> Result<Said, Halt> {
        // A frame of the session after the offer would keep the session.
        let was_polite = std::mem::replace(&mut self.is_polite, false);
        let said = self.await_said(nonce);
        self.is_polite = was_polite;
        said
    }

    fn await_said(&mut self, nonce: u32) -> Result<Said, Halt> {
        let until = self.now() + self.patience();
        while let Some(seen) = self.next(until)? {
            let welcome = seen.bodies::<ToRobot, Welcome>().find(|it| it.nonce == nonce);
            let refusal = seen.bodies::<ToRobot, Refusal>().find(|it| it.nonce == nonce);
            match (welcome, refusal) {
                (Some(welcome), _) => return Ok(Said::Welcome(welcome)),
                (_, Some(refusal)) => return Ok(Said::Refusal(refusal.reason)),
                _ => {}
            }
        }
        Ok(Said::Nothing)
    }

    /// Opens a session with the server by a Hello that `change` may alter, and makes it the session of
    /// the port by a first frame.
    pub(super) fn join_server(&mut self, change: impl FnOnce(&mut Hello)) -> Result<(), Halt> {
        let mut hello = self.next_hello();
        change(&mut hello);
        let welcome = self.must_welcome(&hello)?;
        self.enter(&welcome)
    }

    /// Begins the session of a Welcome, by a first frame.
    pub(super) fn enter(&mut self, welcome: &Welcome) -> Result<(), Halt> {
        self.begin(welcome.session);
        let before = self.robot.welcome.replace(*welcome);
        if before.is_some_and(|before| before.server_epoch != welcome.server_epoch) {
            self.robot.followed.clear();
        }
        self.state()
    }

    /// Sends a state.
    pub(super) fn state(&mut self) -> Result<(), Halt> {
        let state = State { time: None, pose: None, odometry: None, cells_refused: 0 };
        self.datagram(&[Note::new::<ToServer, _>(&state)])
    }

    /// The epoch of the tiles that the runner draws in this session.
    pub(super) fn epoch(&self) -> Epoch {
        Epoch(self.robot.welcome.map_or(1, |welcome| welcome.first_epoch))
    }

    /// The server's epoch.
    pub(super) fn server_epoch(&self) -> Epoch {
        Epoch(self.robot.welcome.map_or(0, |welcome| welcome.server_epoch))
    }

    /// The tile of a question.
    pub(super) fn question_tile(&self) -> TileId {
        TileId { x: QUESTIONS_FROM + (self.asked % 16_000) as i16, y: -7 }
    }

    /// A question to a server.
    pub(super) fn base_question(&self) -> Note {
        let stamp = Stamp { epoch: self.epoch(), version: Version(5) };
        let was = room(4);
        let tile = (self.question_tile(), stamp, Some(Version(4)));
        tile_note::<ToServer>(Layer::Robot, tile, &was, &room(5))
    }

    /// The questions whose tiles a frame requests.
    pub(super) fn requested(&self, seen: &Seen) -> Vec<u16> {
        let requests = seen.bodies::<ToRobot, Request>().filter(|it| it.layer == Layer::Robot);
        let tiles = requests.flat_map(|request| request.tiles.into_iter().collect::<Vec<_>>());
        let numbers =
            tiles.filter(|id| id.y == -7).map(|id| id.x.wrapping_sub(QUESTIONS_FROM) as u16);
        numbers.collect()
    }

    /// The next version of a tile in this session's epoch, whole.
    pub(super) fn drawing(&mut self, id: TileId, tile: &Tile) -> Note {
        let epoch = self.epoch();
        let version = self.robot.versions.entry((id, epoch.0)).or_default();
        *version += 1;
        let stamp = Stamp { epoch, version: Version(*version) };
        tile_note::<ToServer>(Layer::Robot, (id, stamp, None), &Tile::UNKNOWN, tile)
    }

    /// Draws a tile; fails if the frame is not acknowledged.
    pub(super) fn draw(&mut self, id: TileId, tile: &Tile) -> Result<(), Halt> {
        let note = self.drawing(id, tile);
        self.deliver(&[note])
    }

    /// Asks for the tiles of a window.
    pub(super) fn interest(&mut self, from: TileId, to: TileId) -> Result<(), Halt> {
        let note = self.interest_note(from, to);
        self.deliver(&[note])
    }

    /// The next Interest.
    pub(super) fn interest_note(&mut self, from: TileId, to: TileId) -> Note {
        self.robot.interests += 1;
        Note::new::<ToServer, _>(&Interest { number: self.robot.interests, from, to })
    }

    /// Follows what the server publishes.
    pub(super) fn follow_server(&mut self, seen: &Seen) {
        let Some(carrier) = seen.carrier() else { return };
        for note in &seen.notes {
            let message = Message::<ToRobot>::new(note.number, &note.body);
            if let Ok(update) = message.split::<TileUpdateHead>() {
                self.robot.followed.take(update, &carrier);
            }
        }
    }

    /// Waits until the server has published a fused tile completely; `false` if it does not within a
    /// time.
    pub(super) fn is_published(&mut self, id: TileId, span: Duration) -> Result<bool, Halt> {
        let end = self.now() + span;
        let epoch = self.server_epoch();
        loop {
            let held = self.robot.followed.held(Layer::Fused, id, epoch);
            if held.is_some_and(|held| !held.is_partial() && held.stamp().version.0 > 0) {
                return Ok(true);
            }
            if self.now() >= end {
                return Ok(false);
            }
            self.wait(Duration::from_millis(100))?;
        }
    }
}

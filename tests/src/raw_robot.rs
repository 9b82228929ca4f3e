//! A robot under a test's control, connected directly to a server.

use std::collections::BTreeMap;

use ubimap_protocol::{
    frame::{DEFAULT_FRAME, MAX_FRAME, MIN_VERSION, VERSION},
    link::{Endpoint, Fill, Received},
    message::{Body, Hello, TileUpdateHead, ToServer, Welcome, Writer},
    tile::{Epoch, Layer, Stamp, Tile, TileEncoder, TileId, Version},
    time::Instant,
    units::{Millimetres, RobotId},
};
use ubimap_sim_host::server::Server;

/// A robot's end of the link that sends no acknowledgements and retransmits nothing.
#[derive(Debug)]
pub struct RawRobot {
    /// The robot's id.
    pub id: RobotId,
    port: usize,
    link: Endpoint<ToServer, (), 1, MAX_FRAME>,
    versions: BTreeMap<TileId, u32>,
}

impl RawRobot {
    /// Opens a session at a port.
    ///
    /// # Panics
    /// If the server does not send a Welcome.
    pub fn connect(server: &mut Server, port: usize, id: RobotId, now: Instant) -> Self {
        Self::try_connect(server, port, id, now).expect("a welcome")
    }

    /// Opens a session at a port; `None` if the server refuses it.
    ///
    /// # Panics
    /// If the port is not open.
    pub fn try_connect(
        server: &mut Server,
        port: usize,
        id: RobotId,
        now: Instant,
    ) -> Option<Self> {
        let mut link = Endpoint::new();
        let mut out = [0; MAX_FRAME];
        server.receive(port, &Self::hello(id, 7), now).expect("the port is open");
        let session = loop {
            let len = server.poll_transmit(port, now, &mut out)?;
            // Frames of the previous session on this port may come first.
            if let Some(Received::Handshake(message)) = link.receive(&mut &out[..len], now) {
                break message.decode::<Welcome>().ok()?.session;
            }
        };
        link.begin(session, DEFAULT_FRAME);
        Some(Self { id, port, link, versions: BTreeMap::new() })
    }

    /// The frame of a Hello.
    ///
    /// # Panics
    /// Never: a Hello fits a frame.
    pub fn hello(id: RobotId, nonce: u32) -> Vec<u8> {
        let hello = Hello {
            version: VERSION,
            min_version: MIN_VERSION,
            robot: id,
            nonce,
            frame: DEFAULT_FRAME as u16,
            resolution: Millimetres(50),
            fused_tiles: 64,
        };
        let mut out = [0; MAX_FRAME];
        let len = Endpoint::<ToServer, (), 1, MAX_FRAME>::new().handshake(&hello, &mut out);
        out[..len.expect("a hello fits")].to_vec()
    }

    /// The next frame, filled by `fill`.
    ///
    /// # Panics
    /// If the contents do not fit.
    pub fn frame(
        &mut self,
        now: Instant,
        fill: impl FnOnce(&mut Writer<'_, ToServer>) -> bool,
    ) -> Vec<u8> {
        let mut out = [0; MAX_FRAME];
        let sent = self.link.poll_transmit(now, &mut out, true, |writer, _| {
            assert!(fill(writer), "the contents do not fit");
            Fill::Datagram
        });
        out[..sent.expect("a frame").len].to_vec()
    }

    /// Reads all frames that are due on its port. Returns the kinds of the session's messages.
    ///
    /// # Panics
    /// If a frame is bad.
    pub fn hear(&mut self, server: &mut Server, now: Instant) -> Vec<u8> {
        self.hear_messages(server, now).into_iter().map(|(kind, _)| kind).collect()
    }

    /// Reads all frames that are due on its port. Returns kind and body of the session's messages.
    ///
    /// # Panics
    /// If a frame is bad.
    pub fn hear_messages(&mut self, server: &mut Server, now: Instant) -> Vec<(u8, Vec<u8>)> {
        let mut out = [0; MAX_FRAME];
        let mut heard = Vec::new();
        while let Some(len) = server.poll_transmit(self.port, now, &mut out) {
            match self.link.receive(&mut &out[..len], now) {
                Some(Received::Session(messages)) => {
                    let messages = messages.filter_map(Result::ok);
                    heard.extend(messages.map(|message| (message.number, message.body.to_vec())));
                }
                Some(Received::Handshake(_)) => {}
                other => panic!("{other:?}"),
            }
        }
        heard
    }

    /// Sends a message.
    pub fn say(&mut self, server: &mut Server, now: Instant, message: &impl Body<ToServer>) {
        let frame = self.frame(now, |writer| writer.push(message));
        server.receive(self.port, &frame, now).expect("the port is open");
    }

    /// A frame with a complete tile, drawn at the given second of the server's clock.
    pub fn drawn(&mut self, now: Instant, seconds: u32, id: TileId, tile: &Tile) -> Vec<u8> {
        let version = self.versions.entry(id).or_default();
        *version += 1;
        let stamp = Stamp { epoch: Epoch(1), version: Version(*version) };
        self.frame(now, |writer| {
            writer.push_with(&TileUpdateHead { layer: Layer::Robot, seconds }, |coded| {
                let mut encoder = TileEncoder::new(coded);
                encoder.push(id, stamp, None, 0, &Tile::UNKNOWN, tile)?;
                encoder.finish()
            })
        })
    }

    /// Sends a tile drawn now.
    pub fn draw(&mut self, server: &mut Server, now: Instant, id: TileId, tile: &Tile) {
        let frame = self.drawn(now, (now.micros() / 1_000_000) as u32, id, tile);
        server.receive(self.port, &frame, now).expect("the port is open");
    }
}

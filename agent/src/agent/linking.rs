//! The link with the server: what comes in, the handshake that begins a session, what goes out.

use ubimap_protocol::{
    frame::{DEFAULT_FRAME, MIN_VERSION, SessionId, VERSION},
    link::{ClockSync, Fill, Received},
    message::{
        Event, EventCode, Hello, ParameterAction, ParameterCommand, Refusal, State, Welcome,
    },
    tile::Epoch,
    time::Instant,
};

use super::{
    Agent, Token,
    inbox::{Inbox, Knock},
    point_beams,
};
use crate::{
    config::Config,
    parameters::{carry_out, push_report},
    timing::{HURRY, RESET_SILENCE, STATE_INTERVAL},
};

impl Agent<'_> {
    /// Takes bytes from the server, in pieces of any size.
    pub fn receive(&mut self, mut bytes: &[u8], now: Instant) {
        while self.receive_frame(&mut bytes, now) {
            self.settle(now);
        }
        self.map_waiting(now);
    }

    /// Takes the next frame of some bytes; `false` if they are used up before its end.
    #[inline(never)]
    fn receive_frame(&mut self, bytes: &mut &[u8], now: Instant) -> bool {
        let Some(received) = self.link.receive(bytes, now) else { return false };
        match received {
            Received::Bad => {}
            Received::Handshake(message) => {
                // Copied: what follows changes the link that the body is borrowed from.
                match Knock::parse(message) {
                    Some(Knock::Welcome(welcome)) => self.welcomed(&welcome, now),
                    Some(Knock::Refusal(refusal)) => self.refused(&refusal, now),
                    Some(Knock::Reset) => self.reset(now),
                    None => {
                        self.statistics.malformed_messages =
                            self.statistics.malformed_messages.wrapping_add(1);
                    }
                }
            }
            Received::Session(messages) => {
                self.heard = now;
                let mut command = None;
                Inbox {
                    clock: &mut self.clock,
                    locator: &mut self.locator,
                    latest_pose: &mut self.latest_pose,
                    fused: &mut self.fused,
                    commands: &mut self.commands,
                    command: &mut command,
                    map: &mut self.map,
                    publisher: &mut self.publisher,
                    events: &mut self.events,
                    statistics: &mut self.statistics,
                }
                .take(messages, now);
                if let Some(command) = command {
                    self.configure(&command);
                }
            }
        }
        true
    }

    fn welcomed(&mut self, welcome: &Welcome, now: Instant) {
        let stale = welcome.nonce != self.knocking.nonce() || self.is_connected();
        if stale || !(MIN_VERSION..=VERSION).contains(&welcome.version) {
            return;
        }
        self.refusal = None;
        self.heard = now;
        self.statistics.sessions = self.statistics.sessions.wrapping_add(1);
        let same_server =
            self.server_epoch.replace(welcome.server_epoch) == Some(welcome.server_epoch);
        self.link.begin(welcome.session, usize::from(welcome.frame));
        if !same_server {
            // Another life of the server has another clock: moments of the last one mean nothing.
            self.clock = ClockSync::default();
            self.commands.forget();
            self.latest_pose = None;
        }
        self.map.pool.begin_session(welcome.stores, same_server);
        self.map.pool.start_epochs_at(Epoch(welcome.first_epoch));
        self.publisher.begin_session(&mut self.map.pool, same_server, now);
        self.events.begin_session();
        if self.statistics.sessions == 1 {
            self.events.raise(EventCode::Started, now);
        }
        self.fused.begin_session(Epoch(welcome.server_epoch));
        self.vectors.begin_session();
        self.next_state = now;
    }

    fn refused(&mut self, refusal: &Refusal, now: Instant) {
        if refusal.nonce == self.knocking.nonce() && !self.is_connected() {
            self.refusal = Some(refusal.reason);
            self.knocking.refused(now);
        }
    }

    /// The server knows no session here. One who merely says so, while the session lives, is not
    /// believed.
    fn reset(&mut self, now: Instant) {
        if self.is_connected() && now.since(self.heard) > RESET_SILENCE {
            self.link.end();
            self.knocking.restart(now);
        }
    }

    /// Carries out a command about parameters.
    fn configure(&mut self, command: &ParameterCommand) {
        let Config { first_epoch, .. } = self.config;
        self.answer = Some(carry_out(command, &mut self.config));
        self.publisher.set_hold(self.config.hold);
        if let ParameterAction::Set(_) = command.action {
            // Whatever it was: commands are rare, and the table is soon filled.
            point_beams(self.beams, &self.config);
            self.map.configure((&self.config).into(), self.beams);
        }
        if self.config.first_epoch != first_epoch {
            self.map.pool.begin_anew(self.config.first_epoch);
            self.selection.begin_anew();
        }
    }

    /// Takes note of acknowledged frames.
    fn settle(&mut self, now: Instant) {
        while let Some(token) = self.link.poll_acknowledged() {
            match token {
                Token::Tiles(frame) => {
                    self.publisher.acknowledged(&mut self.map.pool, &self.fused, frame, now);
                }
                Token::Event(code) => self.events.acknowledged(code),
                Token::Other => {}
            }
        }
    }

    /// Tells the server that something has happened; and where, and at once what the robot has seen
    /// by then, for somebody may have to decide what it is to do next.
    pub fn raise(&mut self, code: EventCode, now: Instant) {
        self.next_state = now;
        self.publisher.hurry(now + HURRY);
        self.events.raise(code, now);
    }

    /// Writes the next frame that is due into `out`, which should have 250 bytes. Returns its
    /// length. Call it until it returns `None`.
    #[must_use]
    #[inline(never)]
    pub fn poll_transmit(&mut self, now: Instant, out: &mut [u8]) -> Option<usize> {
        if self.link.session() == SessionId::NONE {
            return self.knock(now, out);
        }
        let server_moment = self.latest_pose.map(|(moment, _)| moment);
        let pose = self.latest_pose.map(|(_, pose)| pose);
        let odometry = self.locator.newest_odometry();
        let cells_refused = self.statistics.cells_refused;
        let Self {
            config,
            link,
            clock,
            fused,
            map,
            publisher,
            next_state,
            events,
            answer,
            vectors,
            ..
        } = self;
        let sent = link.poll_transmit(now, out, false, |writer, reliable| {
            // What must not be sent again, for it would be stale then, goes apart.
            let before = writer.len();
            if let Some(request) = clock.poll_request(now) {
                // What finds no room is asked again.
                let _ = writer.push(&request);
            }
            if *next_state <= now {
                *next_state = now + STATE_INTERVAL;
                // The smallest frames have no room for both poses.
                let _ = writer.push_longest(0..=2, |poses| State {
                    time: server_moment,
                    pose: pose.filter(|_| poses > 0),
                    odometry: odometry.filter(|_| poses > 1),
                    cells_refused,
                });
            }
            vectors.push(writer);
            let alone = writer.len() == before;
            publisher.push_digests(&map.pool, writer, alone, now);
            if writer.len() > before || !reliable {
                return Fill::Datagram;
            }
            let to_server = |moment| clock.to_server(moment);
            let push_event = |event: &Event| writer.push(event);
            if let Some(code) = events.send(to_server, push_event) {
                return Fill::Reliable(Token::Event(code));
            }
            if push_report(answer, config, writer) {
                return Fill::Reliable(Token::Other);
            }
            if let Some(interest) = fused.untold()
                && writer.push(&interest)
            {
                // Told as far as the window is concerned: the link sees to the rest.
                fused.told(interest.number);
                return Fill::Reliable(Token::Other);
            }
            if fused.push_request(writer) {
                return Fill::Reliable(Token::Other);
            }
            if let Some(frame) = publisher.fill(&mut map.pool, fused, writer, now) {
                return Fill::Reliable(Token::Tiles(frame));
            }
            Fill::Nothing
        })?;
        let bytes = sent.len as u64;
        self.statistics.bytes_sent = self.statistics.bytes_sent.wrapping_add(bytes);
        if matches!(sent.token, Some(Token::Tiles(_))) {
            self.statistics.bytes_sent_map = self.statistics.bytes_sent_map.wrapping_add(bytes);
        }
        Some(sent.len)
    }

    fn knock(&mut self, now: Instant, out: &mut [u8]) -> Option<usize> {
        if !self.knocking.poll(now) {
            return None;
        }
        let hello = Hello {
            version: VERSION,
            min_version: MIN_VERSION,
            robot: self.config.robot,
            nonce: self.knocking.nonce(),
            frame: DEFAULT_FRAME as u16,
            resolution: self.config.resolution,
            fused_tiles: self.fused.capacity().min(usize::from(u16::MAX)) as u16,
        };
        let len = self.link.handshake(&hello, out)?;
        self.statistics.bytes_sent = self.statistics.bytes_sent.wrapping_add(len as u64);
        Some(len)
    }
}

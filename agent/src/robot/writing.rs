//! The contents of the next frame, in order of priority.

use ubimap_protocol::{
    link::Fill,
    message::{Event, State, ToServer, Writer},
    time::Instant,
};

use super::{
    mapper::Mapper,
    outbox::{Outbox, Token},
    parameters::push_report,
};
use crate::timing::STATE_INTERVAL;

impl Mapper<'_> {
    /// When the next frame of a session is due. Tile updates count only if `can_send_reliable`.
    pub(super) fn poll_transmit_timeout(&self, can_send_reliable: bool) -> Instant {
        let Outbox { publisher, next_state, .. } = &self.outbox;
        let due = self.clock.poll_timeout().min(publisher.digest_timeout()).min(*next_state);
        let tiles = publisher.poll_timeout().filter(|_| can_send_reliable);
        tiles.map_or(due, |tiles| tiles.min(due))
    }

    /// Processes the acknowledgement of a frame.
    pub(super) fn acknowledged(&mut self, token: Token, now: Instant) {
        let Outbox { publisher, events, .. } = &mut self.outbox;
        match token {
            Token::Tiles(frame) => {
                publisher.acknowledged(&mut self.map.pool, &self.fused, frame, now);
            }
            Token::Event(code) => events.acknowledged(code),
            Token::Other => {}
        }
    }

    /// Writes the messages of one frame, if any are due. Messages that would be stale when
    /// retransmitted are sent in datagrams, separately from those that must arrive. `reliable` says
    /// whether a reliable frame can be sent now. Returns the kind of frame.
    pub(super) fn write(
        &mut self,
        writer: &mut Writer<'_, ToServer>,
        reliable: bool,
        now: Instant,
    ) -> Fill<Token> {
        let before = writer.len();
        self.write_perishable(writer, now);
        let alone = writer.len() == before;
        self.outbox.publisher.push_digests(&self.map.pool, writer, alone, now);
        if writer.len() > before || !reliable {
            return Fill::Datagram;
        }
        self.write_reliable(writer, now).map_or(Fill::Nothing, Fill::Reliable)
    }

    fn write_perishable(&mut self, writer: &mut Writer<'_, ToServer>, now: Instant) {
        if let Some(request) = self.clock.poll_request(now) {
            // If there is no room, a new request is made later.
            let _ = writer.push(&request);
        }
        if self.outbox.next_state <= now {
            self.outbox.next_state = now + STATE_INTERVAL;
            // The smallest frames have no room for both poses, so one or both may be left out.
            let _ = writer.push_longest(0..=2, |poses| State {
                time: self.latest_pose.and_then(|(moment, _)| self.clock.to_server(moment)),
                pose: self.latest_pose.map(|(_, pose)| pose).filter(|_| poses > 0),
                odometry: self.locator.newest_odometry().filter(|_| poses > 1),
                cells_refused: self.statistics.cells_refused,
            });
        }
        self.outbox.vectors.push(writer);
    }

    fn write_reliable(&mut self, writer: &mut Writer<'_, ToServer>, now: Instant) -> Option<Token> {
        let Self { settings, clock, fused, map, outbox, .. } = self;
        let Outbox { publisher, events, answer, .. } = outbox;
        let to_server = |moment| clock.to_server(moment);
        let push_event = |event: &Event| writer.push(event);
        if let Some(code) = events.send(to_server, push_event) {
            return Some(Token::Event(code));
        }
        if push_report(answer, settings, writer) {
            return Some(Token::Other);
        }
        if let Some(interest) = fused.untold()
            && writer.push(&interest)
        {
            // From here on the link is responsible: it retransmits the message until it arrives.
            fused.told(interest.number);
            return Some(Token::Other);
        }
        if fused.push_request(writer) {
            return Some(Token::Other);
        }
        publisher.fill(&mut map.pool, fused, writer, now).map(Token::Tiles)
    }
}

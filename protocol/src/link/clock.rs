//! The server's time on a robot, from requests and replies with four time stamps.
//!
//! A request takes `received - sent` by the two clocks, and its reply `arrived - replied`. Queueing
//! can only increase these, so the recent minimum of each is the best estimate. The clock offset is
//! half the difference of the two minima.

use super::timing::{FIRST_TIME_INTERVAL, TIME_INTERVAL, TIME_REPLY_LOST};
use crate::{
    message::{TimeReply, TimeRequest},
    time::{Duration, Instant},
};

/// Number of exchanges in one generation. Each generation keeps its minima, and the last
/// `GENERATIONS` generations are used.
const PER_GENERATION: u8 = 8;
const GENERATIONS: usize = 8;
/// Clock drift: a minimum grows by 1/2^16 (15 ppm) of its age.
const DRIFT_SHIFT: u32 = 16;
/// Number of exchanges until the minima are good; until then, requests are sent more often.
const FIRST_EXCHANGES: u8 = 64;

/// The minimum times of requests and of replies over some exchanges, in microseconds. Each is the
/// difference between readings of the two clocks, and so includes their offset.
#[derive(Clone, Copy, Debug)]
struct Fastest {
    there: i64,
    back: i64,
}

impl Fastest {
    const NONE: Self = Self { there: i64::MAX, back: i64::MAX };

    fn aged(self, by: Duration) -> Self {
        let drift = (by.micros() >> DRIFT_SHIFT) as i64;
        Self { there: self.there.saturating_add(drift), back: self.back.saturating_add(drift) }
    }

    fn min(self, other: Self) -> Self {
        Self { there: self.there.min(other.there), back: self.back.min(other.back) }
    }
}

/// The robot's side of the exchange.
#[derive(Debug)]
pub struct ClockSync {
    generations: [Fastest; GENERATIONS],
    in_generation: u8,
    generation_began: Instant,
    exchanges: u8,
    pending: Option<(u16, Instant)>,
    next_nonce: u16,
    next_request: Instant,
    /// The latest server time that was returned, so that time never steps back.
    latest: u64,
}

impl Default for ClockSync {
    fn default() -> Self {
        Self {
            generations: [Fastest::NONE; GENERATIONS],
            in_generation: 0,
            generation_began: Instant(0),
            exchanges: 0,
            pending: None,
            next_nonce: 0,
            next_request: Instant(0),
            latest: 0,
        }
    }
}

impl ClockSync {
    /// The request to send now, if one is due. Its time stamp is `now`.
    #[must_use]
    pub fn poll_request(&mut self, now: Instant) -> Option<TimeRequest> {
        if now < self.next_request {
            return None;
        }
        let nonce = self.next_nonce;
        self.next_nonce = self.next_nonce.wrapping_add(1);
        self.pending = Some((nonce, now));
        let is_first = self.exchanges < FIRST_EXCHANGES;
        self.next_request = now + if is_first { FIRST_TIME_INTERVAL } else { TIME_INTERVAL };
        Some(TimeRequest { nonce })
    }

    /// When the next request is due.
    pub fn poll_timeout(&self) -> Instant {
        self.next_request
    }

    /// Processes a reply that arrived at `now`. It is ignored if it took more than two seconds, or
    /// does not answer the latest request.
    pub fn reply(&mut self, reply: &TimeReply, now: Instant) {
        let Some((_, sent)) = self.pending.take_if(|(nonce, _)| *nonce == reply.nonce) else {
            return;
        };
        if now.since(sent) > TIME_REPLY_LOST {
            return;
        }
        let replied = reply.received.0.saturating_add(u64::from(reply.held_micros));
        let sample = Fastest {
            there: reply.received.0.wrapping_sub(sent.0) as i64,
            back: now.0.wrapping_sub(replied) as i64,
        };
        if self.exchanges == 0 {
            self.generation_began = now;
        }
        if self.in_generation >= PER_GENERATION {
            self.in_generation = 0;
            let age = now.since(core::mem::replace(&mut self.generation_began, now));
            // Shift each generation by one place; the oldest drops out.
            let mut newer = Fastest::NONE;
            let shift = |minima: Fastest| core::mem::replace(&mut newer, minima.aged(age));
            self.generations = self.generations.map(shift);
        }
        self.in_generation += 1;
        self.exchanges = self.exchanges.saturating_add(1);
        if let Some(newest) = self.generations.first_mut() {
            *newest = newest.min(sample);
        }
    }

    /// The server's clock minus the robot's, in microseconds; `None` before the first reply.
    fn offset(&self) -> Option<i64> {
        let fastest = self.generations.iter().fold(Fastest::NONE, |all, &one| all.min(one));
        (self.exchanges > 0).then(|| {
            let round_trip = fastest.there.wrapping_add(fastest.back);
            fastest.there.wrapping_sub(round_trip / 2)
        })
    }

    /// Converts a time of the robot's clock to the server's. `None` before the first reply, or if
    /// the server's clock had not started at that time.
    pub fn to_server(&self, local: Instant) -> Option<Instant> {
        local.0.checked_add_signed(self.offset()?).map(Instant)
    }

    /// Converts a time of the server's clock to the robot's. `None` before the first reply, or if
    /// the robot's clock had not started at that time.
    pub fn to_local(&self, server: Instant) -> Option<Instant> {
        server.0.checked_add_signed(self.offset()?.checked_neg()?).map(Instant)
    }

    /// The server's time now, or `None` before the first reply. Never decreases.
    pub fn server_now(&mut self, now: Instant) -> Option<Instant> {
        self.latest = self.latest.max(self.to_server(now)?.0);
        Some(Instant(self.latest))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A random delay of 0 to 20 ms (SplitMix64).
    fn delay(seed: &mut u64) -> u64 {
        *seed = seed.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mixed = (*seed ^ *seed >> 30).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let mixed = (mixed ^ mixed >> 27).wrapping_mul(0x94D0_49BB_1331_11EB);
        (mixed ^ mixed >> 31) % 20_001
    }

    /// The error in microseconds after a number of exchanges with delays of 0 to 20 ms each way;
    /// the server's clock gains `ppm` on the robot's.
    fn error_after(exchanges: u32, seed: u64, ppm: u64) -> i64 {
        let (mut seed, ahead) = (seed, 1_000_000_000u64.wrapping_mul(seed + 1));
        let server = |local: u64| local + ahead + local * ppm / 1_000_000;
        let mut clock = ClockSync::default();
        let mut local = 0;
        for _ in 0..exchanges {
            local = clock.poll_timeout().0.max(local);
            let request = clock.poll_request(Instant(local)).unwrap();
            local += delay(&mut seed);
            let received = Instant(server(local));
            let reply = TimeReply { nonce: request.nonce, received, held_micros: 300 };
            local += 300 + delay(&mut seed);
            clock.reply(&reply, Instant(local));
        }
        clock.to_server(Instant(local)).unwrap().0 as i64 - server(local) as i64
    }

    #[test]
    fn clocks_agree_within_a_millisecond_after_fifty_exchanges() {
        let seeds = 1000;
        let good = (0..seeds).filter(|&seed| error_after(50, seed, 0).abs() <= 1_000).count();
        assert!(good as u64 * 100 >= seeds * 99, "{good} of {seeds}");
    }

    #[test]
    fn a_clock_that_drifts_is_followed() {
        let worst = (0..100).map(|seed| error_after(400, seed, 25).abs()).max().unwrap();
        assert!(worst <= 5_000, "{worst} us");
    }

    #[test]
    fn the_first_minima_do_not_age_by_the_time_before_the_first_exchange() {
        let mut clock = ClockSync::default();
        // The robot sent Hellos for a day before the first exchange. That exchange is the fastest;
        // all later ones are slow.
        let day = 86_400_000_000;
        for exchange in 0..9 {
            let now = clock.poll_timeout().0.max(day);
            let request = clock.poll_request(Instant(now)).unwrap();
            let there = if exchange == 0 { 0 } else { 5_000 };
            let received = Instant(now + there);
            let reply = TimeReply { nonce: request.nonce, received, held_micros: 0 };
            clock.reply(&reply, received);
        }
        let now = clock.poll_timeout();
        let error = clock.to_server(now).unwrap().0.abs_diff(now.0);
        assert!(error < 100, "{error} us");
    }

    /// One exchange in which the request takes `there` and the reply `back` microseconds, by clocks
    /// that agree; the server holds it for 300 us.
    fn exchange(clock: &mut ClockSync, there: u64, back: u64) -> Instant {
        let sent = clock.poll_timeout();
        let request = clock.poll_request(sent).unwrap();
        let received = sent + Duration(there);
        let arrived = received + Duration(300 + back);
        clock.reply(&TimeReply { nonce: request.nonce, received, held_micros: 300 }, arrived);
        arrived
    }

    #[test]
    fn requests_are_frequent_until_the_first_minima_are_good() {
        let mut clock = ClockSync::default();
        for count in 0..80 {
            let sent = clock.poll_timeout();
            assert_eq!(clock.poll_request(sent).map(|it| it.nonce), Some(count));
            let millis = if count < 64 { 125 } else { 5_000 };
            assert_eq!(clock.poll_timeout(), sent + Duration::from_millis(millis), "{count}");
            let early = Instant(clock.poll_timeout().0 - 1);
            assert_eq!(clock.poll_request(early), None);
            clock.reply(&TimeReply { nonce: count, received: sent, held_micros: 0 }, sent);
        }
    }

    #[test]
    fn the_fastest_exchange_of_the_last_eight_generations_counts() {
        let mut clock = ClockSync::default();
        let now = exchange(&mut clock, 0, 0);
        let mut error = clock.to_server(now).unwrap().0.abs_diff(now.0);
        for count in 1..=70 {
            assert_eq!(error, if count <= 64 { 0 } else { 2_500 }, "after {count} exchanges");
            let now = exchange(&mut clock, 5_000, 0);
            // The minima drift by less than 0.2 ms in this time.
            error = clock.to_server(now).unwrap().0.abs_diff(now.0) / 250 * 250;
        }
    }

    #[test]
    fn a_slow_reply_is_ignored() {
        for (late, is_taken) in [(2_000_000, true), (2_000_001, false)] {
            let mut clock = ClockSync::default();
            let sent = clock.poll_timeout();
            let request = clock.poll_request(sent).unwrap();
            let reply = TimeReply { nonce: request.nonce, received: sent, held_micros: 0 };
            clock.reply(&reply, sent + Duration(late));
            let now = Instant(9_000_000);
            assert_eq!(clock.to_server(now).is_some(), is_taken);
            // Even a slow reply uses up its request, so a second one is ignored.
            clock.reply(&reply, sent);
            assert_eq!(clock.to_server(now).is_some(), is_taken);
        }
    }

    #[test]
    fn a_reply_to_another_request_is_ignored() {
        let mut clock = ClockSync::default();
        let request = clock.poll_request(Instant(0)).unwrap();
        let received = Instant(5_000_000);
        clock.reply(&TimeReply { nonce: request.nonce + 1, received, held_micros: 0 }, Instant(10));
        assert_eq!(clock.to_server(Instant(10)), None);
        assert_eq!(clock.to_server(Instant(u64::MAX)), None);
        clock.reply(&TimeReply { nonce: request.nonce, received, held_micros: 0 }, Instant(10));
        assert_eq!(clock.to_server(Instant(10)), Some(Instant(5_000_005)));
    }

    #[test]
    fn a_moment_before_the_other_clock_started_has_no_time_there() {
        let mut clock = ClockSync::default();
        let start = Instant(9_000_000);
        let request = clock.poll_request(start).unwrap();
        let received = Instant(1_000);
        clock.reply(&TimeReply { nonce: request.nonce, received, held_micros: 0 }, start);
        assert_eq!(clock.to_server(start), Some(received));
        assert_eq!(clock.to_server(start - Duration(2_000)), None);
        assert_eq!(clock.to_local(Instant(0)), Some(start - Duration(1_000)));
    }

    #[test]
    fn the_servers_time_never_steps_back() {
        let mut clock = ClockSync::default();
        let request = clock.poll_request(Instant(0)).unwrap();
        let slow = TimeReply { nonce: request.nonce, received: Instant(90_000), held_micros: 0 };
        clock.reply(&slow, Instant(0));
        let before = clock.server_now(Instant(1)).unwrap();
        assert_eq!(before, Instant(90_001));
        let later = clock.poll_timeout();
        let request = clock.poll_request(later).unwrap();
        let received = later + Duration(10);
        clock.reply(&TimeReply { nonce: request.nonce, received, held_micros: 0 }, later);
        assert!(clock.server_now(Instant(2)).unwrap() >= before);
    }
}

//! A one-way wire with faults, in virtual time.
//!
//! [`FaultWire`] has no clock, thread or socket: [`FaultWire::send`] takes frames,
//! [`FaultWire::next_delivery`] is the time of the next arrival, and [`FaultWire::poll`] returns
//! what has arrived. The seed determines every fault, so a run is reproducible.

use std::collections::{BTreeMap, BTreeSet};

use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ubimap_protocol::time::{Duration, Instant};

/// Minimum and maximum extra delay of a reordered frame: a few frame times.
const HOLD_BACK: (Duration, Duration) = (Duration::from_millis(5), Duration::from_millis(50));

/// Maximum number of bits flipped by one corruption.
const MAX_FLIPS: u32 = 8;

/// The faults of a wire. Probabilities are per frame, from 0 to 1; the default is a perfect wire.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Faults {
    /// Probability that a frame is lost, in the long-run average.
    pub loss: f64,
    /// Mean number of consecutive lost frames (a Gilbert-Elliott channel that loses every frame in
    /// its bad state). Independent losses come in runs of 1 / (1 - loss) frames on average; any
    /// smaller value, for example 1, gives independent losses.
    pub burst: f64,
    /// Probability that a frame that is not lost arrives twice.
    pub duplicate: f64,
    /// Probability that a copy is held back by 5 to 50 ms, so that later ones may overtake it. All
    /// other copies arrive in the order of sending, even with jitter.
    pub reorder: f64,
    /// Probability that 1 to 8 bits of a copy, including its delimiter, are flipped.
    pub corrupt: f64,
    /// Minimum time from sending to arrival.
    pub latency: Duration,
    /// Maximum random delay in addition to the latency, uniformly distributed per copy.
    pub jitter: Duration,
    /// Interval in which all frames sent are lost: from the first time until just before the
    /// second.
    pub cut: Option<(Instant, Instant)>,
}

impl Default for Faults {
    fn default() -> Self {
        Self {
            loss: 0.0,
            burst: 1.0,
            duplicate: 0.0,
            reorder: 0.0,
            corrupt: 0.0,
            latency: Duration::from_micros(0),
            jitter: Duration::from_micros(0),
            cut: None,
        }
    }
}

/// Counters of a wire.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Frames sent.
    pub sent: u64,
    /// Bytes sent, including those of lost frames.
    pub bytes: u64,
    /// Frames lost.
    pub lost: u64,
    /// Frames that arrive twice.
    pub duplicated: u64,
    /// Copies held back by reordering.
    pub reordered: u64,
    /// Copies with flipped bits.
    pub corrupted: u64,
}

/// One direction of a faulty channel.
#[derive(Clone, Debug)]
pub struct FaultWire {
    faults: Faults,
    losses: Losses,
    rng: ChaCha8Rng,
    counters: Counters,
    /// Copies in flight, by arrival time and then by order of sending.
    in_flight: BTreeMap<(Instant, u64), Vec<u8>>,
    copies: u64,
    /// Arrival time of the last copy that was not reordered; later ones must not overtake it.
    latest_in_order: Instant,
}

impl FaultWire {
    /// A wire with the given faults; the seed determines which frames they affect.
    pub fn new(faults: Faults, seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        Self {
            faults,
            losses: Losses::new(faults.loss, faults.burst, &mut rng),
            rng,
            counters: Counters::default(),
            in_flight: BTreeMap::new(),
            copies: 0,
            latest_in_order: Instant::default(),
        }
    }

    /// Sends one encoded frame of the link.
    pub fn send(&mut self, now: Instant, frame: &[u8]) {
        self.counters.sent += 1;
        self.counters.bytes += frame.len() as u64;
        let is_cut = self.faults.cut.is_some_and(|(from, to)| from <= now && now < to);
        if self.losses.next(&mut self.rng) || is_cut {
            self.counters.lost += 1;
            return;
        }
        self.send_copy(now, frame);
        if happens(&mut self.rng, self.faults.duplicate) {
            self.counters.duplicated += 1;
            self.send_copy(now, frame);
        }
    }

    /// Returns the next frame that has arrived by `now`.
    #[must_use]
    pub fn poll(&mut self, now: Instant) -> Option<Vec<u8>> {
        let first = self.in_flight.first_entry()?;
        (first.key().0 <= now).then(|| first.remove())
    }

    /// When the next frame arrives; `None` if nothing is in flight.
    #[must_use]
    pub fn next_delivery(&self) -> Option<Instant> {
        self.in_flight.first_key_value().map(|(&(due, _), _)| due)
    }

    /// Counters since the start.
    pub fn counters(&self) -> Counters {
        self.counters
    }

    fn send_copy(&mut self, now: Instant, frame: &[u8]) {
        let mut copy = frame.to_vec();
        if happens(&mut self.rng, self.faults.corrupt) && flip_bits(&mut self.rng, &mut copy) {
            self.counters.corrupted += 1;
        }
        let jitter = self.rng.random_range(0..=self.faults.jitter.micros());
        let mut due = now + self.faults.latency + Duration::from_micros(jitter);
        if happens(&mut self.rng, self.faults.reorder) {
            self.counters.reordered += 1;
            let (least, most) = HOLD_BACK;
            let hold = self.rng.random_range(least.micros()..=most.micros());
            due = due + Duration::from_micros(hold);
        } else {
            due = due.max(self.latest_in_order);
            self.latest_in_order = due;
        }
        self.in_flight.insert((due, self.copies), copy);
        self.copies += 1;
    }
}

/// Decides which frames are lost: a Gilbert-Elliott chain that delivers frames only in its good
/// state.
#[derive(Clone, Debug)]
struct Losses {
    bad: bool,
    good_to_bad: f64,
    bad_to_good: f64,
}

impl Losses {
    fn new(loss: f64, burst: f64, rng: &mut impl Rng) -> Self {
        let loss = if loss.is_nan() { 0.0 } else { loss.clamp(0.0, 1.0) };
        // The fraction of bad frames is good_to_bad / (good_to_bad + bad_to_good) = loss, and the
        // mean run of bad frames is 1 / bad_to_good. The shortest runs for a given loss are those
        // of independent losses: good_to_bad = 1 - bad_to_good = loss.
        let bad_to_good = (1.0 - loss).min(1.0 / burst.max(1.0));
        let good_to_bad = if loss < 1.0 { loss / (1.0 - loss) * bad_to_good } else { 1.0 };
        Self { bad: happens(rng, loss), good_to_bad, bad_to_good }
    }

    /// Whether the next frame is lost.
    fn next(&mut self, rng: &mut impl Rng) -> bool {
        let lost = self.bad;
        let turn = if self.bad { self.bad_to_good } else { self.good_to_bad };
        self.bad ^= happens(rng, turn);
        lost
    }
}

/// Whether a random event of this probability happens: never if it is NaN or at most 0, always if
/// it is at least 1.
fn happens(rng: &mut impl Rng, probability: f64) -> bool {
    rng.random::<f64>() < probability
}

/// Flips 1 to 8 different bits. Returns false if the frame is empty.
fn flip_bits(rng: &mut impl Rng, frame: &mut [u8]) -> bool {
    let bits = frame.len() * 8;
    if bits == 0 {
        return false;
    }
    let wanted = rng.random_range(1..=MAX_FLIPS) as usize;
    let mut flipped = BTreeSet::new();
    while flipped.len() < wanted {
        let bit = rng.random_range(0..bits);
        if flipped.insert(bit) {
            frame[bit / 8] ^= 1 << (bit % 8);
        }
    }
    true
}

#[cfg(test)]
mod tests {
    use super::*;

    const STEP: Duration = Duration::from_millis(10);

    /// Sends `count` numbered frames at intervals of `STEP`; returns the arrivals with their times.
    fn run(wire: &mut FaultWire, count: u32) -> Vec<(Instant, Vec<u8>)> {
        let mut arrivals = Vec::new();
        let mut now = Instant::default();
        for number in 0..count {
            while let Some(due) = wire.next_delivery().filter(|&due| due <= now) {
                arrivals.push((due, wire.poll(due).unwrap()));
            }
            wire.send(now, &number.to_le_bytes());
            now = now + STEP;
        }
        while let Some(due) = wire.next_delivery() {
            assert_eq!(wire.poll(due - Duration::from_micros(1)), None);
            arrivals.push((due, wire.poll(due).unwrap()));
        }
        arrivals
    }

    fn numbers(arrivals: &[(Instant, Vec<u8>)]) -> Vec<u32> {
        arrivals.iter().map(|(_, b)| u32::from_le_bytes(b[..].try_into().unwrap())).collect()
    }

    /// Lengths of the runs of consecutive lost frames.
    fn loss_runs(received: &[u32], count: u32) -> Vec<u32> {
        let mut runs = Vec::new();
        let mut expected = 0;
        for &number in received.iter().chain([&count]) {
            if number > expected {
                runs.push(number - expected);
            }
            expected = number + 1;
        }
        runs
    }

    #[test]
    fn a_perfect_wire_delivers_everything_in_order_at_once() {
        let mut wire = FaultWire::new(Faults::default(), 1);
        let arrivals = run(&mut wire, 100);
        assert_eq!(numbers(&arrivals), (0..100).collect::<Vec<_>>());
        assert!(arrivals.iter().zip(0..).all(|((at, _), n)| at.micros() == n * STEP.micros()));
        assert_eq!(wire.counters(), Counters { sent: 100, bytes: 400, ..Counters::default() });
    }

    #[test]
    fn frames_sent_at_the_same_time_keep_their_order() {
        let mut wire = FaultWire::new(Faults { latency: STEP, ..Faults::default() }, 1);
        for number in 0..50 {
            wire.send(Instant::default(), &[number]);
        }
        assert_eq!(wire.poll(Instant::default()), None);
        let due = wire.next_delivery().unwrap();
        assert_eq!(due, Instant::default() + STEP);
        for number in 0..50 {
            assert_eq!(wire.poll(due), Some(vec![number]));
        }
        assert_eq!(wire.next_delivery(), None);
    }

    #[test]
    fn the_seed_determines_every_fault() {
        let faults = Faults {
            loss: 0.3,
            burst: 3.0,
            duplicate: 0.1,
            reorder: 0.2,
            corrupt: 0.2,
            latency: STEP,
            jitter: STEP,
            cut: None,
        };
        let (mut one, mut two, mut other) =
            (FaultWire::new(faults, 7), FaultWire::new(faults, 7), FaultWire::new(faults, 8));
        let first = run(&mut one, 1_000);
        assert_eq!(first, run(&mut two, 1_000));
        assert_eq!(one.counters(), two.counters());
        assert_ne!(first, run(&mut other, 1_000));
    }

    #[test]
    fn the_mean_loss_does_not_depend_on_the_burst() {
        for (loss, burst, mean_run) in [
            (0.05, 1.0, 1.0 / 0.95),
            (0.3, 1.0, 1.0 / 0.7),
            (0.3, 5.0, 5.0),
            (0.3, 20.0, 20.0),
            (0.8, 1.0, 5.0),
            (0.8, 2.0, 5.0),
        ] {
            let count = 200_000;
            let mut wire = FaultWire::new(Faults { loss, burst, ..Faults::default() }, 3);
            let received = numbers(&run(&mut wire, count));
            let runs = loss_runs(&received, count);
            let lost = f64::from(count) - received.len() as f64;
            assert_eq!(wire.counters().lost as f64, lost);
            let (share, run) = (lost / f64::from(count), lost / runs.len() as f64);
            assert!((share / loss - 1.0).abs() < 0.06, "loss {loss} in bursts {burst}: {share}");
            assert!((run / mean_run - 1.0).abs() < 0.05, "loss {loss} in bursts {burst}: {run}");
        }
    }

    #[test]
    fn independent_losses_have_no_memory() {
        let count = 200_000;
        let mut wire = FaultWire::new(Faults { loss: 0.3, ..Faults::default() }, 4);
        let received = numbers(&run(&mut wire, count));
        let after_good = received.windows(2).filter(|w| w[1] != w[0] + 1).count();
        let share = after_good as f64 / received.len() as f64;
        assert!((share - 0.3).abs() < 0.01, "{share} lost after a frame that arrived");
    }

    #[test]
    fn probabilities_outside_their_range_do_not_panic() {
        for odd in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, -1.0, 0.0, 1.0, 2.0] {
            for burst in [odd, 1.0, 1e300] {
                let faults = Faults {
                    loss: odd,
                    burst,
                    duplicate: odd,
                    reorder: odd,
                    corrupt: odd,
                    latency: Duration(u64::MAX),
                    jitter: Duration(u64::MAX),
                    cut: None,
                };
                let mut wire = FaultWire::new(faults, 5);
                wire.send(Instant(u64::MAX), b"");
                wire.send(Instant(0), b"x");
                while wire.poll(Instant(u64::MAX)).is_some() {}
                let all = odd >= 1.0;
                assert_eq!(wire.counters().lost, if all { 2 } else { 0 }, "loss {odd}");
            }
        }
    }

    #[test]
    fn duplicates_are_equal_and_arrive_later() {
        let mut wire = FaultWire::new(Faults { duplicate: 0.25, ..Faults::default() }, 6);
        let received = numbers(&run(&mut wire, 20_000));
        assert!(received.is_sorted());
        let twice = received.windows(2).filter(|w| w[0] == w[1]).count();
        assert_eq!(twice as u64, wire.counters().duplicated);
        assert!((twice as f64 / 20_000.0 - 0.25).abs() < 0.015, "{twice}");
    }

    #[test]
    fn reordering_overtakes_within_its_bounds_and_jitter_does_not() {
        let jitter = Duration::from_millis(40);
        let mut steady = FaultWire::new(Faults { jitter, ..Faults::default() }, 9);
        let arrivals = run(&mut steady, 10_000);
        assert!(numbers(&arrivals).is_sorted());
        assert!(arrivals.iter().any(|(at, _)| at.micros() % STEP.micros() != 0));

        let mut wire = FaultWire::new(Faults { reorder: 0.1, ..Faults::default() }, 9);
        let arrivals = run(&mut wire, 10_000);
        let mut held = 0;
        for (&(at, _), &number) in arrivals.iter().zip(&numbers(&arrivals)) {
            let delay = at.since(Instant(u64::from(number) * STEP.micros()));
            if delay > Duration(0) {
                held += 1;
                assert!(delay >= HOLD_BACK.0 && delay <= HOLD_BACK.1, "{delay:?}");
            }
        }
        assert_eq!(held, wire.counters().reordered);
        assert!((held as f64 / 10_000.0 - 0.1).abs() < 0.02, "{held}");
        let overtaken = numbers(&arrivals).windows(2).filter(|w| w[1] < w[0]).count();
        assert!(overtaken > 500, "{overtaken}");
    }

    #[test]
    fn corruption_flips_one_to_eight_bits_anywhere() {
        let mut wire = FaultWire::new(Faults { corrupt: 0.5, ..Faults::default() }, 10);
        let clean = [0u8; 16];
        let mut flips = [0u32; 9];
        let mut bytes = [0u32; 16];
        for _ in 0..10_000 {
            wire.send(Instant(0), &clean);
            let frame = wire.poll(Instant(0)).unwrap();
            assert_eq!(frame.len(), clean.len());
            flips[frame.iter().map(|b| b.count_ones()).sum::<u32>() as usize] += 1;
            for (seen, byte) in bytes.iter_mut().zip(frame) {
                *seen += u32::from(byte != 0);
            }
        }
        assert_eq!(10_000 - u64::from(flips[0]), wire.counters().corrupted);
        assert!((f64::from(flips[0]) / 10_000.0 - 0.5).abs() < 0.03, "{flips:?}");
        assert!(flips[1..].iter().all(|&n| (500..750).contains(&n)), "{flips:?}");
        assert!(bytes.iter().all(|&n| n > 1_000), "{bytes:?}");
    }
}

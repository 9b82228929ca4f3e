use std::vec::Vec;

use proptest::prelude::*;
use ubimap_protocol::{frame::Key, message::ParameterValue, units::RobotId};

use super::{
    model::{Model, Modelled, TEARS, Words},
    *,
};

/// The record of a robot, whose fields all depend on its number.
fn record(robot: u16, boots: u32) -> Record {
    let values = (0..robot % 17).map(|parameter| {
        let value = i32::from(robot) * 70_001 - i32::from(parameter);
        ParameterValue { parameter, value }
    });
    let key = (robot.is_multiple_of(2)).then(|| Key::new([robot as u8; 16]));
    Record { robot: RobotId(robot), key, boots, parameters: values.collect() }
}

fn seed(robot: u16, boots: u32) -> Seed {
    Seed::parse(&Seed::to_bytes(&record(robot, boots))).unwrap()
}

/// A record without its boots, and that of the seed that it is from.
#[derive(Clone, Debug, PartialEq)]
struct State {
    seed: Record,
    record: Record,
}

impl State {
    fn of(seed: &Seed) -> Self {
        let record = Record { boots: 0, ..seed.record.clone() };
        Self { seed: record.clone(), record }
    }
}

/// What must come of boots: a plain model.
#[derive(Clone, Default)]
struct Oracle {
    /// What the last boot reported, with what was stored since.
    kept: Option<State>,
    /// What was written since then when the power was cut.
    pending: Vec<State>,
    /// The last boot number.
    last: u32,
}

impl Oracle {
    /// Boots once and checks the record and the number of the boot. The power may be cut meanwhile.
    fn boot(&mut self, flash: &mut impl Modelled, seed: Option<&Seed>) {
        let told = Slots::new(flash).boot(seed);
        let wanted = seed.map(State::of);
        if flash.is_off() {
            // Nobody has seen the answer.
            self.pending.extend(wanted);
            return;
        }
        let Some((record, boot)) = told.unwrap() else {
            assert_eq!((&self.kept, &wanted), (&None, &None), "a record was lost");
            return;
        };
        let record = Record { boots: 0, ..record };
        // A seed is taken unless the record is from it.
        let as_found = |state: &State| match &wanted {
            Some(wanted) if wanted.seed != state.seed => wanted.clone(),
            _ => state.clone(),
        };
        let old_or_new = self.kept.iter().chain(&self.pending).map(as_found);
        let mut possible: Vec<_> =
            old_or_new.chain(wanted.clone().filter(|_| self.kept.is_none())).collect();
        possible.retain(|state| state.record == record);
        let Some(found) = possible.pop() else { panic!("a mix: {record:?}") };
        assert!(boot > self.last, "boot {boot} after {}", self.last);
        (self.kept, self.last) = (Some(found), boot);
        self.pending.clear();
    }

    /// Stores parameters after a boot. The power may be cut meanwhile.
    fn store(&mut self, flash: &mut impl Modelled, changed: &[ParameterValue]) {
        let is_stored = store(flash, changed);
        let Some(kept) = &mut self.kept else {
            assert!(!is_stored);
            return;
        };
        let mut new = kept.clone();
        let parameters = &mut new.record.parameters;
        for value in changed {
            match parameters.iter().position(|old| old.parameter == value.parameter) {
                Some(place) => parameters[place] = *value,
                None => parameters.push(*value).unwrap(),
            }
        }
        if flash.is_off() {
            self.pending.push(new);
        } else {
            assert!(is_stored);
            *kept = new;
        }
    }

    fn step(&mut self, flash: &mut impl Modelled, step: &Step) {
        match step {
            Step::Boot(seed) => self.boot(flash, seed.as_ref()),
            Step::Store(changed) => self.store(flash, changed),
        }
    }
}

/// What happens to a robot.
#[derive(Clone)]
enum Step {
    /// It boots with an image that may have a seed.
    Boot(Option<Seed>),
    /// It stores parameters.
    Store(Vec<ParameterValue>),
}

/// Parameters to store, known to the records and new.
fn changed(noise: i32) -> Vec<ParameterValue> {
    let value = |parameter| ParameterValue { parameter, value: noise + i32::from(parameter) };
    [1, 20, 3].map(value).to_vec()
}

/// Images that are flashed one after the other: with new seeds, updates, the same again; and parameters that
/// are stored meanwhile.
fn script() -> Vec<Step> {
    let [a, b, none] = [Some(seed(2, 10)), Some(seed(31, 4)), None].map(Step::Boot);
    let [first, second] = [changed(500), changed(-500)].map(Step::Store);
    let mut script =
        [none.clone(), a.clone(), none.clone(), first.clone(), none.clone(), a].to_vec();
    script.extend([none.clone(), b.clone(), second, first, b]);
    script.extend([none.clone(), none.clone(), none]);
    script
}

/// Cuts the power at every step of a script, and once more after `seconds` steps of the boot that
/// follows. The slots have `len` bytes, and were booted `boots` times before. Returns the erasures of
/// a script without a cut.
fn cut_everywhere<F: Modelled>(len: usize, boots: usize, seconds: &[usize]) -> usize {
    let (mut flash, mut oracle) = (F::of(Model::new(len, 1)), Oracle::default());
    (0..boots).for_each(|_| oracle.boot(&mut flash, Some(&seed(28, 0))));
    (flash.steps, flash.erasures) = (0, 0);
    let (script, new) = (script(), (flash.clone(), oracle.clone()));
    script.iter().for_each(|step| oracle.step(&mut flash, step));
    let erasures = flash.erasures;
    for (first, tear) in (0..flash.steps).flat_map(|at| TEARS.map(|tear| (at, tear))) {
        // The second cut is never reached if it comes late. Each is tried with other bits left by the
        // cuts, and with a seed in the second boot or without.
        for (second, luck) in seconds.iter().flat_map(|&it| (0..12).map(move |luck| (it, luck))) {
            let noise = (first * 64 + second + luck * 99_991) as u32;
            let (mut flash, mut oracle) = new.clone();
            flash.noise = noise;
            flash.cut_after(first, tear);
            let mut steps = script.iter();
            for step in steps.by_ref() {
                oracle.step(&mut flash, step);
                if flash.is_off() {
                    break;
                }
            }
            flash.power_on();
            flash.cut_after(second, TEARS[luck % TEARS.len()]);
            let again = match steps.clone().next() {
                Some(Step::Boot(seed)) if luck % 3 == 0 => seed.as_ref(),
                _ => None,
            };
            oracle.boot(&mut flash, again);
            for step in [Step::Boot(None), Step::Boot(None)].iter().chain(steps) {
                if let Step::Boot(_) = step {
                    flash.power_on();
                }
                oracle.step(&mut flash, step);
            }
        }
    }
    erasures
}

// The script has two seeds and stores three times, for which a slot is erased; the other erasures are for full logs.
#[test]
fn a_cut_at_any_step_leaves_old_or_new_and_no_boot_number_twice() {
    fn cut<const N: usize>() -> usize {
        let steps = [0, 1, 2, 3, 4, 20, HEAD / N, HEAD / N + 1, 9_999];
        cut_everywhere::<Words<N>>(HEAD + 4 * N, 0, &steps)
    }
    assert_eq!([cut::<4>(), cut::<16>()], [7, 7]);
}

/// The sectors and pages of a Raspberry Pi Pico's flash: new ones, and some with a full log.
#[test]
fn a_cut_at_any_page_of_a_pico_leaves_old_or_new_and_no_boot_number_twice() {
    for (boots, erasures) in [(0, 5), (245, 6)] {
        let found = cut_everywhere::<Paged<Model>>(4_096, boots, &[0, 1, 2, 3, 4, 9_999]);
        assert_eq!(found, erasures, "{boots}");
    }
}

proptest! {
    #[test]
    fn no_series_of_cuts_mixes_records_or_repeats_a_boot_number(
        noise: u32,
        words in 1..9_usize,
        boots in prop::collection::vec((0..4_u16, 0..99_usize, 0..5_usize, 0..3), 1..60),
    ) {
        let (mut flash, mut oracle) = (Words::<8>(Model::new(HEAD + 8 * (words + 1), noise)), Oracle::default());
        for (number, steps, tear, stores) in boots {
            flash.power_on();
            if let Some(&tear) = TEARS.get(tear) {
                flash.cut_after(steps % 24, tear);
            }
            let seed = (number > 0).then(|| seed(number * 7, 0));
            oracle.boot(&mut flash, seed.as_ref());
            for _ in 0..stores {
                if !flash.is_off() {
                    oracle.store(&mut flash, &changed(steps as i32));
                }
            }
        }
    }

    #[test]
    fn a_seed_with_wrong_bits_is_none(at in 16..SEED_LEN, bits in 1..=255_u8) {
        let mut bytes = Seed::to_bytes(&record(16, 7));
        prop_assert_eq!(Seed::parse(&bytes).unwrap().record, record(16, 7));
        bytes[at] ^= bits;
        prop_assert_eq!(Seed::parse(&bytes), None);
    }
}

#[test]
fn a_failed_bit_costs_the_newest_record_but_repeats_no_boot_number() {
    for at in [0, 40, HEAD - 1] {
        let (mut flash, mut oracle) = (Words::<4>(Model::new(HEAD + 20, 5)), Oracle::default());
        for _ in 0..11 {
            oracle.boot(&mut flash, Some(&seed(6, 0)));
        }
        // Boots 9 to 11 are in the first slot.
        flash.damage(Slot::First, at);
        oracle.boot(&mut flash, None);
        assert_eq!(oracle.last, 13, "the four of the lost log are skipped");
        oracle.boot(&mut flash, None);
        assert_eq!(oracle.last, 14);
        // The only slot that was ever written fails: the seed is taken again.
        let (mut flash, mut oracle) = (Words::<4>(Model::new(HEAD + 20, 5)), Oracle::default());
        for _ in 0..3 {
            oracle.boot(&mut flash, Some(&seed(6, 20)));
        }
        flash.damage(Slot::First, at);
        oracle.boot(&mut flash, Some(&seed(6, 20)));
        assert_eq!(oracle.last, 25);
    }
}

#[test]
fn a_slot_is_erased_once_per_log_of_boots() {
    let (mut flash, mut oracle) = (Words::<4>(Model::new(HEAD + 404, 5)), Oracle::default());
    for _ in 0..1_000 {
        oracle.boot(&mut flash, Some(&seed(6, 0)));
    }
    assert_eq!((flash.erasures, oracle.last), (10, 1_000));
}

#[test]
fn a_seed_counts_on_from_the_higher_number() {
    let mut flash = Words::<4>(Model::new(HEAD + 404, 5));
    let mut boot = |seed| match identify(&mut flash, seed) {
        Identity::Known(record, seal) => (record.robot.0, seal.map(|seal| seal.boot)),
        other => panic!("{other:?}"),
    };
    assert_eq!(boot(Some(seed(2, 100))), (2, Some(101)));
    assert_eq!(boot(Some(seed(4, 50))), (4, Some(102)));
    assert_eq!(boot(None), (4, Some(103)));
    assert_eq!(boot(Some(seed(2, 200))), (2, Some(201)));
    assert_eq!(boot(Some(seed(5, 0))), (5, None));
}

#[test]
fn a_flash_that_keeps_nothing_serves_an_open_link_only() {
    let mut flash = Words::<4>(Model::new(HEAD + 404, 5));
    assert_eq!(identify(&mut flash, None), Identity::Unknown);
    flash.is_read_only = true;
    assert_eq!(identify(&mut flash, None), Identity::Unknown);
    assert_eq!(identify(&mut flash, Some(seed(2, 0))), Identity::NotKept);
    assert_eq!(identify(&mut flash, Some(seed(3, 9))), Identity::Known(record(3, 9), None));
    // All numbers are used up.
    let mut flash = Words::<4>(Model::new(HEAD + 404, 5));
    assert_eq!(identify(&mut flash, Some(seed(2, u32::MAX))), Identity::NotKept);
}

#[test]
fn an_image_without_a_seed_says_so() {
    assert_eq!(Seed::parse(&UNPROVISIONED), None);
    assert_eq!(UNPROVISIONED[..16], MAGIC);
    let mut many = Seed::to_bytes(&record(16, 7));
    // More parameters than fit, under a good CRC.
    many[16 + 24] = 17;
    let crc = ubimap_protocol::checksum::crc32(&[&many[..SEED_LEN - 4]]);
    many[SEED_LEN - 4..].copy_from_slice(&crc.to_le_bytes());
    assert_eq!(Seed::parse(&many), None);
}

#[test]
fn a_network_comes_back_from_the_bytes_of_an_image() {
    let text =
        |len: usize| "äbcdefghijk".chars().cycle().take(len).collect::<std::string::String>();
    for (name, password) in [("lab".into(), "".into()), (text(29), text(58)), (text(1), text(8))] {
        let (name, password): (std::string::String, std::string::String) = (name, password);
        let network = Wireless {
            name: name.as_str().try_into().unwrap(),
            password: password.as_str().try_into().unwrap(),
            server: "192.168.1.10:4000".parse().unwrap(),
        };
        let bytes = network.to_bytes();
        assert_eq!(Wireless::parse(&bytes), Some(network));
        assert_eq!(bytes[16..22], [192, 168, 1, 10, 0xA0, 0x0F]);
        for at in 0..bytes.len() {
            let mut damaged = bytes;
            damaged[at] ^= 4;
            assert_eq!(Wireless::parse(&damaged), None, "{at}");
        }
    }
    assert_eq!(Wireless::parse(&WITHOUT_NETWORK), None);
    // A length beyond its field, and half a letter, under good CRCs.
    for (at, value) in [(22, 33), (23, 65), (24, 0xC3)] {
        let mut bytes = [0; WIRELESS_LEN];
        bytes[..16].copy_from_slice(&WITHOUT_NETWORK[..16]);
        bytes[22] = 1;
        bytes[at] = value;
        let crc = ubimap_protocol::checksum::crc32(&[&bytes[..120]]);
        bytes[120..].copy_from_slice(&crc.to_le_bytes());
        assert_eq!(Wireless::parse(&bytes), None, "{at}");
    }
}

#[test]
fn a_robot_serves_the_ports_that_it_may() {
    let config = || {
        Config::new(
            RobotId(9),
            crate::sense::SensorModel::Pinhole { focal: 1.0, centre: 0.0 },
            crate::Bounds::REFERENCE,
        )
    };
    let of =
        |identity: Identity| (identity.served().map(<[_]>::len), identity.complete(config()).robot);
    assert_eq!(of(Identity::Known(record(3, 1), None)), (Some(3), RobotId(3)));
    assert_eq!(Identity::Unknown.served(), Some(&[Port::Server][..]));
    assert_eq!(of(Identity::Unknown), (Some(1), RobotId(0)));
    assert_eq!(of(Identity::NotKept), (None, RobotId(0)));
    let seal = Seal { key: Key::new([1; 16]), boot: 5 };
    assert!(Identity::Known(record(2, 1), Some(seal)).complete(config()).seal.is_some());
}

//! The settings that the server can read and change at run time.

use heapless::Vec;
use ubimap_protocol::{
    checksum::crc32,
    message::{
        MAX_PARAMETERS, ParameterAction, ParameterCommand, ParameterOutcome, ParameterReport,
        ParameterValue, ToServer, Writer,
    },
    tile::Epoch,
    time::Duration,
    units::{Angle, Millimetres},
};

use super::{config::Config, parameter_storage::ParameterStorage, settings::Settings};
use crate::sense::{Exposure, Removal};

/// The parameters. The value of a variant is the parameter's number on the wire.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u16)]
pub enum Parameter {
    /// The sensor's position in `base_link`: forward, in millimetres, -2,000 to 2,000.
    MountingX = 1,
    /// The sensor's position in `base_link`: left, in millimetres, -2,000 to 2,000.
    MountingY = 2,
    /// The sensor's heading in `base_link`, in binary angle units, -32,768 to 65,535.
    MountingHeading = 3,
    /// How far the robot must move before it maps again, in millimetres, 0 to 10,000.
    GateDistance = 4,
    /// How far it must turn before it maps again, in binary angle units, 0 to 32,767.
    GateTurn = 5,
    /// How long changes of the map are collected before they are sent, in milliseconds, 0 to
    /// 60,000.
    Hold = 6,
    /// How long a scan waits for its pose, in milliseconds, 0 to 60,000.
    ScanDeadline = 7,
    /// The minimum epoch of new tiles, 0 to 1,073,741,824. A change discards all of the robot's own
    /// tiles: the server sets it after it has corrected the robot's pose or mounting.
    FirstEpoch = 8,
    /// Readings that are never mapped, by index: the first index in the value's upper half, the
    /// last in the lower. -1 removes none; the same holds for bearings.
    RemovedPixels = 9,
    /// Readings that are never mapped, by bearing in `base_link`: counter-clockwise from the
    /// bearing in the value's upper half to the one in the lower, in binary angle units.
    RemovedBearings = 10,
    /// Readings that are never mapped, by distance: the minimum in the value's upper half, the
    /// maximum in the lower, in millimetres; 0 removes none.
    RemovedDistances = 11,
    /// The minimum and the maximum brightness of a pixel whose depth is valid, in the value's upper
    /// and lower half.
    Exposure = 12,
    /// 1 if the robot's next boot begins with the present values of the others but the first epoch. Setting it
    /// to 1 stores them. Only robots whose board can do that have it.
    Stored = 13,
}

/// Packs two numbers into the upper and lower half of a value.
fn value_of(upper: u16, lower: u16) -> i32 {
    (u32::from(upper) << 16 | u32::from(lower)) as i32
}

/// The upper and the lower half of a value.
fn halves(value: i32) -> (u16, u16) {
    ((value >> 16) as u16, value as u16)
}

/// The value of a parameter that removes no readings.
const NONE: i32 = -1;

impl Parameter {
    /// All parameters, in the order of their numbers.
    pub const ALL: &[Self] = &[
        Self::MountingX,
        Self::MountingY,
        Self::MountingHeading,
        Self::GateDistance,
        Self::GateTurn,
        Self::Hold,
        Self::ScanDeadline,
        Self::FirstEpoch,
        Self::RemovedPixels,
        Self::RemovedBearings,
        Self::RemovedDistances,
        Self::Exposure,
        Self::Stored,
    ];

    /// Those that a robot has.
    fn of(settings: &Settings) -> &'static [Self] {
        match Self::ALL {
            [settable @ .., Self::Stored] if settings.parameter_storage.stored().is_none() => {
                settable
            }
            all => all,
        }
    }

    /// This one of `all`, by its number, as a slice of one; empty if it is not among them.
    fn numbered(number: u16, all: &'static [Self]) -> &'static [Self] {
        let found = |parameter: &&[Self]| parameter.iter().any(|it| *it as u16 == number);
        all.chunks(1).find(found).unwrap_or_default()
    }

    /// The parameter's name, for people.
    pub fn name(self) -> &'static str {
        match self {
            Self::MountingX => "mounting-x",
            Self::MountingY => "mounting-y",
            Self::MountingHeading => "mounting-heading",
            Self::GateDistance => "gate-distance",
            Self::GateTurn => "gate-turn",
            Self::Hold => "hold",
            Self::ScanDeadline => "scan-deadline",
            Self::FirstEpoch => "first-epoch",
            Self::RemovedPixels => "removed-pixels",
            Self::RemovedBearings => "removed-bearings",
            Self::RemovedDistances => "removed-distances",
            Self::Exposure => "exposure",
            Self::Stored => "stored",
        }
    }

    /// The minimum and the maximum of the values that can be set.
    pub fn range(self) -> (i32, i32) {
        match self {
            Self::MountingX | Self::MountingY => (-2_000, 2_000),
            Self::MountingHeading => (-32_768, 65_535),
            Self::GateDistance => (0, 10_000),
            Self::GateTurn => (0, 32_767),
            Self::Hold | Self::ScanDeadline => (0, 60_000),
            Self::FirstEpoch => (0, 1 << 30),
            Self::Stored => (1, 1),
            Self::RemovedPixels
            | Self::RemovedBearings
            | Self::RemovedDistances
            | Self::Exposure => (i32::MIN, i32::MAX),
        }
    }

    fn value(self, settings: &Settings) -> i32 {
        let millis = |span: Duration| (span.micros().min(60_000_000) as u32 / 1_000) as i32;
        let [.., pixels, bearings] = settings.removed;
        match self {
            Self::MountingX => settings.mounting.x.0,
            Self::MountingY => settings.mounting.y.0,
            Self::MountingHeading => i32::from(settings.mounting.heading.0),
            Self::GateDistance => settings.gate.distance.0,
            Self::GateTurn => i32::from(settings.gate.turn.0),
            Self::Hold => millis(settings.hold),
            Self::ScanDeadline => millis(settings.scan_deadline),
            Self::FirstEpoch => settings.first_epoch.0 as i32,
            Self::RemovedPixels => match pixels {
                Some(Removal::Pixels { first, last }) => value_of(first, last),
                _ => NONE,
            },
            Self::RemovedBearings => match bearings {
                Some(Removal::Bearings { from, to }) => value_of(from.0, to.0),
                _ => NONE,
            },
            Self::RemovedDistances => {
                let (from, to) = settings.validity.removed;
                value_of(from, to)
            }
            Self::Exposure => value_of(settings.exposure.darkest, settings.exposure.brightest),
            Self::Stored => are_stored(settings).into(),
        }
    }

    fn set(self, settings: &mut Settings, value: i32) {
        let span = Duration::from_millis(value.max(0) as u64);
        let (upper, lower) = halves(value);
        let removed = |removal| (value != NONE).then_some(removal);
        let [.., pixels, bearings] = &mut settings.removed;
        match self {
            Self::MountingX => settings.mounting.x = Millimetres(value),
            Self::MountingY => settings.mounting.y = Millimetres(value),
            Self::MountingHeading => settings.mounting.heading = Angle(value as u16),
            Self::GateDistance => settings.gate.distance = Millimetres(value),
            Self::GateTurn => settings.gate.turn = Angle(value as u16),
            Self::Hold => settings.hold = span,
            Self::ScanDeadline => settings.scan_deadline = span,
            Self::FirstEpoch => settings.first_epoch = Epoch(value as u32),
            Self::RemovedPixels => {
                *pixels = removed(Removal::Pixels { first: upper, last: lower });
            }
            Self::RemovedBearings => {
                *bearings = removed(Removal::Bearings { from: Angle(upper), to: Angle(lower) });
            }
            Self::RemovedDistances => settings.validity.removed = (upper, lower),
            Self::Exposure => settings.exposure = Exposure { darkest: upper, brightest: lower },
            Self::Stored => {}
        }
    }
}

/// The reply to a command: the parameters that are still to be reported.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Answer {
    number: u16,
    outcome: ParameterOutcome,
    untold: &'static [Parameter],
}

/// Executes a command. `None` if it waits until the parameters are stored.
pub(crate) fn carry_out(command: &ParameterCommand, settings: &mut Settings) -> Option<Answer> {
    let mut outcome = ParameterOutcome::Done;
    let number = command.number;
    let all = Parameter::of(settings);
    let wanted = match command.action {
        ParameterAction::List => return Some(Answer { number, outcome, untold: all }),
        ParameterAction::Get(number) => Parameter::numbered(number, all),
        ParameterAction::Set(ParameterValue { parameter, value }) => {
            let wanted = Parameter::numbered(parameter, all);
            if let Some(wanted) = wanted.first() {
                let (least, most) = wanted.range();
                if !(least..=most).contains(&value) {
                    outcome = ParameterOutcome::OutOfRange;
                } else if *wanted == Parameter::Stored && !are_stored(settings) {
                    settings.parameter_storage.wait(number);
                    return None;
                } else {
                    wanted.set(settings, value);
                }
            }
            wanted
        }
    };
    if wanted.is_empty() {
        outcome = ParameterOutcome::Unknown;
    }
    Some(Answer { number, outcome, untold: wanted })
}

/// The parameters that a board stores: not the first epoch, which is the server's business.
fn storable(settings: &Settings) -> Vec<ParameterValue, MAX_PARAMETERS> {
    let mut values = Vec::new();
    for &parameter in Parameter::ALL {
        if !matches!(parameter, Parameter::FirstEpoch | Parameter::Stored) {
            // There are no more of them than fit.
            let value = parameter.value(settings);
            let _ = values.push(ParameterValue { parameter: parameter as u16, value });
        }
    }
    values
}

/// The CRC-32 of their values.
fn crc(settings: &Settings) -> u32 {
    let mut bytes = [0; 4 * MAX_PARAMETERS];
    for (place, value) in bytes.as_chunks_mut::<4>().0.iter_mut().zip(&storable(settings)) {
        *place = value.value.to_le_bytes();
    }
    crc32(&[&bytes])
}

/// Whether the next boot begins with the present values.
fn are_stored(settings: &Settings) -> bool {
    settings.parameter_storage.stored() == Some(crc(settings))
}

/// The parameters to be stored, while a command waits for that.
pub(super) fn to_store(settings: &Settings) -> Option<Vec<ParameterValue, MAX_PARAMETERS>> {
    matches!(settings.parameter_storage, ParameterStorage::Waiting(..)).then(|| storable(settings))
}

/// The answer to the command that waited until the parameters were stored.
pub(super) fn finish(settings: &mut Settings, is_stored: bool) -> Option<Answer> {
    let stored = is_stored.then(|| crc(settings));
    let number = settings.parameter_storage.end(stored)?;
    let outcome = if is_stored { ParameterOutcome::Done } else { ParameterOutcome::OutOfRange };
    let untold = Parameter::numbered(Parameter::Stored as u16, Parameter::ALL);
    Some(Answer { number, outcome, untold })
}

const _: () = assert!(Parameter::ALL.len() <= MAX_PARAMETERS);

impl<D> Config<D> {
    /// The settings of a robot that has booted.
    pub(super) fn settings(&self) -> Settings {
        let mut settings = Settings::from(self);
        if self.keeps_parameters {
            settings.parameter_storage = ParameterStorage::Stored(crc(&settings));
        }
        settings
    }

    /// The values of all parameters but the first epoch.
    pub fn parameters(&self) -> Vec<ParameterValue, MAX_PARAMETERS> {
        storable(&Settings::from(self))
    }

    /// Sets parameters before the robot is made. Unknown ones and values out of range are skipped.
    pub fn set(&mut self, values: &[ParameterValue]) {
        let mut settings = Settings::from(&*self);
        for &value in values {
            let action = ParameterAction::Set(value);
            carry_out(&ParameterCommand { number: 0, action }, &mut settings);
        }
        self.mounting = settings.mounting;
        self.gate = settings.gate;
        self.hold = settings.hold;
        self.scan_deadline = settings.scan_deadline;
        self.first_epoch = settings.first_epoch;
        self.removed = settings.removed;
        self.validity = settings.validity;
        self.exposure = settings.exposure;
    }
}

/// Writes the part of the reply `answer` that fits into a frame; the rest stays for the next frame.
/// Returns whether anything was written.
pub(crate) fn push_report(
    answer: &mut Option<Answer>,
    settings: &Settings,
    writer: &mut Writer<'_, ToServer>,
) -> bool {
    let Some(Answer { number, outcome, untold }) = answer else { return false };
    let told = writer.push_longest(0..=untold.len(), |count| {
        let mut values = Vec::new();
        for parameter in untold.iter().take(count) {
            // The number of parameters is checked against the capacity at compile time, above.
            let value = parameter.value(settings);
            let _ = values.push(ParameterValue { parameter: *parameter as u16, value });
        }
        ParameterReport { number: *number, outcome: *outcome, values }
    });
    let Some(count) = told else { return false };
    *untold = untold.get(count..).unwrap_or_default();
    if untold.is_empty() {
        *answer = None;
    }
    true
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Bounds, sense::SensorModel};
    use ubimap_protocol::{message::Messages, units::RobotId};

    /// Those that every robot has.
    const SETTABLE: &[Parameter] = Parameter::ALL.split_last().unwrap().1;
    const STORED: &[Parameter] = &[Parameter::Stored];

    fn settings() -> Settings {
        let sensor = SensorModel::Radial { first: 0.0, step: 0.1 };
        Settings::from(&Config::new(RobotId(1), sensor, Bounds::SMALL))
    }

    fn set(parameter: u16, value: i32) -> ParameterCommand {
        let action = ParameterAction::Set(ParameterValue { parameter, value });
        ParameterCommand { number: 9, action }
    }

    #[test]
    fn every_parameter_reads_back_what_was_set() {
        let mut settings = settings();
        for &parameter in SETTABLE {
            let (least, most) = parameter.range();
            for value in [most, least.max(0), most / 3] {
                let answer = carry_out(&set(parameter as u16, value), &mut settings).unwrap();
                let told = (answer.outcome, answer.untold);
                assert_eq!(told, (ParameterOutcome::Done, &[parameter][..]));
                assert_eq!(parameter.value(&settings), value);
            }
        }
        let list = ParameterCommand { number: 1, action: ParameterAction::List };
        assert_eq!(carry_out(&list, &mut settings).unwrap().untold, SETTABLE);
    }

    #[test]
    fn a_configuration_takes_every_parameter() {
        let sensor = SensorModel::Radial { first: 0.0, step: 0.1 };
        let mut config = Config::new(RobotId(1), sensor, Bounds::SMALL);
        for &parameter in SETTABLE {
            let value =
                ParameterValue { parameter: parameter as u16, value: parameter.range().1 / 3 };
            config.set(&[value, ParameterValue { parameter: 99, value: 1 }]);
            assert_eq!(parameter.value(&Settings::from(&config)), value.value);
        }
    }

    #[test]
    fn the_server_clears_its_own_removals_only() {
        let mut settings = settings();
        let own = Some(Removal::Pixels { first: 3, last: 4 });
        settings.removed[0] = own;
        for (parameter, value) in [(9, 0x0007_0009), (10, -0x0007_0009), (9, -1), (10, -1)] {
            carry_out(&set(parameter, value), &mut settings);
        }
        assert_eq!(settings.removed, [own, None, None, None]);
        carry_out(&set(9, 0x0007_0009), &mut settings);
        carry_out(&set(10, 0xFFF0_0010u32 as i32), &mut settings);
        let pixels = Removal::Pixels { first: 7, last: 9 };
        let bearings = Removal::Bearings { from: Angle(0xFFF0), to: Angle(0x10) };
        assert_eq!(settings.removed, [own, None, Some(pixels), Some(bearings)]);
    }

    #[test]
    fn a_report_too_long_for_a_frame_is_split() {
        let list = ParameterCommand { number: 1, action: ParameterAction::List };
        let mut settings = settings();
        let mut answer = carry_out(&list, &mut settings);
        let mut numbers = std::vec::Vec::new();
        for _ in 0..Parameter::ALL.len() {
            let mut frame = [0; 24];
            let mut writer = Writer::new(&mut frame);
            if !push_report(&mut answer, &settings, &mut writer) {
                break;
            }
            let len = writer.len();
            let message = Messages::<ToServer>::new(&frame[..len]).next().unwrap();
            let part = message.unwrap().decode::<ParameterReport>().unwrap();
            numbers.extend(part.values.iter().map(|value| value.parameter));
        }
        assert_eq!(answer, None);
        assert_eq!(numbers, [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12]);
    }

    #[test]
    fn unknown_parameters_and_values_out_of_range_change_nothing() {
        let mut changed = settings();
        for &parameter in SETTABLE {
            let (least, most) = parameter.range();
            let beyond = [least.wrapping_sub(1), most.wrapping_add(1), i32::MIN, i32::MAX];
            for value in beyond.into_iter().filter(|value| !(least..=most).contains(value)) {
                let report = carry_out(&set(parameter as u16, value), &mut changed).unwrap();
                assert_eq!(report.outcome, ParameterOutcome::OutOfRange);
            }
        }
        // The board of this robot stores nothing.
        for unknown in [set(99, 0), set(13, 1)] {
            let answer = carry_out(&unknown, &mut changed).unwrap();
            assert_eq!((answer.outcome, answer.untold), (ParameterOutcome::Unknown, &[][..]));
        }
        assert_eq!((changed, to_store(&changed)), (settings(), None));
    }

    #[test]
    fn what_was_set_is_stored_once() {
        let sensor = SensorModel::Radial { first: 0.0, step: 0.1 };
        let config = Config::new(RobotId(1), sensor, Bounds::SMALL);
        let mut settings = Config { keeps_parameters: true, ..config }.settings();
        let stored = |settings: &mut Settings| {
            let get = ParameterCommand { number: 1, action: ParameterAction::Get(13) };
            let answer = carry_out(&get, settings).unwrap();
            assert_eq!((answer.outcome, answer.untold), (ParameterOutcome::Done, STORED));
            Parameter::Stored.value(settings)
        };
        let (done, refused) = (ParameterOutcome::Done, ParameterOutcome::OutOfRange);
        let answer = |outcome| Some(Answer { number: 9, outcome, untold: STORED });
        let list = ParameterCommand { number: 1, action: ParameterAction::List };
        assert_eq!(carry_out(&list, &mut settings).unwrap().untold, Parameter::ALL);
        // There is nothing to store yet, and the first epoch is not stored.
        assert_eq!(carry_out(&set(8, 77), &mut settings).unwrap().outcome, done);
        assert_eq!(carry_out(&set(13, 1), &mut settings), answer(done));
        assert_eq!((stored(&mut settings), finish(&mut settings, true)), (1, None));
        // A value out of range sets nothing.
        assert_eq!(carry_out(&set(4, -1), &mut settings).unwrap().outcome, refused);
        assert_eq!(stored(&mut settings), 1);

        for (parameter, value) in [(1, 120), (6, 300), (1, 130)] {
            assert_eq!(carry_out(&set(parameter, value), &mut settings).unwrap().outcome, done);
        }
        assert_eq!(carry_out(&set(13, 0), &mut settings), answer(refused));
        assert_eq!((stored(&mut settings), to_store(&settings)), (0, None));
        let value = |parameter, value| ParameterValue { parameter, value };
        for is_stored in [false, true] {
            assert_eq!(carry_out(&set(13, 1), &mut settings), None, "it waits");
            let values = to_store(&settings).unwrap();
            assert_eq!((values.len(), values[0], values[5]), (11, value(1, 130), value(6, 300)));
            let outcome = if is_stored { done } else { refused };
            assert_eq!(finish(&mut settings, is_stored), answer(outcome));
            assert_eq!(stored(&mut settings), i32::from(is_stored));
            assert_eq!((to_store(&settings), finish(&mut settings, true)), (None, None));
        }
        // Back to what is stored: there is nothing to store.
        for (value, is_stored) in [(131, 0), (130, 1)] {
            assert_eq!(carry_out(&set(1, value), &mut settings).unwrap().outcome, done);
            assert_eq!(stored(&mut settings), is_stored);
        }
    }
}

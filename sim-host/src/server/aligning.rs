//! What the server makes of a robot's fixes and distance vectors: from covered ground its constant
//! errors, which are cured; from blind ground fixes, by a match with the map.

use std::collections::VecDeque;

use ubimap_agent::Parameter;
use ubimap_protocol::{
    message::{
        Certainty, DistanceVector, FixSource, ParameterAction, ParameterCommand, ParameterOutcome,
        ParameterReport, ParameterValue, PoseFix,
    },
    tile::Epoch,
    time::{Duration, Instant},
    units::{Angle, Millimetres, Pose, RobotId},
};

use super::shared_map::SharedMap;
use crate::{
    mapping::{ConstantErrors, CureRecord, Match, Prior, Search, Surfaces, Trail, points},
    timing::{FIX_GAP, FIX_HISTORY, OUT_OF_VIEW},
};

/// What a robot draws counts for its own fixes after so many seconds: what it has just drawn can't
/// but agree with where it believes to be.
const OWN_AGE: u32 = 30;
/// Where a robot in view is looked for: at most so far from where cameras see it.
const IN_VIEW: Search = Search {
    position: Millimetres(100),
    turn: Angle(2_600),
    prior: Prior::Measured(Millimetres(25)),
};
/// How far a robot strays from what its odometry says after a metre or a radian, in millimetres and
/// radians: standard deviations, whose squares grow with the way.
const STRAYS: (f64, f64) = (20.0, 0.0175);
/// Nobody knows how far it has come before it is first heard of in blind ground: a metre in a
/// second, up to so many metres.
const UNHEARD: f64 = 6.0;
/// After a correction of fixes it takes a robot's filter so long to follow.
const SETTLING: Duration = Duration::from_secs(3);
/// Numbers of the server's own commands about parameters: this one and above.
const FIRST_NUMBER: u16 = 0xC000;
/// How far a robot's epochs may be ahead of those that the server has heard of: it begins one with
/// each tile that leaves its pool.
const EPOCHS_AHEAD: u32 = 4_096;
/// Distance vectors are looked at no sooner after each other: an agent sends one in a second.
const LOOK_INTERVAL: Duration = Duration::from_millis(250);

/// What the server makes of a distance vector.
pub(super) enum Looked {
    /// It was taken in blind ground and fits the map in one place.
    Fix(PoseFix),
    /// It was taken in view: so many points lie on what the cameras see, and so many in the free.
    Agreement(u32, u32),
}

/// One robot's part.
#[derive(Debug, Default)]
pub(super) struct Aligning {
    errors: ConstantErrors,
    /// Where cameras saw it of late, corrected; newest last.
    fixes: VecDeque<(Instant, Pose)>,
    blind: Option<Blind>,
    cure: Cure,
    /// Distance vectors up to this moment were taken before the last cure.
    cured: Instant,
    next_look: Instant,
}

/// A robot's time out of view.
#[derive(Debug)]
struct Blind {
    /// What it has seen since.
    trail: Trail,
    /// Where it said to be last, and how far it has come and turned since its pose was known.
    last: Pose,
    way_mm: f64,
    turned: f64,
}

impl Blind {
    /// It says to be somewhere, so long after its last fix.
    fn after(unseen: Duration, last: Pose) -> Self {
        let metres = (unseen.micros() as f64 / 1e6).min(UNHEARD);
        Self { trail: Trail::default(), last, way_mm: 1_000.0 * metres, turned: 0.0 }
    }

    /// It says to be somewhere else. Where to look for it.
    fn go(&mut self, to: Pose) -> Search {
        let (x, y) = (to.x - self.last.x, to.y - self.last.y);
        self.way_mm += f64::from(x.0).hypot(f64::from(y.0));
        self.turned += (to.heading - self.last.heading).radians().abs();
        self.last = to;
        let (way, turned) = (self.way_mm / 1_000.0, self.turned);
        // A robot of 10 % slip that turns by 3 degrees on each metre is found again.
        Search {
            position: Millimetres((200.0 + 100.0 * way).min(800.0) as i32),
            turn: Angle((800.0 + 500.0 * way).min(4_000.0) as u16),
            prior: Prior::Carried(
                Millimetres((STRAYS.0 * way.sqrt()) as i32),
                Angle::from_radians((STRAYS.1 * (way + turned).sqrt()).min(1.0)),
            ),
        }
    }

    /// Where it must be to see what it sees in blind ground.
    fn place(
        &mut self,
        robot: RobotId,
        vector: &DistanceVector,
        points: &[[f64; 2]],
        (map, resolution): (&SharedMap, Millimetres),
    ) -> Option<Match> {
        let search = self.go(vector.pose);
        let settled = ((vector.time.micros() / 1_000_000) as u32).saturating_sub(OWN_AGE);
        let own = map.layers.get(&robot);
        let reach = reach(points, search);
        let drawn = |id| {
            let mut tile = map.without(Some(robot), id);
            // What it has seen on its way is finer than what it drew, and goes before.
            if let Some(own) = own.filter(|_| !self.trail.has(id)) {
                tile.fill_unknown_from(&own.drawn_by(id, settled));
            }
            tile
        };
        let surfaces = Surfaces::about(vector.pose, reach, resolution, drawn, &self.trail);
        let found = surfaces.find(points, vector.pose, search);
        let pose = found.map_or(vector.pose, |found| found.pose);
        self.trail.add(pose, points, resolution);
        if found.is_some() {
            (self.way_mm, self.turned) = (0.0, 0.0);
        }
        found
    }
}

/// How far a cure has come.
#[derive(Debug, Default)]
enum Cure {
    #[default]
    None,
    /// An earlier life of the server left it where the robot's older epochs are to be retired.
    LeftOff,
    /// The fixes are corrected; the robot's older epochs are retired when its filter has followed.
    Settling(Instant),
    /// The sensor's error is found. The angle is to be added.
    Found { turn: Angle },
    /// The robot is asked how it believes its sensor to be mounted.
    Asking { number: u16, turn: Angle },
    /// It is told how.
    Mounting { number: u16, turn: Angle },
    /// It is told to begin its tiles anew.
    Retiring { number: u16 },
}

impl Aligning {
    /// Of a robot of whom no more is known than what was done about its errors.
    pub(super) fn of(record: &CureRecord) -> Self {
        let cure = if record.is_over { Cure::None } else { Cure::LeftOff };
        Self { errors: ConstantErrors::of(record.cured), cure, ..Self::default() }
    }

    /// What has been found of the robot's constant errors.
    pub(super) fn errors(&self) -> &ConstantErrors {
        &self.errors
    }

    /// Takes where a camera saw the robot, and returns where it was.
    pub(super) fn fix(&mut self, captured: Instant, seen: Pose) -> Pose {
        if self.fixes.back().is_some_and(|&(newest, _)| captured <= newest) {
            return self.errors.corrected(seen);
        }
        let pose = self.errors.fix(captured, seen);
        self.blind = None;
        self.fixes.push_back((captured, pose));
        self.fixes.retain(|&(moment, _)| captured.since(moment) <= FIX_HISTORY);
        pose
    }

    /// Takes a distance vector of the robot. Takes some milliseconds.
    pub(super) fn looked(
        &mut self,
        robot: RobotId,
        vector: &DistanceVector,
        (map, resolution): (&SharedMap, Millimetres),
        now: Instant,
    ) -> Option<Looked> {
        if now < self.next_look {
            return None;
        }
        self.next_look = now + LOOK_INTERVAL;
        let points = points(vector);
        if let Some(pose) = self.seen_at(vector.time) {
            let is_of_now = vector.time > self.cured;
            return is_of_now.then(|| self.compare(&points, pose, map, resolution));
        }
        let newest = self.fixes.back().map_or(Instant(0), |&(newest, _)| newest);
        if vector.time < newest {
            return None;
        }
        let unseen = vector.time.since(newest);
        let blind = self.blind.get_or_insert_with(|| Blind::after(unseen, vector.pose));
        if unseen < OUT_OF_VIEW {
            // It has just left the view, and knows well where it is.
            blind.trail.add(vector.pose, &points, resolution);
            return None;
        }
        let found = blind.place(robot, vector, &points, (map, resolution))?;
        // What they have to do with each other is left out: the deviations are on the wide side.
        let [x, y, heading] = found.deviations();
        // The casts saturate.
        let certainty = Certainty {
            x: x.ceil() as u16,
            y: y.ceil() as u16,
            heading: (heading / core::f64::consts::TAU * 65_536.0).ceil() as u16,
        };
        Some(Looked::Fix(PoseFix {
            time: vector.time,
            pose: found.pose,
            certainty,
            source: FixSource::MapMatch,
            earlier: heapless::Vec::new(),
        }))
    }

    /// Where cameras saw it at a moment.
    fn seen_at(&self, moment: Instant) -> Option<Pose> {
        let after = self.fixes.iter().position(|&(fix, _)| fix >= moment)?;
        let (to, end) = self.fixes[after];
        let (from, start) = *self.fixes.get(after.checked_sub(1)?)?;
        let gap = to.since(from);
        if gap > FIX_GAP {
            return None;
        }
        let part = moment.since(from).micros() as f64 / gap.micros() as f64;
        let mix = |from: Millimetres, to: Millimetres| {
            from + Millimetres(libm::round(f64::from((to - from).0) * part) as i32)
        };
        let turn = Angle::from_radians((end.heading - start.heading).radians() * part);
        Some(Pose { x: mix(start.x, end.x), y: mix(start.y, end.y), heading: start.heading + turn })
    }

    /// What it sees from where cameras see it, against what they see. A constant error explains
    /// what it explains: what is left is how well they agree.
    fn compare(
        &mut self,
        points: &[[f64; 2]],
        pose: Pose,
        map: &SharedMap,
        resolution: Millimetres,
    ) -> Looked {
        let reach = reach(points, IN_VIEW);
        let surfaces =
            Surfaces::about(pose, reach, resolution, |id| map.in_view(id), &Trail::default());
        let found = surfaces.find(points, pose, IN_VIEW);
        if let Some(found) = found {
            let [.., deviation] = found.deviations();
            let turned = (found.pose.heading - pose.heading).degrees();
            self.errors.turned(turned, deviation.to_degrees());
        }
        let (agree, contradict) =
            surfaces.agreement(points, found.map_or(pose, |found| found.pose));
        Looked::Agreement(agree, contradict)
    }

    /// The next step of a cure. `next` is the first epoch that the robot is not known to have used.
    pub(super) fn poll(&mut self, next: Epoch, now: Instant) -> Option<Step> {
        let (number, action) = match self.cure {
            Cure::None => {
                if self.errors.cure_identifier() {
                    self.fixes.clear();
                    self.cured = now;
                    self.cure = Cure::Settling(now + SETTLING);
                } else {
                    self.cure = Cure::Found { turn: self.errors.sensor_to_cure()? };
                }
                return Some(Step::Note);
            }
            Cure::LeftOff => {
                self.cure = Cure::Settling(now + SETTLING);
                return None;
            }
            Cure::Found { turn } => {
                self.cure = Cure::Asking { number: FIRST_NUMBER, turn };
                (FIRST_NUMBER, ParameterAction::Get(Parameter::MountingHeading as u16))
            }
            Cure::Settling(until) if until <= now => {
                let number = FIRST_NUMBER + 2;
                self.cure = Cure::Retiring { number };
                let epoch = next.0.saturating_add(EPOCHS_AHEAD).min(1 << 30);
                (number, set(Parameter::FirstEpoch, epoch as i32))
            }
            _ => return None,
        };
        Some(Step::Tell(ParameterCommand { number, action }))
    }

    /// Whether a report is of one of the server's own commands.
    pub(super) fn is_own(report: &ParameterReport) -> bool {
        report.number >= FIRST_NUMBER
    }

    /// With a robot that does not take the parameter all begins again.
    fn give_up(&mut self) -> Step {
        self.cure = Cure::None;
        self.errors.remounted(Angle(0));
        Step::GiveUp
    }

    /// Takes the robot's answer to a command of a cure.
    pub(super) fn reported(&mut self, report: &ParameterReport, now: Instant) -> Option<Step> {
        let value = report.values.first().map(|it| it.value);
        let value = value.filter(|_| report.outcome == ParameterOutcome::Done);
        match self.cure {
            Cure::Asking { number, turn } if number == report.number => {
                let Some(value) = value else { return Some(self.give_up()) };
                let heading = Angle(value as u16) + turn;
                let number = FIRST_NUMBER + 1;
                self.cure = Cure::Mounting { number, turn };
                let action = set(Parameter::MountingHeading, i32::from(heading.0 as i16));
                Some(Step::Tell(ParameterCommand { number, action }))
            }
            Cure::Mounting { number, turn } if number == report.number => {
                if value.is_none() {
                    return Some(self.give_up());
                }
                self.errors.remounted(turn);
                self.cured = now;
                self.cure = Cure::Settling(now);
                Some(Step::Note)
            }
            Cure::Retiring { number } if number == report.number => {
                self.cure = Cure::None;
                Some(Step::Retire(Epoch(u32::try_from(value?).ok()?)))
            }
            _ => None,
        }
    }
}

/// A step of a cure.
pub(super) enum Step {
    /// What to tell the robot.
    Tell(ParameterCommand),
    /// It is not to be forgotten how far it has come.
    Note,
    /// It is over, and nothing has come of it.
    GiveUp,
    /// It is over: the tiles of epochs below this one are void.
    Retire(Epoch),
}

/// To set a parameter.
fn set(parameter: Parameter, value: i32) -> ParameterAction {
    ParameterAction::Set(ParameterValue { parameter: parameter as u16, value })
}

/// How far the map is looked at.
fn reach(points: &[[f64; 2]], search: Search) -> Millimetres {
    let farthest = points.iter().map(|[x, y]| x.hypot(*y)).fold(0.0, f64::max);
    Millimetres(farthest as i32 + search.position.0 + 300)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn with_a_robot_that_refuses_nothing_is_cured_and_the_cure_is_over() {
        let turn = Angle::from_degrees(3.0);
        for cure in [Cure::Asking { number: 7, turn }, Cure::Mounting { number: 7, turn }] {
            let mut aligning = Aligning { cure, ..Aligning::default() };
            let report = ParameterReport {
                number: 7,
                outcome: ParameterOutcome::Unknown,
                values: heapless::Vec::new(),
            };
            assert!(matches!(aligning.reported(&report, Instant(0)), Some(Step::GiveUp)));
            assert!(matches!(aligning.cure, Cure::None));
            assert_eq!(aligning.errors().cured().added, 0.0);
        }
    }
}

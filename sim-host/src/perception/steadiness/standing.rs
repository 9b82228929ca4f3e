//! Decides whether a camera still stands where it should.
//!
//! A camera is **steady** until a depth image shows that it has moved. It is then in **doubt**: nothing
//! that it sees counts. If the next images say the same, it is **out** until its new pose is known well
//! enough; a view that half hides behind people or things says nothing. What is too little for a knock, but
//! lasts, is a drift, and followed.

use nalgebra::Isometry3;
use ubimap_protocol::time::{Duration, Instant};

use super::{
    motion::{Motion, lengths, motion, transform},
    view::{Aligned, View},
};
use crate::camera::{DepthNoise, Intrinsics};

/// Motions above which a camera was knocked, in metres and radians: half of 3 cm and of 2 degrees, which
/// are to be noticed.
const KNOCK_M: f64 = 0.015;
const KNOCK_RAD: f64 = 0.017_5;
/// Minimum squared Mahalanobis distance of a motion from none: one in 10^8 of those that are none with six
/// degrees of freedom.
const CLEAR: f64 = 50.0;
/// Minimum part of the view that an alignment explains, and part that is farther than it was if the camera
/// has turned elsewhere: people and things only come nearer.
const EXPLAINED: f64 = 0.5;
const ELSEWHERE: f64 = 0.25;
/// Time and number of images after which a doubt is certain, and time after which it is dropped if nothing
/// can be seen.
const CERTAIN: Duration = Duration::from_millis(1_500);
const CERTAIN_LOOKS: u32 = 5;
const DROPPED: Duration = Duration::from_secs(5);
/// Maximum standard deviations of the pose of a camera that returns, in metres and radians, and the minimum
/// number of images without a movement.
const KNOWN_M: f64 = 0.003;
const KNOWN_RAD: f64 = 0.001_7;
const RETURN_LOOKS: u32 = 20;
/// The part of an image's information that counts: errors of the sensor and of the view don't average out.
const COUNTS: f64 = 0.25;
/// The time over which a drift is averaged, and the part of that information that counts.
const DRIFT_OVER_S: f64 = 60.0;
const DRIFT_COUNTS: f64 = 0.1;
/// Motions above which a drift is followed, in metres and radians.
const DRIFT_M: f64 = 0.002;
const DRIFT_RAD: f64 = 0.000_7;
/// Distances of drift after which the view is learnt anew, in metres and radians.
const RENEWED_M: f64 = 0.005;
const RENEWED_RAD: f64 = 0.005;

/// Whether a camera stands where it should.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Standing {
    /// It does, as far as is known.
    #[default]
    Steady,
    /// It may have moved; nothing that it sees counts.
    Doubtful,
    /// It has moved, and its pose is not known.
    Out,
}

/// A change of a camera's pose.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Change {
    /// It was knocked and is out of use; what it has seen after `since` is wrong.
    Knocked {
        /// The last moment at which it certainly stood where it should.
        since: Instant,
        /// The pose that it seems to have; `None` if it sees something else altogether.
        pose: Option<Isometry3<f64>>,
    },
    /// It is in use again, in this pose.
    Returned(Isometry3<f64>),
    /// It has drifted to this pose.
    Drifted(Isometry3<f64>),
}

/// The watch over one camera. Poses are those of its depth sensor's optical frame in `map`.
#[derive(Clone, Debug)]
pub struct Steadiness {
    view: View,
    /// The pose when the view was learnt.
    origin: Isometry3<f64>,
    /// The motion since then that is known.
    moved: Isometry3<f64>,
    standing: Standing,
    /// When the present doubt began, and the number of images that confirm it.
    since: Instant,
    looks: u32,
    /// While it is steady, the drift; while it is out, the motion relative to `moved`.
    gathered: Motion,
    /// The last image, and the last that showed the camera in its place.
    last: Instant,
    vouched: Instant,
}

/// What an image says.
enum Says {
    Steady(Aligned),
    Moved(Aligned),
    Elsewhere,
    Nothing,
}

impl Steadiness {
    /// The watch over a depth sensor in its present pose.
    pub fn new(intrinsics: &Intrinsics, noise: DepthNoise, pose: Isometry3<f64>) -> Self {
        Self {
            view: View::new(intrinsics, noise),
            origin: pose,
            moved: Isometry3::identity(),
            standing: Standing::Steady,
            since: Instant(0),
            looks: 0,
            gathered: Motion::UNKNOWN,
            last: Instant(0),
            vouched: Instant(0),
        }
    }

    /// Whether the camera stands where it should.
    pub fn standing(&self) -> Standing {
        self.standing
    }

    /// The pose that is known.
    pub fn pose(&self) -> Isometry3<f64> {
        self.origin * self.moved
    }

    /// Takes the next depth image, which has the size of the sensor's. Late images are ignored.
    pub fn look(&mut self, depths: &[u16], captured: Instant) -> Option<Change> {
        if captured < self.last {
            return None;
        }
        let elapsed = captured.since(self.last);
        self.last = captured;
        if !self.view.is_learnt() {
            self.view.learn(depths, captured);
            self.vouched = captured;
            return None;
        }
        let says = self.says(depths);
        match self.standing {
            Standing::Steady => self.stay(says, depths, captured, elapsed),
            Standing::Doubtful => self.doubt(says, captured),
            Standing::Out => self.gather(says),
        }
    }

    fn says(&self, depths: &[u16]) -> Says {
        let Some(aligned) = self.view.align(depths, &self.moved) else { return Says::Nothing };
        if aligned.explained < EXPLAINED {
            return if aligned.farther > ELSEWHERE { Says::Elsewhere } else { Says::Nothing };
        }
        let motion = aligned.motion.faded(COUNTS);
        if is_beyond(&motion, KNOCK_M, KNOCK_RAD) {
            Says::Moved(aligned)
        } else {
            Says::Steady(aligned)
        }
    }

    fn stay(
        &mut self,
        says: Says,
        depths: &[u16],
        captured: Instant,
        elapsed: Duration,
    ) -> Option<Change> {
        match says {
            Says::Nothing => None,
            Says::Moved(_) | Says::Elsewhere => {
                self.standing = Standing::Doubtful;
                (self.since, self.looks) = (captured, 1);
                None
            }
            Says::Steady(aligned) => {
                self.vouched = captured;
                self.view.learn(depths, captured);
                let seconds = elapsed.micros() as f64 / 1e6;
                let kept = libm::exp(-seconds / DRIFT_OVER_S);
                self.gathered = self.gathered.faded(kept).with(&aligned.motion.faded(DRIFT_COUNTS));
                self.follow()
            }
        }
    }

    /// Follows a drift.
    fn follow(&mut self) -> Option<Change> {
        if !is_beyond(&self.gathered, DRIFT_M, DRIFT_RAD) {
            return None;
        }
        let (drift, _) = self.gathered.estimate()?;
        self.gathered = Motion::UNKNOWN;
        self.moved *= transform(&drift);
        let [metres, radians] = lengths(&motion(&self.moved));
        if metres > RENEWED_M || radians > RENEWED_RAD {
            self.renew();
        }
        Some(Change::Drifted(self.pose()))
    }

    fn doubt(&mut self, says: Says, captured: Instant) -> Option<Change> {
        let lasts = captured.since(self.since);
        let found = match says {
            Says::Steady(_) => {
                self.standing = Standing::Steady;
                return None;
            }
            Says::Nothing => {
                if lasts > DROPPED {
                    self.standing = Standing::Steady;
                }
                return None;
            }
            Says::Moved(aligned) => Some(aligned.pose),
            Says::Elsewhere => None,
        };
        self.looks += 1;
        if lasts < CERTAIN || self.looks < CERTAIN_LOOKS {
            return None;
        }
        self.standing = Standing::Out;
        self.begin(found);
        Some(Change::Knocked { since: self.vouched, pose: found.map(|it| self.origin * it) })
    }

    /// Begins to gather the motion, relative to what is known so far.
    fn begin(&mut self, found: Option<Isometry3<f64>>) {
        self.moved = found.unwrap_or(self.moved);
        self.gathered = Motion::UNKNOWN;
        self.looks = 0;
    }

    /// Gathers the motion of a camera that is out.
    fn gather(&mut self, says: Says) -> Option<Change> {
        match says {
            Says::Nothing | Says::Elsewhere => return None,
            // It moves still, or the first estimate was rough.
            Says::Moved(aligned) => {
                self.begin(Some(aligned.pose));
                return None;
            }
            Says::Steady(aligned) => {
                self.gathered = self.gathered.with(&aligned.motion.faded(COUNTS));
                self.looks += 1;
            }
        }
        let [metres, radians] = self.gathered.doubt()?;
        if self.looks < RETURN_LOOKS || metres > KNOWN_M || radians > KNOWN_RAD {
            return None;
        }
        let (rest, _) = self.gathered.estimate()?;
        self.moved *= transform(&rest);
        self.standing = Standing::Steady;
        self.renew();
        Some(Change::Returned(self.pose()))
    }

    /// Learns the view anew, in the present pose.
    fn renew(&mut self) {
        self.origin = self.pose();
        self.moved = Isometry3::identity();
        self.gathered = Motion::UNKNOWN;
        self.view.clear();
    }
}

/// Whether a motion clearly exceeds one of two limits, in metres and radians.
fn is_beyond(motion: &Motion, metres: f64, radians: f64) -> bool {
    motion.estimate().is_some_and(|(value, _)| {
        let [shift, turn] = lengths(&value);
        (shift > metres || turn > radians) && motion.distance(&value) > CLEAR
    })
}

//! Decides whether a camera still stands where it should.
//!
//! A camera is **steady** until a depth image shows that it has moved. It is then in **doubt**: nothing
//! that it sees counts. If the next images say the same, it is **out** until its new pose is known well
//! enough; a view that half hides behind people or things says nothing. What is too little for a knock, but
//! lasts, is a drift, and followed.
//!
//! Neighbours are heard where the view says nothing, such as the heading of a camera above a bare floor. They
//! can only accuse a camera with which they once agreed, since a camera may never have been calibrated well;
//! and if two cameras accuse each other, and the view of neither can tell, neither is left out.

use nalgebra::Isometry3;
use ubimap_protocol::time::{Duration, Instant};

use super::{
    body::Body,
    motion::{Motion, lengths, motion, transform},
    view::{Aligned, View},
    witness::Witness,
};
use crate::camera::{Calibration, DepthNoise, Intrinsics};

/// Motions above which a camera was knocked, in metres and radians: half of 3 cm and of 2 degrees, which
/// are to be noticed.
const KNOCK: [f64; 2] = [0.015, 0.017_5];
/// Minimum squared Mahalanobis distance of a motion from none: one in 10^8 of those that are none with six
/// degrees of freedom.
const CLEAR: f64 = 50.0;
/// Minimum part of the view that an alignment explains, and part that is farther than it was if the camera
/// has turned elsewhere: people and things only come nearer.
const EXPLAINED: f64 = 0.5;
const ELSEWHERE: f64 = 0.25;
/// The part of a knock below which a motion by the last images and neighbours is none: what the camera saw
/// until then stays in the map.
const VOUCHED: f64 = 0.25;
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
/// The times over which an image and a neighbour's word count in a steady camera, in seconds.
const IMAGE_S: f64 = 1.0;
const WORD_S: f64 = 2.0;
/// Minimum interval between two words about a camera, and distance between the robot's places for a camera
/// that is out, in metres.
const WORD_INTERVAL: Duration = Duration::from_millis(190);
const WORD_APART_M: f64 = 0.05;
/// Number of words without a contradiction after which neighbours agree with a camera.
const AGREED: u32 = 10;
/// Maximum motion after which the view that was learnt still serves to find the new pose, in metres and
/// radians.
const FARTHEST_M: f64 = 0.5;
const FARTHEST_RAD: f64 = 0.2;
/// The time over which a drift is averaged, and the part of that information that counts.
const DRIFT_OVER_S: f64 = 120.0;
const DRIFT_COUNTS: f64 = 0.1;
/// Motions above which a drift is followed, in metres and radians.
const DRIFT: [f64; 2] = [0.002, 0.000_7];
/// Like [`CLEAR`], for a drift: a wrong correction costs little.
const CLEAR_DRIFT: f64 = 20.0;
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
    /// It and another camera contradict each other about the places of robots, and the views of both can't
    /// tell which has moved.
    Disputed,
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
    /// The number of images of the drift, older ones in part.
    images: f64,
    /// The motion relative to `moved` by the last images, and by the neighbours.
    recent: Motion,
    words: Motion,
    last_word: Instant,
    /// The number of words without a contradiction.
    agreed: u32,
    /// The places of robots that neighbours have spoken of, while the camera is out.
    places: Vec<[f64; 2]>,
    /// The last image, and the last that showed the camera in its place.
    last: Instant,
    in_place: Instant,
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
            images: 0.0,
            recent: Motion::UNKNOWN,
            words: Motion::UNKNOWN,
            last_word: Instant(0),
            agreed: 0,
            places: Vec::new(),
            last: Instant(0),
            in_place: Instant(0),
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

    /// Takes what neighbours say of the markers in a picture. `calibration` is the camera's, at any pose.
    pub fn hear(&mut self, calibration: &Calibration, seen: &[Witness], captured: Instant) {
        if !self.view.is_learnt() || seen.is_empty() || captured < self.last_word + WORD_INTERVAL {
            return;
        }
        let Ok(here) = calibration.at(self.pose()) else { return };
        let seconds = captured.since(self.last_word).micros() as f64 / 1e6;
        self.last_word = captured;
        let is_out = self.standing == Standing::Out;
        if !is_out {
            self.words = self.words.faded(libm::exp(-seconds / WORD_S));
        }
        for witness in seen {
            let [x, y] = witness.place.position_m;
            let is_near = |[a, b]: &[f64; 2]| libm::hypot(a - x, b - y) < WORD_APART_M;
            if is_out && self.places.iter().any(is_near) {
                continue;
            }
            if let Some(motion) = witness.motion(&here) {
                self.words = self.words.with(&motion.faded(COUNTS));
                if is_out {
                    self.places.push([x, y]);
                }
            }
        }
        if !is_out {
            let contradict = is_beyond(&self.words, KNOCK, CLEAR);
            self.agreed = self.agreed.saturating_add(u32::from(!contradict));
        }
    }

    /// Whether the neighbours say that a camera has moved, and its view does not deny it.
    pub fn is_accused(&self) -> bool {
        self.agreed >= AGREED
            && self.standing != Standing::Out
            && is_beyond(&self.words, KNOCK, CLEAR)
            && is_beyond(&self.recent.with(&self.words), KNOCK, CLEAR)
    }

    /// Takes the next depth image, which has the size of the sensor's; `is_accused` says whether the
    /// neighbours accuse this camera and no other. What it shows of the robots does not count. Late images are
    /// ignored.
    pub fn look(
        &mut self,
        depths: &[u16],
        captured: Instant,
        robots: &[Body],
        is_accused: bool,
    ) -> Option<Change> {
        if captured < self.last {
            return None;
        }
        let elapsed = captured.since(self.last);
        self.last = captured;
        let pose = self.pose();
        let depths = &self.view.sample(depths, |ray| {
            let (from, along) = (pose.translation.vector, pose * ray);
            robots.iter().any(|robot| robot.is_before(&from, &along))
        });
        if !self.view.is_learnt() {
            self.view.learn(depths, captured);
            self.in_place = captured;
            return None;
        }
        let seconds = elapsed.micros() as f64 / 1e6;
        self.recent = self.recent.faded(libm::exp(-seconds / IMAGE_S));
        let says = match self.says(depths) {
            Says::Steady(aligned) => {
                self.recent = self.recent.with(&aligned.motion.faded(COUNTS));
                let (joint, _) = self.recent.with(&self.words).estimate()?;
                let pose = self.moved * transform(&joint);
                let [metres, radians] = lengths(&joint);
                if metres < KNOCK[0] * VOUCHED && radians < KNOCK[1] * VOUCHED {
                    self.in_place = captured;
                }
                // Where a view tells a direction badly, one image is not enough.
                if is_accused || is_beyond(&self.recent, KNOCK, CLEAR) {
                    Says::Moved(Aligned { pose, ..aligned })
                } else {
                    Says::Steady(aligned)
                }
            }
            says => says,
        };
        match self.standing {
            Standing::Steady => self.stay(says, depths, captured, seconds),
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
        if is_beyond(&motion, KNOCK, CLEAR) { Says::Moved(aligned) } else { Says::Steady(aligned) }
    }

    fn stay(
        &mut self,
        says: Says,
        depths: &[u16],
        captured: Instant,
        seconds: f64,
    ) -> Option<Change> {
        match says {
            Says::Nothing => None,
            Says::Moved(_) | Says::Elsewhere => {
                self.standing = Standing::Doubtful;
                (self.since, self.looks) = (captured, 1);
                None
            }
            Says::Steady(aligned) => {
                self.view.learn(depths, captured);
                let kept = libm::exp(-seconds / DRIFT_OVER_S);
                self.gathered = self.gathered.faded(kept).with(&aligned.mean.faded(DRIFT_COUNTS));
                self.images = self.images * kept + 1.0;
                self.follow()
            }
        }
    }

    /// Follows a drift.
    fn follow(&mut self) -> Option<Change> {
        // The view has noise as well, which every image shows alike and which would pass for a drift.
        let learnt = f64::from(self.view.images());
        let known = self.gathered.faded(learnt / (learnt + self.images));
        if !self.view.is_settled() || !is_beyond(&known, DRIFT, CLEAR_DRIFT) {
            return None;
        }
        let (drift, _) = self.gathered.estimate()?;
        self.forget();
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
        Some(Change::Knocked { since: self.in_place, pose: found.map(|it| self.origin * it) })
    }

    /// Begins to gather the motion, relative to what is known so far.
    fn begin(&mut self, found: Option<Isometry3<f64>>) {
        self.moved = found.unwrap_or(self.moved);
        self.forget();
        self.looks = 0;
    }

    /// Forgets all that is relative to a motion that has been corrected.
    fn forget(&mut self) {
        self.gathered = Motion::UNKNOWN;
        self.images = 0.0;
        self.recent = Motion::UNKNOWN;
        self.words = Motion::UNKNOWN;
        self.places.clear();
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
        let joint = self.gathered.with(&self.words);
        let (rest, _) = joint.estimate()?;
        if is_beyond(&joint, KNOCK, CLEAR) {
            self.begin(Some(self.moved * transform(&rest)));
            return None;
        }
        let [metres, radians] = joint.doubt()?;
        if self.looks < RETURN_LOOKS || metres > KNOWN_M || radians > KNOWN_RAD {
            return None;
        }
        let found = self.moved * transform(&rest);
        let [metres, radians] = lengths(&motion(&found));
        if metres > FARTHEST_M || radians > FARTHEST_RAD {
            return None;
        }
        self.moved = found;
        self.standing = Standing::Steady;
        self.renew();
        Some(Change::Returned(self.pose()))
    }

    /// Learns the view anew, in the present pose.
    fn renew(&mut self) {
        self.origin = self.pose();
        self.moved = Isometry3::identity();
        self.forget();
        self.agreed = 0;
        self.view.clear();
    }
}

/// Whether a motion exceeds one of two limits, in metres and radians, and by its squared Mahalanobis
/// distance is clearly not none.
fn is_beyond(motion: &Motion, [metres, radians]: [f64; 2], clear: f64) -> bool {
    motion.estimate().is_some_and(|(value, _)| {
        let [shift, turn] = lengths(&value);
        (shift > metres || turn > radians) && motion.distance(&value) > clear
    })
}

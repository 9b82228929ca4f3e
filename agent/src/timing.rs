//! What counts as silent, lost or late on a robot, and how often the robot speaks.

use ubimap_protocol::time::Duration;

// The session.

/// Interval of states, which keep an idle session alive. The server calls a robot silent after 15 s:
/// seven lost states in a row.
pub(crate) const STATE_INTERVAL: Duration = Duration::from_secs(2);
/// A reset is believed once the session has been silent for this long, a few frames at 15 Hz: a reset
/// that was forged or delayed does not end a session that lives.
pub(crate) const RESET_SILENCE: Duration = Duration::from_millis(300);
/// After an event, changes of the map are sent at once for this long: by then the scans that were
/// taken before the event are in the map.
pub(crate) const HURRY: Duration = Duration::from_millis(300);
/// An event is not repeated sooner than this, unless the server waits for it: more would tell nothing
/// new.
pub(crate) const EVENT_INTERVAL: Duration = Duration::from_secs(10);
/// A robot stops when its server has been silent for this long: nobody could take its path back. A
/// server that lives says something four times a second, so that it takes seven lost frames.
pub(crate) const SERVER_SILENT: Duration = Duration::from_secs(2);

// Poses and scans.

/// Readings of the odometry, or fixes, further apart than this leave a gap that is not bridged. A robot
/// that brakes with 1 m/s^2 strays from the straight way by 15 mm in this time.
pub(crate) const BRIDGED_GAP: Duration = Duration::from_millis(350);
/// Fixes have stopped when the last one is this old: five frames at 15 Hz. Soon after it the robot
/// still knows well where it is, and sees where it goes on to. Shorter than [`BLIND_VECTOR_INTERVAL`],
/// for each distance vector of a blind robot is answered by a fix.
pub(crate) const BLIND_AFTER: Duration = Duration::from_millis(350);
/// A scan that has waited this long for its pose is given up: fixes are up to half a second late, and
/// one that was lost comes with those after it.
pub(crate) const SCAN_LATE: Duration = Duration::from_millis(1_500);
/// A robot does not drive by a scan older than this: half a metre at 1 m/s.
pub(crate) const SCAN_STALE: Duration = Duration::from_millis(500);
/// A pose that is this much newer than the one of a later scan was timed before the clocks agreed.
pub(crate) const CLOCKS_DISAGREE: Duration = Duration::from_secs(10);

// The map.

/// Interval of digests: with two tiles each, a pool of 32 in three minutes for 3 bytes a second.
pub(crate) const DIGEST_INTERVAL: Duration = Duration::from_secs(10);
/// Interval at which evidence ages. A change must be seen often enough to be told within this time:
/// hits that are minutes apart are noise.
pub(crate) const AGEING_INTERVAL: Duration = Duration::from_secs(10);
/// A tile is calm when nothing in it has come or gone for this long: what has changed is then fixed.
pub(crate) const CALM: Duration = Duration::from_secs(600);
/// Coverage that was not confirmed for this long is stale: four confirmations at 4 Hz.
pub(crate) const COVERAGE_STALE: Duration = Duration::from_secs(1);
/// A robot that nobody has heard of for this long may be anywhere, and is not masked any more: its mask
/// has grown by 1.5 m.
pub(crate) const PEER_LOST: Duration = Duration::from_secs(3);
/// What cameras saw this long ago is not avoided any more: a person has walked 3 m.
pub(crate) const OBSTACLE_LOST: Duration = Duration::from_secs(2);

// Distance vectors.

/// Least interval of distance vectors of a robot that stands, which tell nothing new.
pub(crate) const STANDING_VECTOR_INTERVAL: Duration = Duration::from_secs(60);
/// Least interval of distance vectors of a blind robot: each is answered by a fix if the server can
/// place it on the map.
pub(crate) const BLIND_VECTOR_INTERVAL: Duration = Duration::from_secs(1);

// Driving.

/// How often the map is looked at for new obstacles.
pub(crate) const MAP_LOOK_INTERVAL: Duration = Duration::from_millis(500);
/// How often a new way is looked for while the old one is still good.
pub(crate) const REPLAN_INTERVAL: Duration = Duration::from_secs(4);
/// How long a hindered robot waits for its way to become clear before it looks for another one: a
/// person has passed by then.
pub(crate) const HINDERED_WAIT: Duration = Duration::from_secs(3);
/// How long a new way avoids what the robot waited for.
pub(crate) const AVOIDED_FOR: Duration = Duration::from_secs(10);
/// How long a robot without a way waits before it looks for one again.
pub(crate) const NO_WAY_RETRY: Duration = Duration::from_secs(2);
/// How long a robot stands before it tries whether its wheels work again.
pub(crate) const WHEELS_RETRY: Duration = Duration::from_secs(5);
/// A robot that stops for each scan goes on without one after this long: no camera sees it there.
pub(crate) const UNSEEN_STOP: Duration = Duration::from_secs(3);

//! Timeouts and intervals of a robot: its session, its map, and how long it waits while it drives.

use ubimap_protocol::time::Duration;

// The session.

/// Interval of state messages, which keep an idle session alive. The server's timeout of 15 s is
/// seven lost states in a row.
pub(crate) const STATE_INTERVAL: Duration = Duration::from_secs(2);
/// Minimum silence of the session before a reset is accepted, a few frames at 15 Hz: a forged or
/// delayed reset does not end a live session.
pub(crate) const RESET_SILENCE: Duration = Duration::from_millis(300);
/// Duration after an event in which changes of the map are sent without delay: by then the scans
/// from before the event are mapped.
pub(crate) const HURRY: Duration = Duration::from_millis(300);
/// Minimum interval of an event's repetitions, unless the server waits for it.
pub(crate) const EVENT_INTERVAL: Duration = Duration::from_secs(10);
/// Silence of the server after which a robot stops, as its path could not be revoked. A live server
/// sends four messages per second, so seven lost frames in a row are needed.
pub(crate) const SERVER_SILENT: Duration = Duration::from_secs(2);

// Poses and scans.

/// Maximum interval between odometry readings, or fixes, that is bridged. Braking at 1 m/s^2
/// displaces a robot by 15 mm in this time.
pub(crate) const BRIDGED_GAP: Duration = Duration::from_millis(350);
/// Age of the newest fix after which a robot counts as blind: five frames at 15 Hz. Shortly after,
/// its pose is still good. Shorter than [`BLIND_VECTOR_INTERVAL`], as a fix answers each distance
/// vector of a blind robot.
pub(crate) const BLIND_AFTER: Duration = Duration::from_millis(350);
/// Maximum time that a scan waits for its pose: fixes are up to half a second late, and a lost one
/// is repeated with the next.
pub(crate) const SCAN_LATE: Duration = Duration::from_millis(1_500);
/// Maximum age of the scan to drive by: half a metre at 1 m/s.
pub(crate) const SCAN_STALE: Duration = Duration::from_millis(500);
/// A pose newer than that of a later scan by this much was timed before clock synchronisation.
pub(crate) const CLOCKS_DISAGREE: Duration = Duration::from_secs(10);

// The map.

/// Interval of digests: with two tiles each, a pool of 32 takes under three minutes, at 3 bytes/s.
pub(crate) const DIGEST_INTERVAL: Duration = Duration::from_secs(10);
/// Interval of ageing evidence. Within it a change must be observed often enough to be sent: hits
/// minutes apart are noise.
pub(crate) const AGEING_INTERVAL: Duration = Duration::from_secs(10);
/// Time without changes after which a tile is calm.
pub(crate) const CALM: Duration = Duration::from_secs(600);
/// Age at which coverage is stale: four confirmations at 4 Hz.
pub(crate) const COVERAGE_STALE: Duration = Duration::from_secs(1);
/// Age of a robot's report after which it may be anywhere and is not masked: the mask has grown by
/// 1.5 m.
pub(crate) const PEER_LOST: Duration = Duration::from_secs(3);
/// Age at which obstacles reported by cameras are ignored: a person has walked 3 m.
pub(crate) const OBSTACLE_LOST: Duration = Duration::from_secs(2);

// Distance vectors.

/// Minimum interval of distance vectors at standstill, where they contain nothing new.
pub(crate) const STANDING_VECTOR_INTERVAL: Duration = Duration::from_secs(60);
/// Minimum interval of distance vectors of a blind robot: the server answers each with a fix if it
/// can locate it on the map.
pub(crate) const BLIND_VECTOR_INTERVAL: Duration = Duration::from_secs(1);

// Driving.

/// Interval of checking the map for new obstacles.
pub(crate) const MAP_LOOK_INTERVAL: Duration = Duration::from_millis(500);
/// Interval of planning again while the path is still good.
pub(crate) const REPLAN_INTERVAL: Duration = Duration::from_secs(4);
/// How long a hindered robot waits before it plans around the obstacle: a person has passed by
/// then.
pub(crate) const HINDERED_WAIT: Duration = Duration::from_secs(3);
/// How long plans avoid the obstacle that was waited for.
pub(crate) const AVOIDED_FOR: Duration = Duration::from_secs(10);
/// Interval of planning again without a path.
pub(crate) const NO_WAY_RETRY: Duration = Duration::from_secs(2);
/// How long a robot stands before it tries faulty wheels again.
pub(crate) const WHEELS_RETRY: Duration = Duration::from_secs(5);
/// Timeout of a stop for a scan: no camera sees the robot there.
pub(crate) const UNSEEN_STOP: Duration = Duration::from_secs(3);

//! Timeouts and intervals of a robot: its session, its map, and how long it waits while it drives.

use ubimap_protocol::time::Duration;

// The session.

/// Interval of state messages, which keep an idle session alive. The server's timeout of 15 s is
/// seven lost states in a row.
pub(crate) const STATE_INTERVAL: Duration = Duration::from_secs(2);
/// Minimum silence of the session before a reset is accepted: a few camera frames at 15 Hz. A
/// forged or delayed reset therefore does not end a live session.
pub(crate) const RESET_SILENCE: Duration = Duration::from_millis(300);
/// On a sealed link: silence of the session after which a frame that can't be opened starts a new
/// attempt. The counter on the wire has 16 bits, so after 32,768 lost frames it names the wrong one.
pub(crate) const DEAF: Duration = Duration::from_secs(15);
/// Duration after an event in which changes of the map are sent without delay. It is long enough to
/// map the scans taken before the event.
pub(crate) const HURRY: Duration = Duration::from_millis(300);
/// Minimum interval between two events with the same code, except for those that the server waits
/// for.
pub(crate) const EVENT_INTERVAL: Duration = Duration::from_secs(10);
/// Time without a message from the server after which a robot stops, as the server could not revoke
/// its path. A live server sends four messages per second, so this takes seven lost frames in a
/// row.
pub(crate) const SERVER_SILENT: Duration = Duration::from_secs(2);

// Poses and scans.

/// Maximum gap between odometry readings, or between fixes, that is bridged. Braking at 1 m/s^2
/// displaces a robot by 15 mm in this time.
pub(crate) const BRIDGED_GAP: Duration = Duration::from_millis(350);
/// Age of the newest fix after which a robot counts as blind (not seen by cameras): five frames at
/// 15 Hz. At this age its pose is still good. Must be below [`BLIND_VECTOR_INTERVAL`], because the
/// server answers each distance vector of a blind robot with a fix.
pub(crate) const BLIND_AFTER: Duration = Duration::from_millis(350);
/// Maximum time that a scan waits for its pose: fixes are up to half a second late, and a lost one
/// is repeated with the next.
pub(crate) const SCAN_LATE: Duration = Duration::from_millis(1_500);
/// Maximum age of a scan that the robot drives by: within it a robot at 1 m/s drives half a metre.
pub(crate) const SCAN_STALE: Duration = Duration::from_millis(500);

// The map.

/// Interval of digests. Each time, two tiles are sent: a pool of 32 takes under three minutes, at 3
/// bytes/s.
pub(crate) const DIGEST_INTERVAL: Duration = Duration::from_secs(10);
/// Interval at which weak evidence is reset. A change must be observed often enough within one
/// interval to be sent: hits minutes apart are noise.
pub(crate) const AGEING_INTERVAL: Duration = Duration::from_secs(10);
/// Time without changes after which a tile counts as calm, and its movable cells may become walls.
pub(crate) const CALM: Duration = Duration::from_secs(600);
/// Age at which coverage is stale: four confirmations at 4 Hz.
pub(crate) const COVERAGE_STALE: Duration = Duration::from_secs(1);
/// Age of another robot's report after which that robot is no longer masked: it may be anywhere,
/// and the mask has already grown by 1.5 m.
pub(crate) const PEER_LOST: Duration = Duration::from_secs(3);
/// Age at which an obstacle reported by cameras is ignored: a person may have walked 3 m since.
pub(crate) const OBSTACLE_LOST: Duration = Duration::from_secs(2);

// Distance vectors.

/// Minimum interval of distance vectors at standstill, where they tell nothing new.
pub(crate) const STANDING_VECTOR_INTERVAL: Duration = Duration::from_secs(60);
/// Minimum interval of distance vectors of a blind robot. The server answers each with a fix,
/// unless the robot has booted and was not found yet.
pub(crate) const BLIND_VECTOR_INTERVAL: Duration = Duration::from_secs(1);
/// The same while it turns: 30 degrees at 75 degrees a second, so that a sensor with a field of view of 60 degrees sees
/// half of the same walls again. Must be above [`BLIND_AFTER`], too.
pub(crate) const TURNING_VECTOR_INTERVAL: Duration = Duration::from_millis(400);

// Driving.

/// Interval at which the map is checked for new obstacles.
pub(crate) const MAP_LOOK_INTERVAL: Duration = Duration::from_millis(500);
/// Interval of replanning while the path is still good.
pub(crate) const REPLAN_INTERVAL: Duration = Duration::from_secs(4);
/// Time that a hindered robot waits before it plans around the obstacle: a person has usually
/// passed by then.
pub(crate) const HINDERED_WAIT: Duration = Duration::from_secs(3);
/// How long plans avoid an obstacle that did not go away.
pub(crate) const AVOIDED_FOR: Duration = Duration::from_secs(10);
/// How long a robot that found no way ignores what only it has seen stand.
pub(crate) const DOUBTS_OWN: Duration = Duration::from_secs(10);
/// Interval of replanning while there is no path.
pub(crate) const NO_WAY_RETRY: Duration = Duration::from_secs(2);
/// How long a robot that does not know its pose or a way turns on the spot, each time after [`LOST_REST`]: a turn and a
/// half at half a radian per second. It sees nothing new then, and turning on would wear its heading away.
pub(crate) const LOST_TURN: Duration = Duration::from_secs(20);
/// Interval of these turns: what is to be seen there, or on the server's map, may have changed.
pub(crate) const LOST_REST: Duration = Duration::from_secs(180);
/// How long a robot stands before it tries faulty wheels again.
pub(crate) const WHEELS_RETRY: Duration = Duration::from_secs(5);
/// Maximum duration of a stop for a scan. If no fix has arrived by then, no camera sees the robot
/// there, and it drives on.
pub(crate) const UNSEEN_STOP: Duration = Duration::from_secs(3);

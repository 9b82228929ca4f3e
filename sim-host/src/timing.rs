//! How old data may be: when the server treats a frame as late, a thing as lost and a robot as
//! silent.
//!
//! All of these judge data by its age, so they stand side by side: each says what it decides, and
//! why its value fits the others. Intervals at which something is done are elsewhere, and so is how
//! long the coordinator waits for a robot to move
//! ([`Settings`](crate::server::coordination::Settings)).
//!
//! The values follow from a few rates: cameras take 15 frames a second and their depths are looked
//! at five times a second ([`Observer`](crate::perception::Observer)); a robot reports its pose
//! every 2 s, and a link may lose three messages of ten.

use ubimap_protocol::time::Duration;

// Frames and what is seen in them.

/// A frame captured this much after the server's present is still taken: clocks of cameras are
/// synchronised to within that. Beyond it the camera's clock is wrong.
pub const CLOCK_TOLERANCE: Duration = Duration::from_millis(100);
/// A frame older than this says nothing about the present and is refused. No working network delays
/// one as much: the camera's clock is wrong, or the frame was held up.
pub const FRAME_LATE: Duration = Duration::from_secs(5);
/// Sightings of a robot by two cameras this far apart in time are joined into one pose: a frame
/// and a half, in which a robot moves less than 10 cm.
pub const SIGHTINGS_JOIN: Duration = Duration::from_millis(100);
/// A robot that no picture shows is masked out of a depth image where it was this long ago. A
/// picture misses a marker for a few frames, while the wider depth image still shows the robot.
pub const SIGHTING_HOLDS: Duration = Duration::from_millis(500);
/// A marker that was not seen for longer is searched for in the whole picture and no longer where
/// it is expected: the place would have grown to metres.
pub const MARKER_LOST: Duration = Duration::from_secs(1);
/// Of two places of one identifier, the one where nothing has been seen for this long, while
/// something was seen at the other one, is given up: it was a mistake.
pub const MARKER_PLACE_LOST: Duration = Duration::from_secs(1);
/// An unregistered tag is reported once it is read twice within this time: a pattern that looks
/// like one by chance is read once.
pub const STRANGER_CONFIRMED: Duration = Duration::from_secs(1);
/// An unregistered tag that was away for longer is reported again.
pub const STRANGER_AWAY: Duration = Duration::from_secs(10);
/// A person or thing that was not seen for longer is gone: five looks.
pub const THING_LOST: Duration = Duration::from_secs(1);

// Cells.

/// A cell is covered for this long after the frame that showed it. Every cell in view is looked at
/// at least twice a second, and a camera that dies must leave its cells blind within a second.
pub const COVERAGE_HOLDS: Duration = Duration::from_millis(700);
/// What a camera said of a cell holds for this long against another camera: one that sees the foot
/// of a wall does not free what one that sees the wall has drawn, and a dead camera keeps nobody
/// in the map.
pub const EVIDENCE_HOLDS: Duration = Duration::from_secs(1);
/// A cell that no camera saw for longer comes back into view: what robots have drawn there in the
/// meantime is superseded. Three times the time from one look to the next.
pub const CELL_AWAY: Duration = Duration::from_millis(1_500);

// Robots, as cameras see them.

/// Between two fixes further apart than this a robot may have done anything: its pose is not
/// interpolated and its course not measured. Five frames in a row without a sighting.
pub const FIX_GAP: Duration = Duration::from_millis(400);
/// A robot without a fix for this long is in blind ground. Longer than [`FIX_GAP`], so that a
/// marker that is hidden for a moment does not count.
pub const OUT_OF_VIEW: Duration = Duration::from_millis(700);
/// Fixes are remembered for this long: a distance vector may wait for its pose on the robot, and
/// then for its turn on a bad link.
pub const FIX_HISTORY: Duration = Duration::from_secs(4);
/// A robot that no camera has seen for longer may be anywhere: what stands where it stood is drawn
/// again.
pub const ROBOT_GONE: Duration = Duration::from_secs(10);

// Robots, as they report themselves.

/// A pose older than this is no longer given to other robots. A robot out of view reports its own
/// every 2 s, with half a second to arrive.
pub const POSE_STALE: Duration = Duration::from_millis(2_500);
/// A robot that was not heard for this long can't be commanded: two reports in a row were lost.
pub const ROBOT_UNREACHABLE: Duration = Duration::from_secs(5);
/// A session that was not heard for this long, while its port brings frames of another one, is not
/// the one that the robot has: a delayed hello may have opened it. Even a link that loses three
/// messages of ten does not lose seven reports in a row.
pub const SESSION_SILENT: Duration = Duration::from_secs(15);

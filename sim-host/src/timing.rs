//! Age limits of data: when the server treats a frame as late, a thing as lost and a robot as
//! silent.
//!
//! The values depend on each other, so they are in one file; each doc says what the limit decides
//! and how it relates to the others. Periods of repeated work are defined where the work is done,
//! and the coordinator's timeouts are in [`Settings`](crate::server::coordination::Settings).
//!
//! They follow from a few rates: cameras deliver 15 frames per second, and five depth images per
//! second are evaluated ([`Observer`](crate::perception::Observer)); a robot reports its pose every
//! 2 s, and a link may lose 30 % of its messages.

use ubimap_protocol::time::Duration;

// Frames, and the objects and robots in them.

/// Tolerance for capture times ahead of the server's clock. Cameras' clocks are synchronised to
/// within this; a frame further ahead is refused.
pub const CLOCK_TOLERANCE: Duration = Duration::from_millis(100);
/// Maximum age of a frame; older ones are refused. No working network delays a frame this long: the
/// camera's clock is wrong, or the frame was held up.
pub const FRAME_LATE: Duration = Duration::from_secs(5);
/// Sightings of one robot by two cameras are joined into one pose if they are at most this far
/// apart: 1.5 frames, in which a robot moves less than 10 cm.
pub const SIGHTINGS_JOIN: Duration = Duration::from_millis(100);
/// A robot that no picture shows is still masked out of depth images at its last position for this
/// long: pictures miss a marker for a few frames, while the wider depth image still shows the
/// robot.
pub const SIGHTING_HOLDS: Duration = Duration::from_millis(500);
/// After this time unseen, a marker is searched for in the whole picture. Its search window around
/// the expected position would be metres wide by then.
pub const MARKER_LOST: Duration = Duration::from_secs(1);
/// If one identifier is tracked at two places, the place without a sighting for this long is
/// dropped as a false detection while the other one is still seen.
pub const MARKER_PLACE_LOST: Duration = Duration::from_secs(1);
/// An unregistered tag is reported if it is read twice within this time: random patterns are
/// misread as a tag only once.
pub const STRANGER_CONFIRMED: Duration = Duration::from_secs(1);
/// An unregistered tag is reported again after this time unseen.
pub const STRANGER_AWAY: Duration = Duration::from_secs(10);
/// A person or thing that was not seen for this long is removed: five missed depth images.
pub const THING_LOST: Duration = Duration::from_secs(1);

// Cells.

/// A cell counts as covered for this long after the last frame that showed it. Cells in view are
/// seen at least twice per second, and the cells of a camera that fails must become uncovered
/// within a second.
pub const COVERAGE_HOLDS: Duration = Duration::from_millis(700);
/// One camera's evidence for a cell blocks another camera's for this long: a camera that sees only
/// the foot of a wall does not free the cells where another one sees the wall. A failed camera must
/// not keep a person in the map, so it expires.
pub const EVIDENCE_HOLDS: Duration = Duration::from_secs(1);
/// A cell that no camera saw for this long counts as new when it is seen again: what robots drew
/// there in the meantime is superseded. Three times the interval between looks.
pub const CELL_AWAY: Duration = Duration::from_millis(1_500);

// Robots, as cameras see them.

/// Maximum gap between two fixes across which a robot's pose is interpolated and its course
/// measured: five missed frames.
pub const FIX_GAP: Duration = Duration::from_millis(400);
/// A robot without a fix for this long is in blind ground. Longer than [`FIX_GAP`], so that a
/// briefly hidden marker does not count.
pub const OUT_OF_VIEW: Duration = Duration::from_millis(700);
/// Fixes are kept for this long: a distance vector may first wait on the robot for its pose, and
/// then in the queue of a bad link.
pub const FIX_HISTORY: Duration = Duration::from_secs(4);
/// A robot that no camera has seen for this long may be anywhere: the cells at its last position
/// are drawn again.
pub const ROBOT_GONE: Duration = Duration::from_secs(10);

// Robots, as they report themselves.

/// Maximum age of a pose that is given to other robots. A robot out of view reports its pose every
/// 2 s; half a second is left for the delivery.
pub const POSE_STALE: Duration = Duration::from_millis(2_500);
/// A robot that falls silent stops within two seconds, and stands where it is: the others are told of it for
/// this long, so that they do not map it. Later it may have been taken away.
pub const ROBOT_PARKED: Duration = Duration::from_secs(60);
/// A robot that was silent for this long can't be commanded: two consecutive reports were lost.
pub const ROBOT_UNREACHABLE: Duration = Duration::from_secs(5);
/// A session that was silent for this long, while its port receives frames of another session, is
/// abandoned: a delayed Hello may have opened it. A link that loses 30 % of its messages does not
/// lose seven consecutive reports.
pub const SESSION_SILENT: Duration = Duration::from_secs(15);

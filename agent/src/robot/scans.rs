//! How the robot processes a scan: the scan waits for its pose, is mapped, and yields a distance
//! vector.

use core::ops::Range;

use ubimap_protocol::{
    message::{DistanceVector, EventCode},
    time::Instant,
    units::Pose,
};

use super::{link::Link, mapper::Mapper};
use crate::{
    locate::{Located, Variances},
    map::{PeerMasks, ScanContext, Selected, Surround},
    sense::{Beam, Columns, ScanError, WaitingScans},
    share::DistanceVectors,
};

/// Minimum number of columns of a distance vector for which a small frame must have room beside the odometry.
const COLUMNS: usize = 16;

/// A scan whose pose is known.
struct PlacedScan {
    /// When it was taken, by the robot's clock.
    taken: Instant,
    /// The same time by the server's clock; `None` before the clocks are synchronised.
    server_moment: Option<Instant>,
    /// `base_link` in `map`.
    pose: Pose,
    /// The variances of the pose; `None` if they exceed the limit for mapping.
    variances: Option<Variances>,
    /// Whether there was no recent fix: no camera saw the robot.
    is_blind: bool,
}

impl Mapper<'_> {
    /// Processes a scan taken at `taken`.
    pub(super) fn scan(
        &mut self,
        scans: &mut WaitingScans<'_>,
        link: &Link,
        taken: Instant,
        readings: &[u16],
        now: Instant,
    ) -> Result<(), ScanError> {
        let is_blind = self.locator.is_blind(taken);
        let speaks = link.is_connected() && self.outbox.vectors.is_due(taken, is_blind);
        let pose = self.latest_pose.map(|(_, pose)| pose);
        // Odometry read before the scan gives the scan's pose only if the robot stands.
        let odometry = self.locator.standing_odometry();
        if !speaks
            && scans.check(taken, readings).is_ok()
            && self.selection.stands(self.settings.gate, pose, odometry, readings)
        {
            // The scan would add nothing, but tells that the robot is still there: the others must know,
            // lest they draw it.
            if let Some(pose) = pose {
                self.keep_pose(taken, pose);
            }
            self.statistics.scans = self.statistics.scans.wrapping_add(1);
            self.statistics.gated = self.statistics.gated.wrapping_add(1);
            return Ok(());
        }
        scans.push(taken, readings)?;
        self.locator.expect(taken);
        self.statistics.scans = self.statistics.scans.wrapping_add(1);
        self.map_waiting(scans, link, now);
        Ok(())
    }

    /// Reports a refused scan to the server.
    pub(super) fn refuse_scan(&mut self, error: ScanError, now: Instant) {
        let code = match error {
            ScanError::Width { .. } => EventCode::SensorFault,
            ScanError::Backwards => EventCode::ClockBackwards,
            ScanError::Full => {
                self.statistics.overflowed = self.statistics.overflowed.wrapping_add(1);
                EventCode::ScanOverflow
            }
        };
        self.outbox.events.raise(code, now);
    }

    /// Processes an odometry reading.
    pub(super) fn odometry(&mut self, moment: Instant, pose: Pose) {
        self.steadiness.odometry(moment, pose);
        if self.locator.odometry(moment, pose).is_err() {
            let backwards = &mut self.statistics.odometry_backwards;
            *backwards = backwards.wrapping_add(1);
        }
    }

    /// When the oldest waiting scan expires.
    pub(super) fn scan_timeout(&self, scans: &WaitingScans<'_>) -> Option<Instant> {
        scans.oldest().map(|taken| taken + self.settings.scan_deadline)
    }

    /// Maps the scans whose poses are known, and drops the expired ones.
    #[inline(never)]
    pub(super) fn map_waiting(&mut self, scans: &mut WaitingScans<'_>, link: &Link, now: Instant) {
        while let Some(taken) = scans.oldest() {
            let last_chance = now >= taken + self.settings.scan_deadline;
            let located = self.locator.at(taken, now, last_chance);
            if located == Located::NotYet {
                return;
            }
            let Some(readings) = scans.pop() else { return };
            if let Some(scan) = self.place(taken, located, now) {
                self.take_in(&scan, readings, link, now);
            }
        }
    }

    /// Checks the pose of a scan, and stores it as the newest. Returns `None` if the scan is
    /// dropped because its pose is unknown or the robot was shaken.
    fn place(&mut self, taken: Instant, located: Located, now: Instant) -> Option<PlacedScan> {
        let (pose, variances) = match located {
            Located::At(pose, variances) => (pose, Some(variances)),
            Located::Unsure(pose) => (pose, None),
            Located::NotYet | Located::Never => {
                self.statistics.expired = self.statistics.expired.wrapping_add(1);
                self.outbox.events.raise(EventCode::PoseLost, now);
                self.lost = true;
                return None;
            }
        };
        if core::mem::take(&mut self.lost) {
            self.outbox.events.raise(EventCode::PoseFound, now);
        }
        let server_moment = self.clock.to_server(taken);
        self.keep_pose(taken, pose);
        let is_shaken = self.steadiness.is_shaken(taken);
        if variances.is_none() {
            self.statistics.unsure = self.statistics.unsure.wrapping_add(1);
        } else if is_shaken {
            self.statistics.shaken = self.statistics.shaken.wrapping_add(1);
        }
        let is_blind = self.locator.is_blind(taken);
        (!is_shaken).then_some(PlacedScan { taken, server_moment, pose, variances, is_blind })
    }

    /// Stores the pose of a scan if it is the newest, and moves the window of the server's tiles with it.
    fn keep_pose(&mut self, taken: Instant, pose: Pose) {
        if self.latest_pose.is_none_or(|(newest, _)| newest < taken) {
            self.latest_pose = Some((taken, pose));
        }
        self.fused.follow(pose, self.settings.resolution);
    }

    /// Maps the new part of a scan, and queues the scan's distance vector if one is due.
    fn take_in(&mut self, scan: &PlacedScan, readings: &mut [u16], link: &Link, now: Instant) {
        let is_sure = scan.variances.is_some();
        // With an uncertain pose the scan is not mapped, but its distance vector may help the
        // server.
        let selected = if is_sure {
            self.selection.select(self.settings.gate, scan.pose, readings)
        } else {
            Selected::Nothing
        };
        if !is_sure || matches!(selected, Selected::Moved(_)) {
            self.outbox.vectors.move_on(scan.pose.heading);
        }
        let is_due = self.outbox.vectors.is_due(scan.taken, scan.is_blind);
        let vector_time = scan.server_moment.filter(|_| link.is_connected() && is_due);
        // The next scan is compared with these readings, before they are cleaned.
        let odometry = self.locator.newest_odometry();
        self.selection.mapped(scan.pose, odometry, readings, &selected);
        self.clean(readings, vector_time.is_some());
        if let Some(time) = vector_time {
            let room = link.room().saturating_sub(DistanceVector::OVERHEAD);
            let rest = room.checked_sub(DistanceVector::ODOMETRY).filter(|rest| *rest >= COLUMNS);
            let odometry = rest.and_then(|_| self.locator.odometry_at(scan.taken));
            let most = rest.unwrap_or(room);
            let columns = || Columns::of_scan(self.beams, readings, self.settings.mounting, most);
            let poses = (scan.pose, odometry);
            tell(&mut self.outbox.vectors, scan.taken, time, poses, columns);
        }
        match selected {
            Selected::Moved(part) | Selected::Changed(part) => {
                self.draw(scan, readings, part, now);
            }
            Selected::Nothing => {
                self.statistics.gated = self.statistics.gated.wrapping_add(u32::from(is_sure));
            }
        }
    }

    /// Sets invalid readings and those of removed beams to 0. Unless `wholly`, invalid readings are
    /// left if none are removed by distance: mapping checks the other rules itself where it needs
    /// them.
    fn clean(&self, readings: &mut [u16], wholly: bool) {
        if wholly || self.settings.validity.removes() {
            self.settings.validity.clean(readings);
        }
        if self.settings.removed.iter().any(Option::is_some) {
            // Mapping does not look at every beam of a surface, so removed beams must be cleared in
            // the readings.
            let beams = readings.iter_mut().zip(&*self.beams);
            beams.filter(|(_, beam)| **beam == Beam::NONE).for_each(|(reading, _)| *reading = 0);
        }
    }

    /// Draws a part of a scan into the robot's tiles.
    fn draw(&mut self, scan: &PlacedScan, readings: &[u16], part: Range<usize>, now: Instant) {
        let &PlacedScan { taken, server_moment, pose, .. } = scan;
        let (mask, variances) = (self.settings.peer_mask, scan.variances.unwrap_or_default());
        let (resolution, max_range) = (self.settings.resolution, self.settings.max_range);
        // Without fixes the pose drifts, and points that are off by a cell would draw every wall
        // twice. So only the range within which the heading is accurate enough is mapped.
        let range = if scan.is_blind { variances.reach(resolution, max_range) } else { max_range };
        let moment = server_moment.unwrap_or(taken);
        let view = ScanContext { pose, moment, range, resolution, mask };
        // The times of the other robots' reports are by the server's clock.
        let peers = self.commands.peers().filter(|_| server_moment.is_some());
        let peers = PeerMasks::new(peers, &view, variances);
        let fused = &self.fused;
        let around = |id| Surround { masked: peers.cells(id), ..fused.around(id, now) };
        let beams = self.beams.get(part.clone()).unwrap_or_default();
        let seen = readings.get(part).unwrap_or_default();
        let count = &mut self.statistics;
        let Some(mapped) = self.map.add(beams, seen, (pose, range), around) else {
            count.expired = count.expired.wrapping_add(1);
            return;
        };
        count.mapped = count.mapped.wrapping_add(1);
        count.pixels += mapped.pixels;
        count.cells_refused = count.cells_refused.wrapping_add(mapped.cells_refused);
        if mapped.cells_refused > 0 {
            self.outbox.events.raise(EventCode::PoolFull, now);
        }
        self.outbox.publisher.changed(now, server_moment.map(Instant::seconds));
    }
}

/// Queues the distance vector of a scan. Separate from mapping, so that the stack of the two does
/// not add up.
#[inline(never)]
fn tell(
    vectors: &mut DistanceVectors,
    taken: Instant,
    time: Instant,
    (pose, odometry): (Pose, Option<Pose>),
    columns: impl FnOnce() -> Option<Columns>,
) {
    let vector = columns().map(|Columns { first, step, distances }| DistanceVector {
        time,
        pose,
        first,
        step,
        distances,
        odometry,
    });
    vectors.take(taken, vector);
}

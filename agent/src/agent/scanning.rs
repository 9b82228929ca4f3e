//! The way of a scan: it waits for its pose, is mapped, and gives a distance vector.

use ubimap_protocol::{
    frame::SessionId,
    message::{DistanceVector, EventCode},
    time::Instant,
    units::{Angle, Pose},
};

use super::Agent;
use crate::{
    config::Config,
    locate::Located,
    map::{PeerMasks, ScanContext, Selected, Surround},
    sense::{Beam, Columns, ScanError},
    share::DistanceVectors,
    timing::CLOCKS_DISAGREE,
};

impl Agent<'_> {
    /// Takes a scan that was taken at `taken` (robot's clock): readings in millimetres, 0 where
    /// nothing came back. It is mapped as soon as its pose is known.
    ///
    /// # Errors
    /// Every [`ScanError`]; the scan is then not taken in.
    pub fn scan(
        &mut self,
        taken: Instant,
        readings: &[u16],
        now: Instant,
    ) -> Result<(), ScanError> {
        let speaks =
            self.link.session() != SessionId::NONE && self.vectors.is_due(taken, false, false);
        if !speaks
            && self.waiting.check(taken, readings).is_ok()
            && self.selection.stands(
                self.config.gate,
                self.latest_pose.map(|(_, pose)| pose),
                self.locator.newest_odometry(),
                readings,
            )
        {
            // There is nothing for which its pose would have to be known.
            self.statistics.scans = self.statistics.scans.wrapping_add(1);
            self.statistics.gated = self.statistics.gated.wrapping_add(1);
            return Ok(());
        }
        self.waiting.push(taken, readings).inspect_err(|error| {
            let code = match error {
                ScanError::Width { .. } => EventCode::SensorFault,
                ScanError::Backwards => EventCode::ClockBackwards,
                ScanError::Full => {
                    self.statistics.overflowed = self.statistics.overflowed.wrapping_add(1);
                    EventCode::ScanOverflow
                }
            };
            self.events.raise(code, now);
        })?;
        self.statistics.scans = self.statistics.scans.wrapping_add(1);
        self.map_waiting(now);
        Ok(())
    }

    /// Takes a reading of the odometry: `base_link` in `odom` at a moment of the robot's clock.
    pub fn odometry(&mut self, moment: Instant, pose: Pose, now: Instant) {
        self.steadiness.odometry(moment, pose);
        if self.locator.odometry(moment, pose).is_err() {
            let backwards = &mut self.statistics.odometry_backwards;
            *backwards = backwards.wrapping_add(1);
        }
        self.map_waiting(now);
    }

    /// Takes a reading of a gyroscope about the vertical, if the robot has one: how far it would
    /// turn in a second, either way.
    pub fn gyro(&mut self, moment: Instant, turn: Angle) {
        self.steadiness.gyro(moment, turn);
    }

    /// The robot was jolted at a moment of its clock: an accelerometer or a bumper says so. Scans
    /// of that moment are not mapped.
    pub fn jolt(&mut self, moment: Instant) {
        self.steadiness.jolt(moment);
    }

    /// Maps the scans whose poses are known, and gives up those whose time is over.
    #[inline(never)]
    pub(super) fn map_waiting(&mut self, now: Instant) {
        while let Some(taken) = self.waiting.oldest() {
            let last_chance = now >= taken + self.config.scan_deadline;
            let server_moment = self.clock.to_server(taken);
            let located = self.locator.at(taken, now, last_chance);
            if located == Located::NotYet {
                return;
            }
            let Some(readings) = self.waiting.pop() else { return };
            let (pose, variances) = match located {
                Located::At(pose, variances) => (pose, Some(variances)),
                Located::Unsure(pose) => (pose, None),
                Located::NotYet | Located::Never => {
                    self.statistics.expired = self.statistics.expired.wrapping_add(1);
                    self.events.raise(EventCode::PoseLost, now);
                    self.lost = true;
                    continue;
                }
            };
            if core::mem::take(&mut self.lost) {
                self.events.raise(EventCode::PoseFound, now);
            }
            let moment = server_moment.unwrap_or(taken);
            // One of much later was told before the clocks agreed, in the robot's.
            let is_newer = |(newest, _): (Instant, _)| {
                newest < moment || newest.since(moment) > CLOCKS_DISAGREE
            };
            if self.latest_pose.is_none_or(is_newer) {
                self.latest_pose = Some((moment, pose));
            }
            self.fused.follow(pose, self.config.resolution);
            let (unsure, shaken) = (variances.is_none(), self.steadiness.is_shaken(taken));
            if unsure {
                self.statistics.unsure = self.statistics.unsure.wrapping_add(1);
            } else if shaken {
                self.statistics.shaken = self.statistics.shaken.wrapping_add(1);
            }
            if shaken {
                continue;
            }
            // What an unsure robot sees is not mapped, but may tell the server where it is.
            let selected = if unsure {
                Selected::Nothing
            } else {
                self.selection.select(self.config.gate, pose, readings)
            };
            let moves = unsure || matches!(selected, Selected::Moved(_));
            let blind = self.locator.is_blind(taken);
            let vector_time = server_moment.filter(|_| {
                self.link.session() != SessionId::NONE && self.vectors.is_due(taken, moves, blind)
            });
            // What is compared with the next scan is what the sensor said.
            let odometry = self.locator.newest_odometry();
            self.selection.mapped(pose, odometry, readings, &selected);
            // Mapping looks for what does not count where it must; what is never to be mapped is
            // taken out for certain.
            if vector_time.is_some() || self.config.validity.removes() {
                self.config.validity.clean(readings);
            }
            if self.config.removed.iter().any(Option::is_some) {
                // Amid a surface no beam would be asked.
                let beams = readings.iter_mut().zip(&*self.beams);
                beams
                    .filter(|(_, beam)| **beam == Beam::NONE)
                    .for_each(|(reading, _)| *reading = 0);
            }
            if let Some(time) = vector_time {
                let most = self.link.room().saturating_sub(DistanceVector::OVERHEAD);
                let columns = || Columns::of_scan(self.beams, readings, self.config.mounting, most);
                tell(&mut self.vectors, taken, time, pose, columns);
            }
            let part = match selected {
                Selected::Nothing => {
                    let gated = &mut self.statistics.gated;
                    *gated = gated.wrapping_add(u32::from(!unsure));
                    continue;
                }
                Selected::Moved(part) | Selected::Changed(part) => part,
            };
            let fused = &self.fused;
            let Config { max_range, resolution, peer_mask: mask, .. } = self.config;
            let variances = variances.unwrap_or_default();
            // What an unseen robot draws a cell to the side becomes a second wall.
            let range = if blind { variances.reach(resolution, max_range) } else { max_range };
            let view = ScanContext { pose, moment, range, resolution, mask };
            // Without the server's time they mean nothing.
            let peers = self.commands.peers().filter(|_| server_moment.is_some());
            let peers = PeerMasks::new(peers, &view, variances);
            let around = |id| Surround { masked: peers.cells(id), ..fused.around(id, now) };
            let beams = self.beams.get(part.clone()).unwrap_or_default();
            let seen = readings.get(part).unwrap_or_default();
            let Some(mapped) = self.map.add(beams, seen, (pose, range), around) else {
                self.statistics.expired = self.statistics.expired.wrapping_add(1);
                continue;
            };
            let count = &mut self.statistics;
            count.mapped = count.mapped.wrapping_add(1);
            count.pixels += mapped.pixels;
            count.cells_refused = count.cells_refused.wrapping_add(mapped.cells_refused);
            if mapped.cells_refused > 0 {
                self.events.raise(EventCode::PoolFull, now);
            }
            let seconds = server_moment.map(Instant::seconds);
            self.publisher.changed(now, seconds);
        }
    }
}

/// Takes the distance vector of a scan, to be sent. Apart from mapping, which needs the stack.
#[inline(never)]
fn tell(
    vectors: &mut DistanceVectors,
    taken: Instant,
    time: Instant,
    pose: Pose,
    columns: impl FnOnce() -> Option<Columns>,
) {
    let vector = columns().map(|Columns { first, step, distances }| DistanceVector {
        time,
        pose,
        first,
        step,
        distances,
    });
    vectors.take(taken, vector);
}

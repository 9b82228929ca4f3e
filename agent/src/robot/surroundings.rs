//! The inputs of the drive's step.

use ubimap_protocol::{time::Instant, units::Pose};

use super::{link::Link, mapper::Mapper};
use crate::drive::Surroundings;

impl<'b> Mapper<'b> {
    /// `base_link` in `map` at `moment`, and the standard deviation of the position in millimetres.
    pub(super) fn pose_at(&self, moment: Instant) -> Option<(Pose, f32)> {
        let (pose, variances) = self.locator.predicted(moment)?;
        Some((pose, libm::sqrtf(variances.position)))
    }

    /// The inputs of the drive's step at `now`.
    pub(super) fn surroundings(
        &mut self,
        link: &Link,
        is_halted: bool,
        now: Instant,
    ) -> Surroundings<'_, 'b> {
        Surroundings {
            now,
            server_now: self.clock.server_now(now),
            pose: self.pose_at(now),
            odometry: self.locator.newest_odometry(),
            heard: link.heard(),
            is_connected: link.is_connected(),
            is_halted,
            gate: self.settings.gate,
            commands: &self.commands,
            cells_refused: self.statistics.cells_refused,
            own: &self.map.pool,
            fused: &self.fused,
        }
    }
}

//! The robot without its link and drive: localisation, mapping and sharing.

use ubimap_protocol::{link::ClockSync, time::Instant, units::Pose};

use super::{config::Config, outbox::Outbox, settings::Settings, statistics::Statistics};
use crate::{
    drive::Drive,
    locate::Locator,
    map::{LocalMap, OwnTile, Pool, RowSighting, Selection},
    sense::{Beam, Steadiness, fill_beams, remove_beams},
    share::{Commands, FusedMap, FusedTile},
};

/// The state that messages and scans change. Its type does not depend on the [`Drive`].
#[derive(Debug)]
pub(super) struct Mapper<'b> {
    pub(super) settings: Settings,
    pub(super) beams: &'b mut [Beam],
    pub(super) steadiness: Steadiness,
    pub(super) selection: Selection,
    pub(super) locator: Locator,
    /// The server's clock, once synchronised.
    pub(super) clock: ClockSync,
    /// The newest known pose and its time by the robot's clock.
    pub(super) latest_pose: Option<(Instant, Pose)>,
    /// Whether the newest scan was dropped because its pose was unknown.
    pub(super) lost: bool,
    pub(super) map: LocalMap<'b>,
    pub(super) fused: FusedMap<'b>,
    pub(super) commands: Commands,
    pub(super) outbox: Outbox,
    pub(super) statistics: Statistics,
}

impl<'b> Mapper<'b> {
    /// The mapper of a freshly booted robot.
    #[inline(never)]
    pub(super) fn new<D: Drive>(
        config: &Config<D>,
        beams: &'b mut [Beam],
        scratch: &'b mut [RowSighting],
        own: &'b mut [OwnTile],
        fused: &'b mut [FusedTile],
    ) -> Self {
        let settings = config.settings();
        point_beams(beams, &settings);
        let Config { pose_source, odometry_noise, uncertainty_limit, .. } = config;
        Self {
            steadiness: Steadiness::new(config.steady),
            selection: Selection::new(config.policy, beams),
            locator: Locator::new(*pose_source, odometry_noise, *uncertainty_limit),
            clock: ClockSync::default(),
            latest_pose: None,
            lost: false,
            map: LocalMap::new((&settings).into(), beams, scratch, Pool::new(own)),
            fused: FusedMap::new(fused),
            commands: Commands::default(),
            outbox: Outbox::new(config.hold, config.vector_interval),
            statistics: Statistics::default(),
            beams,
            settings,
        }
    }

    /// Resets weak evidence in the map if that is due.
    pub(super) fn age(&mut self, now: Instant) {
        self.map.timeout(now, |id| self.fused.tile(id));
    }

    /// Whether the server has acknowledged everything mapped so far and has been sent the window of
    /// tiles that the robot wants.
    pub(super) fn is_idle(&self) -> bool {
        self.map.pool.tiles().all(|tile| !tile.is_dirty()) && self.fused.untold().is_none()
    }
}

/// Fills the table of beams, leaving out those that are never mapped.
pub(super) fn point_beams(beams: &mut [Beam], settings: &Settings) {
    fill_beams(beams, settings.sensor, settings.mounting);
    settings.removed.iter().flatten().for_each(|&removal| remove_beams(beams, removal));
}

//! One robot of a fleet, with its clock and its channel.

use ubimap_agent::{
    Config, ConfigError, Memory, Robot,
    drive::{DriveCommand, Driving},
};
use ubimap_protocol::{
    frame::DEFAULT_FRAME,
    tile::{TILE_SIDE, TileId},
    time::Instant,
    units::{Pose, RobotId},
};

use super::{
    body::{Body, Journal},
    grey_robot::Sight,
    heap::Heap,
    robot_clock::RobotClock,
};
use crate::{
    channel::fault::{FaultWire, Faults},
    deployment::PortId,
    report::{Comparison, Published},
};

/// A robot with its clock and its channel to a port of the deployment. Times count from the start
/// of the run.
pub struct Member<'b> {
    port: PortId,
    clock: RobotClock,
    body: Body<'b>,
    up: FaultWire,
    down: FaultWire,
    /// The robot's last drive command.
    commanded: DriveCommand,
    path: Vec<(Instant, Pose)>,
    published: Published,
    /// The robot's map traffic in bytes when `published` was last updated.
    bytes_noted: u64,
}

impl<'b> Member<'b> {
    /// A robot that has just booted; with a buffer, a machine ([`Body::new`]).
    pub(super) fn new(
        config: Config<Option<Driving>>,
        (memory, buffer): (&'b mut Memory<Heap, Option<Driving>>, Option<&'b mut [u16]>),
        sight: Option<Sight>,
        port: PortId,
        faults: Faults,
        seed: u64,
    ) -> Result<Self, ConfigError> {
        let id = config.robot;
        let wire = |way: u64| {
            FaultWire::new(faults, seed.wrapping_mul(0x1_0001) ^ u64::from(id.0) << 8 ^ way)
        };
        Ok(Self {
            port,
            clock: RobotClock::of(id, seed),
            body: Body::new(config, memory, buffer, sight)?,
            up: wire(1),
            down: wire(2),
            commanded: DriveCommand::STAND,
            path: Vec::new(),
            published: Published::default(),
            bytes_noted: 0,
        })
    }

    /// The robot's identifier.
    pub fn id(&self) -> RobotId {
        self.robot().settings().robot
    }

    /// The robot's port at the deployment.
    pub fn port(&self) -> PortId {
        self.port
    }

    /// The robot itself.
    pub fn robot(&self) -> &Robot<'b, Option<Driving>> {
        self.body.robot()
    }

    /// Calls `journal` with every input and output of a machine from now on.
    pub(super) fn keep_journal(&mut self, journal: Journal<'b>) {
        self.body.keep_journal(journal);
    }

    /// Time of the next delivery at either end of its channel, or of the robot's timeout.
    pub(super) fn poll_timeout(&self) -> Option<Instant> {
        let (local, devices) = self.body.poll_timeout();
        let robot = Some(self.clock.server(local));
        let measures = self.body.next_measurement();
        let channel = [self.up.next_delivery(), self.down.next_delivery()];
        channel.into_iter().chain([robot, devices, measures]).flatten().min()
    }

    /// The next frame that has arrived at the server by `now`.
    pub(super) fn poll_up(&mut self, now: Instant) -> Option<Vec<u8>> {
        self.up.poll(now)
    }

    /// Sends a frame to the robot.
    pub(super) fn send_down(&mut self, now: Instant, frame: &[u8]) {
        self.down.send(now, frame);
    }

    /// Delivers the frames that have arrived at the robot, and calls its `timeout`.
    pub(super) fn deliver(&mut self, now: Instant) {
        let local = self.clock.local(now);
        while let Some(bytes) = self.down.poll(now) {
            self.body.receive(&bytes, local);
        }
        self.body.timeout(local, now);
    }

    /// Passes a scan to the robot.
    pub(super) fn scan(&mut self, readings: &[u16], now: Instant) {
        let local = self.clock.local(now);
        self.body.scan(readings, local, now);
    }

    /// Passes a picture to the robot.
    pub(super) fn look(&mut self, picture: &[u8], now: Instant) {
        let local = self.clock.local(now);
        self.body.look(picture, local);
    }

    /// Appends an estimated pose to its path.
    pub(super) fn follow(&mut self, pose: Option<(Instant, Pose)>) {
        self.path.extend(pose);
    }

    /// Passes odometry to the robot.
    pub(super) fn odometry(&mut self, pose: Pose, now: Instant) {
        let local = self.clock.local(now);
        self.body.odometry(pose, local);
    }

    /// When the wheels of a machine measure next.
    pub(super) fn next_measurement(&self) -> Option<Instant> {
        self.body.next_measurement()
    }

    /// Passes what the wheels have measured to a machine.
    pub(super) fn measure(&mut self, (rolled, is_touching): ([f64; 2], bool), now: Instant) {
        self.body.measure(rolled, is_touching, now);
    }

    /// Writes the next frame into `frame` and sends it. Returns its length, or `None` if none is
    /// due.
    pub(super) fn poll_transmit(&mut self, now: Instant, frame: &mut [u8]) -> Option<usize> {
        let local = self.clock.local(now);
        let len = self.body.poll_transmit(local, &mut frame[..DEFAULT_FRAME]);
        match len {
            Some(len) => {
                self.up.send(now, &frame[..len]);
            }
            None => self.note_published(),
        }
        len
    }

    /// The drive command, if it has changed.
    pub(super) fn poll_command(&mut self) -> Option<DriveCommand> {
        let command = self.body.command();
        if command == self.commanded {
            return None;
        }
        self.commanded = command;
        Some(command)
    }

    /// Updates `published` if the robot has sent map data since the last call.
    fn note_published(&mut self) {
        let bytes_sent_map = self.robot().statistics().bytes_sent_map;
        if bytes_sent_map > self.bytes_noted {
            self.bytes_noted = bytes_sent_map;
            let tiles = self.body.robot().own_tiles().tiles();
            self.published
                .update(tiles.filter_map(|tile| Some((tile.id()?, tile.publication().sent()))));
        }
    }

    /// Whether at `now` the robot does not map a cell because the cameras cover it.
    pub fn is_left_to_cameras(&self, now: Instant, (x, y): (i32, i32)) -> bool {
        let Some(id) = TileId::of_cell(x, y) else { return false };
        let around = self.robot().fused_tiles().around(id, self.clock.local(now));
        let within = |cell: i32| cell.rem_euclid(TILE_SIDE as i32) as usize;
        around.covered.is_some_and(|rows| rows[within(y)] >> within(x) & 1 != 0)
    }

    /// Number of frames that the channel lost, both ways.
    pub fn frames_lost(&self) -> u64 {
        self.up.counters().lost + self.down.counters().lost
    }

    /// Traffic that the same map data would have caused in other formats.
    pub fn comparison(&self) -> Comparison {
        let mut comparison = self.published.cost();
        let mapped = self.robot().statistics().mapped.into();
        comparison.add_scans(mapped, self.robot().beams().len() as u64);
        comparison
    }

    /// The robot's estimated poses, with their times since the start of the run.
    pub fn path(&self) -> &[(Instant, Pose)] {
        &self.path
    }
}

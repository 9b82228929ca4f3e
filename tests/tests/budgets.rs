//! What a conversation costs on the wire.

use ubimap_agent::{Config, sense::SensorModel};
use ubimap_protocol::{
    time::{Duration, Instant},
    units::{Millimetres, RobotId},
};
use ubimap_sim_host::{
    channel::fault::Faults,
    run::fleet::{AgentMemory, Event, FUSED_TILES, Fleet, OWN_TILES, Stage},
};

/// A robot that does nothing until some moment.
struct Idle(Option<Instant>);

impl Stage for Idle {
    fn next_event(&self) -> Option<Instant> {
        self.0
    }

    fn poll(&mut self, _: Instant) -> Option<Event> {
        self.0 = None;
        None
    }
}

fn bytes_up_after(seconds: u64, faults: Faults) -> u64 {
    let model = SensorModel::Radial { first: -1.5, step: 0.1 };
    let config = Config::new(RobotId(1), model);
    let mut memory = [AgentMemory::new(&config, 30, OWN_TILES, FUSED_TILES)];
    let mut fleet = Fleet::new(&[config], &mut memory, faults, Millimetres(50), 1).unwrap();
    fleet.run(&mut Idle(Some(Instant(0) + Duration::from_secs(seconds))), |_| {});
    fleet.robots()[0].agent().statistics().bytes_sent
}

#[test]
fn an_idle_robot_sends_twenty_bytes_a_second_at_most() {
    let bad =
        Faults { loss: 0.3, duplicate: 0.05, reorder: 0.1, corrupt: 0.02, ..Faults::default() };
    for faults in [Faults::default(), bad] {
        // The first minute is for the clocks.
        let rate = (bytes_up_after(660, faults) - bytes_up_after(60, faults)) as f64 / 600.0;
        println!("an idle robot: {rate:.1} bytes/s up, loss {}", faults.loss);
        assert!(rate <= 20.0, "{rate} bytes/s");
    }
}

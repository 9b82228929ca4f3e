//! The commands for a robot at a port, against the unmodified image in the emulator with the rig's devices.
#![cfg(target_os = "linux")]

use std::{fs, path::Path, thread, time::Duration};

use clap::Parser;
use ubimap_sim_host::run::{
    bench::{
        param::{self, ParamOptions},
        ports::{self, Heard, PortsOptions},
        wheels::{self, WheelsOptions},
    },
    rig::{self, RigOptions},
};
use ubimap_tests::emulator::{Emulator, firmware, leave_out};

#[derive(Parser)]
struct Ports {
    #[command(flatten)]
    options: PortsOptions,
}

#[derive(Parser)]
struct Param {
    #[command(flatten)]
    options: ParamOptions,
}

#[derive(Parser)]
struct Wheels {
    #[command(flatten)]
    options: WheelsOptions,
}

#[derive(Parser)]
struct Rig {
    #[command(flatten)]
    options: RigOptions,
}

#[test]
#[ignore = "runs an image in the emulator: cargo real-time"]
fn a_board_whose_motor_is_wired_wrongly_is_understood_at_its_port() {
    let image = match firmware() {
        Ok(image) => image,
        Err(error) => return leave_out("the commands for a board", &error),
    };
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("board");
    let _ = fs::remove_dir_all(&folder);
    fs::create_dir_all(&folder).unwrap();
    let scenario = Path::new(env!("CARGO_MANIFEST_DIR")).join("../sim-host/scenarios/corner.toml");
    let (scenario, place) = (scenario.to_str().unwrap(), folder.to_str().unwrap());
    let line = ["rig", scenario, "--folder", place, "--robots", "1", "--fault", "1:left-motor"];
    let line = line.into_iter().chain(["--port", "0", "--duration", "75"]);
    let options = Rig::parse_from(line).options;
    let room = thread::spawn(move || rig::run(&options).map(|report| report.collisions));
    while !folder.join("robot-1.toml").exists() {
        thread::sleep(Duration::from_millis(100));
    }
    let device = |name: &str| folder.join(format!("robot-1-{name}"));
    let emulator = Emulator::start_between(&image, &device("sensor"), &device("wheels")).unwrap();
    let port = emulator.ports()[0].to_str().unwrap();

    let report = ports::run(&Ports::parse_from(["ports", port]).options).unwrap();
    let heard = &report.ports[0].heard;
    assert!(matches!(heard, Heard::Robot { robot: 1, versions: [1, 1], .. }), "{heard:?}");
    let get = Param::parse_from(["param", port, "get", "mounting-x"]).options;
    let text = param::run(&get).unwrap();
    assert!(text.starts_with("mounting-x = 100 mm"), "{text}");
    // A person has seen it turn to the left.
    let line = ["wheels", port, "--saw-ahead", "left", "--json"];
    let report = wheels::run(&Wheels::parse_from(line).options).unwrap();
    println!("{report}");
    assert!(report.to_string().contains("swap the two wires of the left motor"), "{report}");
    assert_eq!(room.join().unwrap().unwrap(), 0);
}

//! The image for the Raspberry Pi Pico in the emulator rp2040js, in Node.js: it writes the flash that it runs from, and
//! says Hello over USB.
//!
//! The boot ROM's routines, which erase and program, are stand-ins: see `rp2040js/boot.mjs`.

use std::{
    env,
    fs::{self, File},
    io::{Read, Write},
    net::TcpListener,
    path::{Path, PathBuf},
    process::{Child, Command, Output, Stdio},
    time::{Duration, Instant},
};

use clap::Parser;
use ubimap_agent::Parameter;
use ubimap_protocol::{
    frame::{Attempt, HELLO_CLEAR_LEN, Key, MAX_SEALED_HANDSHAKE, cobs::Decoder, open_hello},
    message::{ParameterAction, ParameterOutcome, ParameterValue},
    units::RobotId,
};
use ubimap_sim_host::run::bench::{options::PortOptions, session::Bench};
use ubimap_tests::emulator::{Core, EmulatorError, leave_out, pico_firmware, provision, rp2040js};

#[derive(Parser)]
struct Robot {
    #[command(flatten)]
    port: PortOptions,
}

/// Robots with a key of their own.
const ROBOTS: [u16; 2] = [7, 9];

#[test]
#[ignore = "runs an image in an emulator: cargo real-time"]
fn a_pico_keeps_its_identity_and_counts_its_boots_wherever_the_power_is_cut() {
    // `.ci/run` says so.
    if env::var_os("UBIMAP_NO_RP2040JS").is_some() {
        return;
    }
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("pico");
    let _ = fs::remove_dir_all(&folder);
    fs::create_dir_all(&folder).unwrap();
    let mut pico = match Pico::new(&folder) {
        Ok(pico) => pico,
        Err(error) => return leave_out("the image of a Pico in its emulator", &error),
    };

    let [seven, nine] = ROBOTS.map(|robot| pico.provisioned(robot));
    let first = pico.boot(&seven);
    assert_eq!((first.robot, first.writes), (7, 4), "an erasure, the record, its end, the boot");
    let second = pico.boot(&seven);
    assert_eq!(second, Said { boot: first.boot + 1, writes: 1, ..first });
    let update = pico.update.clone();
    let third = pico.boot(&update);
    assert_eq!(third, Said { boot: first.boot + 2, ..second });

    let kept = fs::read(&pico.flash).unwrap();
    for cut in 0..4 {
        fs::write(&pico.flash, &kept).unwrap();
        pico.cut(&nine, cut);
        let after = pico.boot(&update);
        assert!(ROBOTS.contains(&after.robot) && after.boot > third.boot, "{cut}: {after:?}");
        let again = pico.boot(&update);
        assert_eq!(again, Said { boot: after.boot + 1, writes: 1, ..after }, "{cut}");
        let new = pico.boot(&nine);
        assert!(new.robot == 9 && new.boot > again.boot, "{cut}: {new:?}");
        println!("cut at write {cut}: {after:?}, {again:?}, {new:?}");
    }

    // Parameters, which are stored while it runs.
    fs::write(&pico.flash, &kept).unwrap();
    let (hold, stored) = (Parameter::Hold as u16, Parameter::Stored as u16);
    let set = |parameter, value| ParameterAction::Set(ParameterValue { parameter, value });
    let value = |bench: &mut Bench, action| {
        let report = bench.parameter(action).unwrap();
        assert_eq!(report.outcome, ParameterOutcome::Done);
        report.values[0].value
    };
    let writes = pico.live(&update, "", |bench| {
        let store = [
            ParameterAction::Get(stored),
            set(hold, 300),
            ParameterAction::Get(stored),
            set(stored, 1),
        ];
        assert_eq!(store.map(|action| value(bench, action)), [1, 300, 0, 1]);
    });
    assert_eq!(writes, 5, "the boot; an erasure, the record, its end, a boot number");
    // The power is cut while others are stored.
    let writes = pico.live(&update, "2", |bench| {
        assert_eq!(value(bench, ParameterAction::Get(hold)), 300);
        assert_eq!(value(bench, set(hold, 400)), 400);
        bench.parameter(set(stored, 1)).unwrap_err();
    });
    assert_eq!(writes, 3);
    pico.live(&update, "", |bench| assert_eq!(value(bench, ParameterAction::Get(hold)), 300));
    let last = pico.boot(&update);
    assert!(last.robot == 7 && last.boot > third.boot + 3, "{last:?}");
    assert_eq!(pico.flood(&update), 1);
}

/// What a robot says in a Hello that its key opens, and how often it wrote its flash before.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Said {
    robot: u16,
    boot: u32,
    writes: usize,
}

struct Pico {
    /// The emulator's.
    script: PathBuf,
    folder: PathBuf,
    /// The content of its flash.
    flash: PathBuf,
    /// The image as it is built.
    image: PathBuf,
    /// The same as a UF2 file that is not provisioned.
    update: PathBuf,
}

impl Pico {
    /// A Pico with erased flash.
    fn new(folder: &Path) -> Result<Self, EmulatorError> {
        let script = rp2040js()?;
        let [image, flash, update] = ["image", "flash", "update.uf2"].map(|it| folder.join(it));
        // Another test builds images with other features at the same place.
        fs::copy(pico_firmware(Core::M0)?, &image).unwrap();
        fs::write(&flash, []).unwrap();
        let pico = Self { script, folder: folder.to_owned(), flash, image, update };
        let [image, update] = [&pico.image, &pico.update].map(|it| it.to_str().unwrap());
        provision(&[image, "--out", update]);
        Ok(pico)
    }

    /// A UF2 file of the image for a robot with a key.
    fn provisioned(&self, robot: u16) -> PathBuf {
        let [key, out] = ["key", "uf2"].map(|kind| self.folder.join(format!("{robot}.{kind}")));
        fs::write(&key, format!("{:032x}\n", u128::from(robot))).unwrap();
        #[cfg(unix)]
        for (path, mode) in [(&key, 0o600), (&self.folder, 0o700)] {
            use std::os::unix::fs::PermissionsExt;
            fs::set_permissions(path, fs::Permissions::from_mode(mode)).unwrap();
        }
        let [image, key, file] = [&self.image, &key, &out].map(|it| it.to_str().unwrap());
        let robot = robot.to_string();
        provision(&[image, "--id", &robot, "--key", key, "--out", file]);
        out
    }

    /// Flashes an image and boots it for some frames.
    fn boot(&mut self, image: &Path) -> Said {
        let output = self.run(image, "");
        let (stdout, writes) = (&output.stdout, writes(&output));
        let mut decoder = Decoder::<MAX_SEALED_HANDSHAKE>::default();
        let hello = decoder.next(&mut &stdout[..]).expect("the robot says nothing").unwrap();
        let (clear, sealed) = hello.split_first_chunk_mut::<HELLO_CLEAR_LEN>().unwrap();
        let (text, tag) = sealed.split_last_chunk_mut().unwrap();
        let robot = u16::from_le_bytes(*clear[2..].first_chunk().unwrap());
        let boot = u32::from_le_bytes(*clear[4..].first_chunk().unwrap());
        let clock = u64::from_le_bytes(*clear[8..].first_chunk().unwrap());
        let (key, attempt) = (Key::new(u128::from(robot).to_be_bytes()), Attempt { boot, clock });
        assert!(
            open_hello(&key, RobotId(robot), attempt, clear, (text, tag)),
            "{robot}, {attempt:?}"
        );
        Said { robot, boot, writes }
    }

    /// Flashes an image, boots it, and speaks to it as `ubimap param` does; the power may be cut during a
    /// write. Returns the number of writes.
    fn live(&mut self, image: &Path, cut: &str, speak: impl FnOnce(&mut Bench)) -> usize {
        // Nobody else takes it meanwhile.
        let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let node = self.node_at(port, image, cut);
        let (address, keys) = (format!("tcp:127.0.0.1:{port}"), self.folder.to_str().unwrap());
        let options = Robot::parse_from(["robot", &address, "--keys", keys]).port;
        let mut bench = Bench::open(&options).unwrap();
        assert_eq!(bench.wait_for_robot().unwrap(), RobotId(7));
        speak(&mut bench);
        drop(bench);
        writes(&node.wait_with_output().unwrap())
    }

    /// Flashes an image, boots it, and sends it more than it can hold, as fast as USB takes it: it goes on to say
    /// Hello, and its watchdog does not reset it. Returns the number of writes.
    fn flood(&mut self, image: &Path) -> usize {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let node = self.node_at(listener.local_addr().unwrap().port(), image, "");
        let (mut usb, _) = listener.accept().unwrap();
        usb.write_all(&[0x55; 100_000]).unwrap();
        let (began, mut bytes) = (Instant::now(), [0; 512]);
        while began.elapsed() < Duration::from_secs(5) {
            assert!(usb.read(&mut bytes).unwrap() > 0, "the robot has ended");
        }
        drop(usb);
        writes(&node.wait_with_output().unwrap())
    }

    /// Starts the emulator with an image, whose USB comes to this port.
    fn node_at(&self, port: u16, image: &Path, cut: &str) -> Child {
        let mut node = self.node(image, &["600", cut, &port.to_string()]);
        node.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
    }

    /// Flashes an image and boots it; the power is cut during a write.
    fn cut(&mut self, image: &Path, write: usize) {
        let output = self.run(image, &write.to_string());
        writes(&output);
        assert!(output.stdout.is_empty(), "the robot spoke before it wrote");
    }

    fn run(&self, image: &Path, cut: &str) -> Output {
        self.node(image, &["0.35", cut]).output().unwrap()
    }

    /// The emulator with an image and its other arguments.
    fn node(&self, image: &Path, arguments: &[&str]) -> Command {
        let mut node = Command::new("node");
        node.arg(&self.script).arg(&self.flash).args(arguments).stdin(File::open(image).unwrap());
        node
    }
}

/// The number of writes that the emulator has told at its end.
fn writes(output: &Output) -> usize {
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
    said.trim().strip_prefix("writes: ").unwrap().parse().unwrap()
}

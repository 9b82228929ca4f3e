//! The image for the Raspberry Pi Pico in the emulator rp2040js, in Node.js: it writes the flash that it runs from, and
//! says Hello over USB.
//!
//! The boot ROM's routines, which erase and program, are stand-ins: see `rp2040js/boot.mjs`.

use std::{
    env,
    fs::{self, File},
    io,
    path::{Path, PathBuf},
    process::{Command, Output},
};

use clap::Parser;
use ubimap_protocol::{
    frame::{Attempt, HELLO_CLEAR_LEN, Key, MAX_SEALED_HANDSHAKE, cobs::Decoder, open_hello},
    units::RobotId,
};
use ubimap_sim_host::run::provision::{self, ProvisionOptions};
use ubimap_tests::emulator::{Core, EmulatorError, leave_out, pico_firmware};

#[derive(Parser)]
struct CommandLine {
    #[command(flatten)]
    options: ProvisionOptions,
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
}

/// What a robot says in a Hello that its key opens, and how often it wrote its flash before.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Said {
    robot: u16,
    boot: u32,
    writes: usize,
}

struct Pico {
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
        let emulator = Path::new(env!("CARGO_MANIFEST_DIR")).join("rp2040js");
        if !emulator.join("node_modules").is_dir() {
            return Err(EmulatorError::Missing("rp2040js (npm ci --prefix tests/rp2040js)"));
        }
        if let Err(error) = Command::new("node").arg("--version").output() {
            assert_eq!(error.kind(), io::ErrorKind::NotFound, "node: {error}");
            return Err(EmulatorError::Missing("node"));
        }
        let [image, flash, update] = ["image", "flash", "update.uf2"].map(|it| folder.join(it));
        // Another test builds images with other features at the same place.
        fs::copy(pico_firmware(Core::M0)?, &image).unwrap();
        fs::write(&flash, []).unwrap();
        let pico = Self { folder: folder.to_owned(), flash, image, update };
        let [image, update] = [&pico.image, &pico.update].map(|it| it.to_str().unwrap());
        provision(&[image, "--out", update]);
        Ok(pico)
    }

    /// A UF2 file of the image for a robot with a key.
    fn provisioned(&self, robot: u16) -> PathBuf {
        let [key, out] = ["key", "uf2"].map(|kind| self.folder.join(format!("{robot}.{kind}")));
        fs::write(&key, format!("{:032x}\n", u128::from(robot))).unwrap();
        #[cfg(unix)]
        {
            use std::os::unix::fs::PermissionsExt;
            fs::set_permissions(&key, fs::Permissions::from_mode(0o600)).unwrap();
        }
        let [image, key, file] = [&self.image, &key, &out].map(|it| it.to_str().unwrap());
        let robot = robot.to_string();
        provision(&[image, "--id", &robot, "--key", key, "--out", file]);
        out
    }

    /// Flashes an image and boots it for some frames.
    fn boot(&mut self, image: &Path) -> Said {
        let Output { stdout, stderr, .. } = self.run(image, "");
        let said = String::from_utf8(stderr).unwrap();
        let writes = said.trim().strip_prefix("writes: ").unwrap().parse().unwrap();
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

    /// Flashes an image and boots it; the power is cut during a write.
    fn cut(&mut self, image: &Path, write: usize) {
        let Output { stdout, .. } = self.run(image, &write.to_string());
        assert!(stdout.is_empty(), "the robot spoke before it wrote");
    }

    fn run(&self, image: &Path, cut: &str) -> Output {
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("rp2040js/boot.mjs");
        let mut node = Command::new("node");
        node.arg(script).arg(&self.flash).args(["0.35", cut]);
        let output = node.stdin(File::open(image).unwrap()).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        output
    }
}

/// `ubimap provision` with these arguments.
fn provision(arguments: &[&str]) {
    let line = ["provision"].into_iter().chain(arguments.iter().copied());
    provision::run(&CommandLine::parse_from(line).options).unwrap();
}

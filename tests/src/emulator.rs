//! Builds the firmware for the reference board and runs it in QEMU.
//!
//! [`image`] builds an image. [`Emulator::start`] runs it with its serial ports on pseudo-terminals, in real time,
//! [`in_step`] is the command that runs it in the time of a simulation,
//! [`count`] runs an image that counts instructions until it ends, and [`replay`] the image that
//! replays a journal. If the tools are missing, [`leave_out`] prints one line, or fails if `CI` or
//! `UBIMAP_REQUIRE_EMULATOR` is set.

use std::{
    env, fmt, fs,
    io::{self, BufRead, BufReader, Read, Write},
    os::unix::net::UnixStream,
    path::{Path, PathBuf},
    process::{self, Child, Command, Stdio},
    sync::{
        OnceLock,
        atomic::{AtomicU32, Ordering},
        mpsc,
    },
    thread,
    time::Duration,
};

use clap::Parser;
use ubimap_sim_host::run::provision::{self, ProvisionOptions};

use crate::elf::Image;

/// The core for which an image is built; the emulated Cortex-M4 runs images for a Cortex-M0+ as well.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Core {
    /// The reference board's Cortex-M4 with floating point.
    M4,
    /// A Cortex-M0+, without division instructions or floating point.
    M0,
    /// A Cortex-M33 with floating point.
    M33,
    /// A 32-bit RISC-V without floating point.
    RiscV,
}

impl Core {
    /// The compiler's target.
    fn target(self) -> &'static str {
        match self {
            Self::M4 => "thumbv7em-none-eabihf",
            Self::M0 => "thumbv6m-none-eabi",
            Self::M33 => "thumbv8m.main-none-eabihf",
            Self::RiscV => "riscv32imac-unknown-none-elf",
        }
    }

    /// The agent's features that an image needs.
    fn features(self) -> &'static str {
        match self {
            Self::M4 => "firmware",
            Self::M0 => "cortex",
            Self::M33 | Self::RiscV => "player",
        }
    }

    /// The emulator, with the arguments that choose its machine.
    fn machine(self) -> (&'static str, &'static [&'static str]) {
        match self {
            Self::M4 | Self::M0 => ("qemu-system-arm", &["-M", "netduinoplus2"]),
            Self::M33 => ("qemu-system-arm", &["-M", "mps2-an505"]),
            Self::RiscV => ("qemu-system-riscv32", &["-M", "virt", "-bios", "none"]),
        }
    }
}

/// Timeout for the emulator to name its serial port.
const START_TIMEOUT: Duration = Duration::from_secs(30);

/// Why the firmware can't run here.
#[derive(Clone, Debug)]
pub enum EmulatorError {
    /// A tool is missing.
    Missing(&'static str),
    /// A tool failed, with its output.
    Failed(String),
}

impl fmt::Display for EmulatorError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Missing(what) => write!(f, "{what} is missing"),
            Self::Failed(said) => write!(f, "failed: {said}"),
        }
    }
}

impl std::error::Error for EmulatorError {}

/// Prints one line that a test was skipped because a tool is missing.
///
/// # Panics
///
/// If a tool failed, or if the emulator is required.
pub fn leave_out(test: &str, error: &EmulatorError) {
    let must = ["CI", "UBIMAP_REQUIRE_EMULATOR"].iter().any(|name| env::var_os(name).is_some());
    assert!(!must && matches!(error, EmulatorError::Missing(_)), "{test}: {error}");
    // Not `eprintln`, whose output the test harness captures.
    let _ = writeln!(io::stderr(), "skipped: {test}: {error}");
}

/// The firmware image, built on first use.
pub fn firmware() -> Result<PathBuf, EmulatorError> {
    static IMAGE: OnceLock<Result<PathBuf, EmulatorError>> = OnceLock::new();
    IMAGE.get_or_init(|| image("firmware", Core::M4)).clone()
}

/// Runs an image that counts instructions (one per nanosecond of its clock) until it ends. `input`
/// is sent to its serial port after its first line of output. Returns the output.
pub fn count(image: &Path, input: Vec<u8>) -> Result<String, EmulatorError> {
    let mut qemu = qemu(Core::M4, image)
        .args(["-chardev", "stdio,id=input,signal=off", "-serial", "chardev:input"])
        .args([
            "-monitor",
            "none",
            "-icount",
            "shift=0",
            "-semihosting-config",
            "enable=on,target=native",
        ])
        .stdin(Stdio::piped())
        .spawn()
        .map_err(|error| missing_or_failed(Core::M4, &error))?;
    let mut port = qemu.stdin.take();
    let mut said = String::new();
    for line in qemu.stdout.take().into_iter().flat_map(|out| BufReader::new(out).lines()) {
        said.extend([&line.map_err(|error| missing_or_failed(Core::M4, &error))?, "\n"]);
        if let Some(mut port) = port.take() {
            let input = input.clone();
            // The image may end before it has read everything.
            thread::spawn(move || port.write_all(&input));
        }
    }
    let output = qemu.wait_with_output().map_err(|error| missing_or_failed(Core::M4, &error))?;
    said.push_str(&String::from_utf8_lossy(&output.stderr));
    if output.status.success() { Ok(said) } else { Err(EmulatorError::Failed(said)) }
}

/// Runs the image that replays the file `journal` of a folder, with one instruction per nanosecond of
/// its clock. Returns its output.
pub fn replay(core: Core, folder: &Path) -> Result<String, EmulatorError> {
    let features = match core {
        Core::M4 | Core::M0 => "cortex,player",
        Core::M33 | Core::RiscV => "player",
    };
    let image = built("journal", core, features)?;
    let output = qemu(core, &image)
        .args(["-monitor", "none", "-serial", "none", "-icount", "shift=0"])
        .args(["-semihosting-config", "enable=on,target=native"])
        .current_dir(folder)
        .stdin(Stdio::null())
        .output()
        .map_err(|error| missing_or_failed(core, &error))?;
    let said = [output.stdout, output.stderr].concat();
    let said = String::from_utf8_lossy(&said).into_owned();
    if output.status.success() { Ok(said) } else { Err(EmulatorError::Failed(said)) }
}

/// The lines of a printed table: each count with its name.
pub fn lines(table: &str) -> impl Iterator<Item = (u64, &str)> {
    table.lines().filter_map(|line| {
        let (number, name) = line.trim().split_once("  ")?;
        Some((number.parse().ok()?, name))
    })
}

/// A running firmware; dropping it stops the emulator.
#[derive(Debug)]
pub struct Emulator {
    qemu: Child,
    ports: [PathBuf; 3],
    /// The socket of the emulator's command line.
    monitor: PathBuf,
}

/// The board's RAM: its first address and its size in bytes.
const RAM: (usize, usize) = (0x2000_0000, 0x2_0000);

/// The emulator's USARTs 1 to 6: those that the firmware of the Feather uses are pseudo-terminals.
const USARTS: [&str; 6] = ["pty", "null", "pty", "null", "null", "pty"];

impl Emulator {
    /// Runs an image.
    pub fn start(image: &Path) -> Result<Self, EmulatorError> {
        Self::start_with(image, USARTS)
    }

    /// Runs an image whose depth sensor and wheels are at these devices, already there. Only its port to the
    /// server is a new pseudo-terminal.
    pub fn start_between(
        image: &Path,
        sensor: &Path,
        wheels: &Path,
    ) -> Result<Self, EmulatorError> {
        // The emulator takes names of devices, not links to them.
        let device = |link: &Path| {
            let device = fs::canonicalize(link);
            device
                .map(|device| device.display().to_string())
                .map_err(|error| EmulatorError::Failed(format!("{}: {error}", link.display())))
        };
        let (sensor, wheels) = (device(sensor)?, device(wheels)?);
        let mut usarts = USARTS;
        (usarts[0], usarts[5]) = (&wheels, &sensor);
        Self::start_with(image, usarts)
    }

    fn start_with(image: &Path, usarts: [&str; 6]) -> Result<Self, EmulatorError> {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let number = COUNT.fetch_add(1, Ordering::Relaxed);
        let name = format!("ubimap-emulator-{}-{number}", process::id());
        // A socket's path is short.
        let monitor = env::temp_dir().join(name);
        let mut qemu = qemu(Core::M4, image)
            .args(usarts.iter().flat_map(|usart| ["-serial", usart]))
            .args(["-monitor", &format!("unix:{},server=on,wait=off", monitor.display())])
            .stdin(Stdio::null())
            .spawn()
            .map_err(|error| missing_or_failed(Core::M4, &error))?;
        let said = qemu.stdout.take();
        // From here on, dropping the value stops the emulator.
        let mut emulator = Self { qemu, ports: Default::default(), monitor };
        let (found, named) = mpsc::channel();
        thread::spawn(move || {
            // Keeps reading, so that further output does not block the emulator.
            for line in said.into_iter().flat_map(|out| BufReader::new(out).lines()).flatten() {
                if let Some(path) = pseudo_terminal(&line) {
                    let _ = found.send(PathBuf::from(path));
                }
            }
        });
        // In the order of their numbers.
        for (usart, port) in [(0, 2), (2, 0), (5, 1)] {
            if usarts[usart] != "pty" {
                emulator.ports[port] = usarts[usart].into();
                continue;
            }
            match named.recv_timeout(START_TIMEOUT) {
                Ok(path) => emulator.ports[port] = path,
                Err(_) => {
                    let said = emulator.last_words();
                    return Err(EmulatorError::Failed(format!("the emulator: {said}")));
                }
            }
        }
        Ok(emulator)
    }

    /// The robot's serial ports to the server, the depth sensor and the wheels.
    pub fn ports(&self) -> &[PathBuf; 3] {
        &self.ports
    }

    /// Resets the board; its memory keeps its contents.
    ///
    /// # Errors
    /// The emulator has ended.
    pub fn reset(&self) -> io::Result<()> {
        self.command("system_reset")
    }

    /// Maximum depth of the stack so far, in bytes. `image` is the one that runs.
    ///
    /// # Errors
    /// The emulator has ended.
    pub fn stack(&self, image: &Image) -> io::Result<usize> {
        let (first, size) = RAM;
        let path = self.monitor.with_extension("ram");
        self.command(&format!("pmemsave {first:#x} {size:#x} \"{}\"", path.display()))?;
        let memory = fs::read(&path)?;
        fs::remove_file(path)?;
        // The emulator's memory is zero at the start, and the stack grows down to the statics.
        let free = memory.iter().skip(image.ram).take_while(|&&byte| byte == 0).count();
        Ok(memory.len() - image.ram - free)
    }

    /// Types a command and waits for the next prompt.
    fn command(&self, command: &str) -> io::Result<()> {
        let mut monitor = UnixStream::connect(&self.monitor)?;
        monitor.set_read_timeout(Some(START_TIMEOUT))?;
        monitor.write_all(format!("{command}\n").as_bytes())?;
        let mut said = String::new();
        let mut bytes = [0; 512];
        while said.matches("(qemu) ").count() < 2 {
            let count = monitor.read(&mut bytes)?;
            if count == 0 {
                return Err(io::ErrorKind::UnexpectedEof.into());
            }
            said.push_str(&String::from_utf8_lossy(&bytes[..count]));
        }
        Ok(())
    }

    fn last_words(&mut self) -> String {
        let _ = self.qemu.kill();
        let mut said = String::new();
        if let Some(mut errors) = self.qemu.stderr.take() {
            let _ = errors.read_to_string(&mut said);
        }
        said
    }
}

impl Drop for Emulator {
    fn drop(&mut self) {
        let _ = self.qemu.kill();
        let _ = self.qemu.wait();
        let _ = fs::remove_file(&self.monitor);
    }
}

/// The emulator with this image and piped output.
fn qemu(core: Core, image: &Path) -> Command {
    let (program, machine) = core.machine();
    let mut qemu = Command::new(program);
    qemu.args(machine).args(["-display", "none", "-kernel"]);
    qemu.arg(image).stdout(Stdio::piped()).stderr(Stdio::piped());
    qemu
}

fn missing_or_failed(core: Core, error: &io::Error) -> EmulatorError {
    let (program, _) = core.machine();
    match error.kind() {
        io::ErrorKind::NotFound => EmulatorError::Missing(program),
        _ => EmulatorError::Failed(format!("{program}: {error}")),
    }
}

/// The path in `char device redirected to /dev/pts/3 (label serial0)`.
fn pseudo_terminal(line: &str) -> Option<&str> {
    line.strip_prefix("char device redirected to ")?.split_whitespace().next()
}

/// Copies an image, because the firmware with other features is built at the same place.
fn copied(image: PathBuf, folder: &Path) -> Result<PathBuf, EmulatorError> {
    let copy = folder.join("firmware");
    let copied = fs::copy(image, &copy).map_err(|error| missing_or_failed(Core::M4, &error));
    copied.map(|_| copy)
}

/// The command for `simulate --in-step` that runs the firmware, from a folder of its own. It writes a journal to a file,
/// if one is given. An instruction takes 8 ns: some 1.3 cycles, as flash and memory are slower than the core.
///
/// # Errors
/// The image can't be built.
pub fn in_step(folder: &Path, journal: Option<&Path>) -> Result<String, EmulatorError> {
    let features = if journal.is_some() { "in-step,journal" } else { "in-step" };
    let image = copied(built("firmware", Core::M4, features)?, folder)?;
    // UART4 is the fourth.
    let journal = journal.map(|file| format!("-serial file:'{}'", file.display()));
    let journal = journal.map_or("-serial none".into(), |port| "-serial null ".repeat(3) + &port);
    let (program, machine) = Core::M4.machine();
    let missing = || EmulatorError::Missing(program);
    printed(Path::new(program), &["--version"]).ok_or_else(missing)?;
    Ok(format!(
        "{program} {} -display none -monitor none {journal} -icount shift=3,sleep=off \
         -semihosting-config enable=on,target=native -kernel '{}'",
        machine.join(" "),
        image.display()
    ))
}

/// Builds one of the agent's images.
pub fn image(name: &str, core: Core) -> Result<PathBuf, EmulatorError> {
    built(name, core, core.features())
}

/// Builds one of the agent's images for the M4 with sealed links, which the images for boards do
/// without.
pub fn sealed_image(name: &str) -> Result<PathBuf, EmulatorError> {
    built(name, Core::M4, "firmware,seals")
}

/// The firmware that takes its number, key and parameters from flash, in a folder of its own.
pub fn provisionable_firmware(folder: &Path) -> Result<PathBuf, EmulatorError> {
    copied(built("firmware", Core::M4, "flash")?, folder)
}

/// The firmware for the Raspberry Pi Pico (`M0`), for [`rp2040js`], or Pico 2 (`M33`), which no emulator here runs.
pub fn pico_firmware(core: Core) -> Result<PathBuf, EmulatorError> {
    built("firmware", core, if core == Core::M0 { "pico" } else { "pico2" })
}

#[derive(Parser)]
struct Provision {
    #[command(flatten)]
    options: ProvisionOptions,
}

/// Does what `ubimap provision` does with these arguments.
///
/// # Panics
/// If it fails.
pub fn provision(arguments: &[&str]) {
    let line = ["provision"].iter().chain(arguments);
    provision::run(&Provision::parse_from(line).options).expect("the image is provisioned");
}

/// The script that boots the image of a Pico in rp2040js.
///
/// # Errors
/// [`EmulatorError::Missing`]: Node.js or rp2040js is not installed.
pub fn rp2040js() -> Result<PathBuf, EmulatorError> {
    let folder = workspace().join("tests/rp2040js");
    if !folder.join("node_modules").is_dir() {
        return Err(EmulatorError::Missing("rp2040js (npm ci --prefix tests/rp2040js)"));
    }
    match Command::new("node").arg("--version").output() {
        Ok(_) => Ok(folder.join("boot.mjs")),
        Err(_) => Err(EmulatorError::Missing("node")),
    }
}

fn built(name: &str, core: Core, features: &str) -> Result<PathBuf, EmulatorError> {
    let target = core.target();
    let mut cargo = compiler(target)?;
    let output = cargo
        .args(["--locked", "--package", "ubimap-agent", "--bin", name])
        .args([
            "--no-default-features",
            "--features",
            features,
            "--target",
            target,
            "--profile",
            "firmware",
        ])
        .arg("--message-format=json-render-diagnostics")
        .current_dir(workspace())
        // Compiler flags for the host do not apply to the board, and would replace those of
        // `.cargo/config.toml`.
        .env_remove("RUSTFLAGS")
        .env_remove("CARGO_ENCODED_RUSTFLAGS")
        .stdin(Stdio::null())
        .output()
        .map_err(|error| EmulatorError::Failed(format!("cargo: {error}")))?;
    if !output.status.success() {
        return Err(EmulatorError::Failed(String::from_utf8_lossy(&output.stderr).into_owned()));
    }
    output
        .stdout
        .split(|&byte| byte == b'\n')
        .filter_map(|line| serde_json::from_slice::<serde_json::Value>(line).ok())
        .find_map(|message| message["executable"].as_str().map(PathBuf::from))
        .ok_or_else(|| EmulatorError::Failed("cargo did not report an executable".into()))
}

/// A `cargo build` for the board's target. Uses the current toolchain if it has the target,
/// otherwise Debian's, which includes the sources of `core`.
fn compiler(target: &'static str) -> Result<Command, EmulatorError> {
    let rustc = env::var_os("RUSTC").unwrap_or_else(|| "rustc".into());
    if printed(Path::new(&rustc), &["--print", "target-libdir", "--target", target])
        .is_some_and(|folder| Path::new(&folder).is_dir())
    {
        let mut cargo = Command::new(env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
        cargo.arg("build");
        return Ok(cargo);
    }

    let (rustc, cargo) = (Path::new("/usr/bin/rustc"), Path::new("/usr/bin/cargo"));
    let has_sources = printed(rustc, &["--print", "sysroot"])
        .is_some_and(|root| Path::new(&root).join("lib/rustlib/src/rust/library/core").is_dir());
    if !has_sources || !cargo.is_file() {
        return Err(EmulatorError::Missing(target));
    }
    let linker = ["rust-lld", "ld.lld"]
        .into_iter()
        .find(|name| printed(Path::new(name), &["-flavor", "gnu", "--version"]).is_some())
        .or_else(|| printed(Path::new("ld.lld"), &["--version"]).map(|_| "ld.lld"))
        .ok_or(EmulatorError::Missing("the linker ld.lld"))?;
    let mut command = Command::new(cargo);
    command
        .args(["build", "-Zbuild-std=core", "--target-dir"])
        .arg(workspace().join("target/firmware-debian"))
        .env("RUSTC", rustc)
        .env("RUSTC_BOOTSTRAP", "1")
        .env("CARGO_TARGET_THUMBV7EM_NONE_EABIHF_LINKER", linker)
        .env("CARGO_TARGET_THUMBV6M_NONE_EABI_LINKER", linker)
        .env("CARGO_TARGET_THUMBV8M_MAIN_NONE_EABIHF_LINKER", linker)
        .env("CARGO_TARGET_RISCV32IMAC_UNKNOWN_NONE_ELF_LINKER", linker);
    Ok(command)
}

/// A program's output, or `None` if it is missing or failed.
fn printed(program: &Path, arguments: &[&str]) -> Option<String> {
    let output = Command::new(program).args(arguments).stdin(Stdio::null()).output().ok()?;
    output.status.success().then(|| String::from_utf8_lossy(&output.stdout).trim().to_owned())
}

fn workspace() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().map(Path::to_path_buf).unwrap_or_default()
}

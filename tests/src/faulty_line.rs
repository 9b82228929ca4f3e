//! A serial line between a robot in the emulator and a program, which a test can cut or disturb.

use std::{
    io::{self, Read, Write},
    path::{Path, PathBuf},
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicBool, AtomicU8, Ordering},
    },
    thread::{self, JoinHandle},
    time::{Duration, Instant},
};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serialport::{SerialPort, TTYPort};

/// What a line does with the bytes of both directions.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LineState {
    /// Passes them.
    Whole = 0,
    /// Loses them.
    Cut = 1,
    /// Loses them, and delivers random bytes at the speed of the line instead.
    Noisy = 2,
}

/// Bytes per millisecond of a noisy line: 115,200 baud.
const NOISE: usize = 11;

/// Time between two looks at both ends.
const PERIOD: Duration = Duration::from_micros(500);

/// The bytes of a robot with the times at which they left it.
pub type Spoken = Vec<(Instant, Vec<u8>)>;

/// A line whose far end is a pseudo-terminal.
pub struct FaultyLine {
    path: PathBuf,
    shared: Arc<Shared>,
    carrier: Option<JoinHandle<()>>,
}

#[derive(Default)]
struct Shared {
    state: AtomicU8,
    has_ended: AtomicBool,
    spoken: Mutex<Spoken>,
}

impl FaultyLine {
    /// A line from the port of a robot; `seed` is that of its noise.
    ///
    /// # Errors
    /// There is no such port, or no pseudo-terminal.
    pub fn new(robot: &Path, seed: u64) -> serialport::Result<Self> {
        let mut robot = serialport::new(robot.to_string_lossy(), 115_200).open_native()?;
        // The far end is closed here, since it is open exclusively.
        let (mut near, far) = TTYPort::pair()?;
        let name = far.name().ok_or_else(|| io::Error::other("the pseudo-terminal has no name"))?;
        // Neither waits: a line loses what is not taken.
        robot.set_timeout(Duration::ZERO)?;
        near.set_timeout(Duration::ZERO)?;
        let shared = Arc::new(Shared::default());
        let carried = Arc::clone(&shared);
        let carrier = thread::spawn(move || carry(robot, near, &carried, seed));
        drop(far);
        Ok(Self { path: name.into(), shared, carrier: Some(carrier) })
    }

    /// The path of the far end.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Cuts, disturbs or mends the line.
    pub fn set(&self, state: LineState) {
        self.shared.state.store(state as u8, Ordering::Release);
    }

    /// What the robot has sent so far.
    pub fn spoken(&self) -> Spoken {
        self.shared.spoken.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

impl Drop for FaultyLine {
    fn drop(&mut self) {
        self.shared.has_ended.store(true, Ordering::Release);
        if let Some(carrier) = self.carrier.take() {
            let _ = carrier.join();
        }
    }
}

/// Moves bytes until the line ends.
fn carry(mut robot: TTYPort, mut near: TTYPort, shared: &Shared, seed: u64) {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut bytes = [0; 512];
    let mut last_noise = Instant::now();
    while !shared.has_ended.load(Ordering::Acquire) {
        let state = shared.state.load(Ordering::Acquire);
        // An end that is closed at the moment has nothing to say.
        let up = robot.read(&mut bytes).unwrap_or_default();
        if up > 0 {
            let mut spoken = shared.spoken.lock().unwrap_or_else(PoisonError::into_inner);
            spoken.push((Instant::now(), bytes[..up].to_vec()));
        }
        if state == LineState::Whole as u8 {
            let _ = near.write_all(&bytes[..up]);
        }
        let down = near.read(&mut bytes).unwrap_or_default();
        if state == LineState::Whole as u8 {
            let _ = robot.write_all(&bytes[..down]);
        }
        if state == LineState::Noisy as u8 {
            let passed = last_noise.elapsed().as_millis().min(20) as usize;
            for port in [&mut robot, &mut near] {
                let noise: Vec<u8> = (0..passed * NOISE).map(|_| rng.random()).collect();
                let _ = port.write_all(&noise);
            }
            if passed > 0 {
                last_noise = Instant::now();
            }
        }
        if up + down == 0 {
            thread::sleep(PERIOD);
        }
    }
}

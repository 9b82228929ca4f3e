//! Random numbers: an independent stream for each user, so that removing one robot does not change the
//! noise of the others.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

/// The user of a stream; the streams of each kind are numbered.
#[derive(Clone, Copy)]
pub(super) enum Stream {
    Camera = 1,
    Person = 2,
    Odometry = 3,
    Scan = 4,
    Frame = 5,
    Eye = 6,
    Wheels = 7,
}

impl Stream {
    /// The random numbers of this user with this number, from the beginning.
    pub(super) fn rng(self, seed: u64, number: usize) -> ChaCha8Rng {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream((self as u64) << 32 | number as u64);
        rng
    }
}

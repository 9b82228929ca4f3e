//! The memory that a robot borrows.

use core::fmt;

use super::{
    bounds::Bounds,
    config::{ConfigError, Part},
};
use crate::{
    drive::{Drive, NoDrive},
    map::{OwnTile, RowSighting},
    sense::Beam,
    share::FusedTile,
};

/// The containers of a [`Memory`]: arrays ([`Arrays`]), or vectors on a machine with a heap.
pub trait Storage {
    /// One element per reading of a scan.
    type Beams: AsMut<[Beam]>;
    /// The readings of all waiting scans.
    type Waiting: AsMut<[u16]>;
    /// [`Bounds::scratch`] words.
    type Scratch: AsMut<[RowSighting]>;
    /// The pool of the robot's own tiles.
    type Own: AsMut<[OwnTile]>;
    /// The pool of fused tiles.
    type Fused: AsMut<[FusedTile]>;
}

/// Arrays of fixed size, for a `static`. The const parameters are their lengths, which
/// [`memory!`](crate::memory) computes from [`Bounds`].
#[derive(Debug)]
pub struct Arrays<
    const READINGS: usize,
    const WAITING: usize,
    const SCRATCH: usize,
    const OWN: usize,
    const FUSED: usize,
>;

impl<const R: usize, const W: usize, const S: usize, const O: usize, const F: usize> Storage
    for Arrays<R, W, S, O, F>
{
    type Beams = [Beam; R];
    type Waiting = [u16; W];
    type Scratch = [RowSighting; S];
    type Own = [OwnTile; O];
    type Fused = [FusedTile; F];
}

/// All the memory that a [`Robot`](crate::Robot) borrows.
///
/// It is generic over its containers because a microcontroller needs arrays in a `static`, while a
/// PC takes the sizes from its command line.
///
/// [`Memory::EMPTY`] is all zero bits, so a `static` of it costs no flash:
///
/// ```
/// use ubimap_agent::{Bounds, Memory, memory};
///
/// const BOUNDS: Bounds = Bounds::SMALL;
/// // In the `#[entry]` function of firmware, use a `static mut`, which becomes a `&'static mut`.
/// let memory: Box<memory!(BOUNDS)> = Box::new(Memory::EMPTY);
/// assert_eq!(size_of_val(&*memory), BOUNDS.memory_bytes());
/// ```
pub struct Memory<S: Storage, D: Drive = NoDrive> {
    beams: S::Beams,
    waiting: S::Waiting,
    scratch: S::Scratch,
    own: S::Own,
    fused: S::Fused,
    drive: D::Memory,
}

impl<S: Storage, D: Drive> fmt::Debug for Memory<S, D> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Memory").finish_non_exhaustive()
    }
}

/// The type of a [`Memory`] of arrays with constant [`Bounds`]; the optional second argument is the
/// drive's type.
#[macro_export]
macro_rules! memory {
    ($bounds:expr) => {
        $crate::memory!($bounds, $crate::drive::NoDrive)
    };
    ($bounds:expr, $drive:ty) => {
        $crate::Memory<
            $crate::Arrays<
                { $bounds.readings },
                { $bounds.readings * $bounds.waiting },
                { $bounds.scratch() },
                { $bounds.own_tiles },
                { $bounds.fused_tiles },
            >,
            $drive,
        >
    };
}

impl<D: Drive, const R: usize, const W: usize, const S: usize, const O: usize, const F: usize>
    Memory<Arrays<R, W, S, O, F>, D>
{
    /// The initial state of the memory.
    pub const EMPTY: Self = Self {
        beams: [Beam::NONE; R],
        waiting: [0; W],
        scratch: [RowSighting::NONE; S],
        own: [OwnTile::FREE; O],
        fused: [FusedTile::FREE; F],
        drive: D::EMPTY,
    };
}

impl<S, D> Memory<S, D>
where
    S: Storage<
            Beams: FromIterator<Beam>,
            Waiting: FromIterator<u16>,
            Scratch: FromIterator<RowSighting>,
            Own: FromIterator<OwnTile>,
            Fused: FromIterator<FusedTile>,
        >,
    D: Drive,
{
    /// Memory for these bounds, in growable containers.
    pub fn new(bounds: &Bounds) -> Self {
        fn of<T: Clone, C: FromIterator<T>>(element: T, count: usize) -> C {
            core::iter::repeat_n(element, count).collect()
        }
        Self {
            beams: of(Beam::NONE, bounds.readings),
            waiting: of(0, bounds.readings * bounds.waiting),
            scratch: of(RowSighting::NONE, bounds.scratch()),
            own: of(OwnTile::FREE, bounds.own_tiles),
            fused: of(FusedTile::FREE, bounds.fused_tiles),
            drive: D::EMPTY,
        }
    }
}

impl<S: Storage, D: Drive> Memory<S, D> {
    /// The parts of the memory as slices, for code that runs a single stage.
    pub fn slices(&mut self) -> Slices<'_, D> {
        Slices {
            beams: self.beams.as_mut(),
            waiting: self.waiting.as_mut(),
            scratch: self.scratch.as_mut(),
            own: self.own.as_mut(),
            fused: self.fused.as_mut(),
            drive: &mut self.drive,
        }
    }
}

/// A borrowed [`Memory`], part by part.
pub struct Slices<'m, D: Drive = NoDrive> {
    /// One element per reading of a scan.
    pub beams: &'m mut [Beam],
    /// The readings of all waiting scans.
    pub waiting: &'m mut [u16],
    /// Scratch memory for mapping.
    pub scratch: &'m mut [RowSighting],
    /// The pool of the robot's own tiles.
    pub own: &'m mut [OwnTile],
    /// The pool of fused tiles.
    pub fused: &'m mut [FusedTile],
    /// The drive's working memory.
    pub drive: &'m mut D::Memory,
}

impl<D: Drive> fmt::Debug for Slices<'_, D> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Slices").finish_non_exhaustive()
    }
}

impl<D: Drive> Slices<'_, D> {
    /// Shortens each part to the bounds.
    ///
    /// # Errors
    /// [`ConfigError::Memory`] for the first part that is too small.
    pub(super) fn cut_to(self, bounds: &Bounds) -> Result<Self, ConfigError> {
        let Self { beams, waiting, scratch, own, fused, drive } = self;
        Ok(Self {
            beams: cut(beams, bounds.readings, Part::Beams)?,
            waiting: cut(waiting, bounds.readings.saturating_mul(bounds.waiting), Part::Waiting)?,
            scratch: cut(scratch, bounds.scratch(), Part::Scratch)?,
            own: cut(own, bounds.own_tiles, Part::OwnTiles)?,
            fused: cut(fused, bounds.fused_tiles, Part::FusedTiles)?,
            drive,
        })
    }
}

/// The first `bound` elements.
fn cut<T>(slice: &mut [T], bound: usize, part: Part) -> Result<&mut [T], ConfigError> {
    // The server's map is optional, so its pool may be empty; every other part needs at least one
    // element.
    let least = usize::from(part != Part::FusedTiles);
    if bound < least {
        return Err(ConfigError::Memory { part, needed: least, found: bound });
    }
    let found = slice.len();
    slice.get_mut(..bound).ok_or(ConfigError::Memory { part, needed: bound, found })
}

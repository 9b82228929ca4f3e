//! Memory of sealed links, which takes none in builds without the feature `seals`.

#[cfg(feature = "seals")]
type Room<T> = Option<T>;
#[cfg(not(feature = "seals"))]
type Room<T> = core::marker::PhantomData<T>;

/// An optional value of sealed links. Without the feature `seals` it is always none, and of size 0: a
/// struct with a [`Key`](super::Key) has no value then, but the compiler would still reserve memory.
#[derive(Debug)]
pub struct SealSlot<T>(Room<T>);

#[cfg(feature = "seals")]
impl<T> SealSlot<T> {
    /// A slot with this value.
    pub fn new(value: Option<T>) -> Self {
        Self(value)
    }

    /// The value.
    pub fn get(&self) -> Option<&T> {
        self.0.as_ref()
    }

    /// The value.
    pub fn get_mut(&mut self) -> Option<&mut T> {
        self.0.as_mut()
    }
}

#[cfg(not(feature = "seals"))]
impl<T> SealSlot<T> {
    /// A slot without a value, as no value exists.
    pub fn new(_: Option<T>) -> Self {
        Self(core::marker::PhantomData)
    }

    /// None.
    pub fn get(&self) -> Option<&T> {
        None
    }

    /// None.
    pub fn get_mut(&mut self) -> Option<&mut T> {
        None
    }
}

//! A field that was added to the end of a message: a body may end before it.

use core::{fmt, marker::PhantomData};

use serde::{Deserialize, Deserializer, Serialize, Serializer, de::Visitor};

/// Reads the field; `None` if the body ends before it.
pub(super) fn deserialize<'de, D: Deserializer<'de>, T: Deserialize<'de>>(
    deserializer: D,
) -> Result<Option<T>, D::Error> {
    struct Added<T>(PhantomData<T>);
    impl<'de, T: Deserialize<'de>> Visitor<'de> for Added<T> {
        type Value = Option<T>;

        fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
            f.write_str("a field, or the end of the body")
        }

        fn visit_none<E>(self) -> Result<Option<T>, E> {
            Ok(None)
        }

        fn visit_some<D: Deserializer<'de>>(self, field: D) -> Result<Option<T>, D::Error> {
            T::deserialize(field).map(Some)
        }
    }
    if deserializer.is_human_readable() {
        return Option::deserialize(deserializer);
    }
    // The reader takes this for an added field.
    deserializer.deserialize_any(Added(PhantomData))
}

/// Writes the field. One that is `None` must be skipped.
pub(super) fn serialize<S: Serializer, T: Serialize>(
    field: &Option<T>,
    serializer: S,
) -> Result<S::Ok, S::Error> {
    match field {
        Some(field) => field.serialize(serializer),
        None => serializer.serialize_none(),
    }
}

//! The macro that defines a direction's messages: number, kind and body of each.

/// Declares the messages of one direction. Each line is a number on the wire, the name of a kind
/// and the type of its body; kind 0 is [`Ack`](super::Ack) in both directions.
///
/// Generates the enum of kinds, the enum of received messages, and the implementations of
/// [`Traffic`] and [`Body`]. This is the only place where the numbers of kinds are written.
macro_rules! messages {
    (
        $direction:ident, against $opposite:ident: $kinds:ident, $messages:ident;
        $($number:literal $name:ident($body:ident),)+
    ) => {
        #[doc = concat!("The kinds of messages of [`", stringify!($direction), "`](super::", stringify!($direction), "), by their numbers.")]
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        #[repr(u8)]
        pub enum $kinds {
            /// [`Ack`](super::Ack).
            Ack = 0,
            $(
                #[doc = concat!("[`", stringify!($body), "`](super::", stringify!($body), ").")]
                $name = $number,
            )+
        }

        impl $kinds {
            /// All kinds, in order of their numbers.
            pub const ALL: &[Self] = &[Self::Ack, $(Self::$name,)+];

            /// The kind with this number, or `None` if this version does not know it.
            pub const fn from_number(number: u8) -> Option<Self> {
                match number {
                    0 => Some(Self::Ack),
                    $($number => Some(Self::$name),)+
                    _ => None,
                }
            }
        }

        impl From<$kinds> for u8 {
            fn from(kind: $kinds) -> Self {
                kind as u8
            }
        }

        #[doc = concat!("A received message of [`", stringify!($direction), "`](super::", stringify!($direction), "): its body is encoded still.")]
        #[derive(Clone, Copy, Debug)]
        pub enum $messages<'a> {
            /// An acknowledgement. The endpoint has already processed it.
            Ack($crate::message::Encoded<'a, $crate::message::Ack>),
            $(
                #[doc = concat!("[`", stringify!($body), "`](super::", stringify!($body), ").")]
                $name($crate::message::Encoded<'a, $body>),
            )+
        }

        impl $crate::message::Traffic for $crate::message::$direction {
            type Kind = $kinds;
            type Message<'a> = $messages<'a>;
            type Opposite = $crate::message::$opposite;
            const DIRECTION: $crate::message::Direction = $crate::message::Direction::$direction;
            const ACK: $kinds = $kinds::Ack;

            fn kind(number: u8) -> Option<$kinds> {
                $kinds::from_number(number)
            }

            fn message(number: u8, body: &[u8]) -> Option<$messages<'_>> {
                Some(match $kinds::from_number(number)? {
                    $kinds::Ack => $messages::Ack($crate::message::Encoded::new(body)),
                    $($kinds::$name => $messages::$name($crate::message::Encoded::new(body)),)+
                })
            }
        }

        $(
            impl $crate::message::Body<$crate::message::$direction> for $body {
                const KIND: $kinds = $kinds::$name;
            }
        )+
    };
}

pub(super) use messages;

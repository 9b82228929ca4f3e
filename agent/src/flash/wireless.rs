//! A robot's Wi-Fi network and server and their bytes in an image.
//!
//! All numbers are little-endian:
//!
//! | at | bytes | content |
//! |---|---|---|
//! | 0 | 16 | "ubimap wifi 1\r\n\0" |
//! | 16 | 4 | the server's IPv4 address |
//! | 20 | 2 | the server's UDP port |
//! | 22 | 1 | length of the name |
//! | 23 | 1 | length of the password; 0 for an open network |
//! | 24 | 32 | name (SSID, UTF-8); zeros after it |
//! | 56 | 64 | password (WPA2, UTF-8); zeros after it |
//! | 120 | 4 | CRC-32 of bytes 0 to 119 |

use core::net::{Ipv4Addr, SocketAddrV4};

use heapless::String;
use ubimap_protocol::checksum::crc32;

use super::record::{CRC_LEN, copy};

/// Maximum length of a network's name, in bytes.
pub const MAX_NAME: usize = 32;
/// Maximum length of a network's password, in bytes.
pub const MAX_PASSWORD: usize = 64;

/// Where the bytes of a network begin in an image.
const MAGIC: [u8; 16] = *b"ubimap wifi 1\r\n\0";
const NAME: usize = 24;
const PASSWORD: usize = NAME + MAX_NAME;
const CRC: usize = PASSWORD + MAX_PASSWORD;

/// Size of a network in an image, in bytes.
pub const WIRELESS_LEN: usize = CRC + CRC_LEN;

/// A network's place in an image that was given none: magic, then erased flash.
pub const WITHOUT_NETWORK: [u8; WIRELESS_LEN] = {
    let mut bytes = [0xFF; WIRELESS_LEN];
    let (magic, _) = bytes.split_at_mut(MAGIC.len());
    magic.copy_from_slice(&MAGIC);
    bytes
};

/// How a robot with Wi-Fi reaches its server. Unlike a [`Record`](super::Record) it is kept in the image
/// alone.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Wireless {
    /// The network's name.
    pub name: String<MAX_NAME>,
    /// Its password, empty for an open network.
    pub password: String<MAX_PASSWORD>,
    /// The server's address and UDP port.
    pub server: SocketAddrV4,
}

impl Wireless {
    /// The bytes for an image.
    pub fn to_bytes(&self) -> [u8; WIRELESS_LEN] {
        let mut bytes = [0; WIRELESS_LEN];
        copy(&mut bytes, &MAGIC);
        copy(&mut bytes[16..20], &self.server.ip().octets());
        copy(&mut bytes[20..22], &self.server.port().to_le_bytes());
        bytes[22] = self.name.len() as u8;
        bytes[23] = self.password.len() as u8;
        copy(&mut bytes[NAME..PASSWORD], self.name.as_bytes());
        copy(&mut bytes[PASSWORD..CRC], self.password.as_bytes());
        let crc = crc32(&[&bytes[..CRC]]);
        copy(&mut bytes[CRC..], &crc.to_le_bytes());
        bytes
    }

    /// The network in these bytes of an image; `None` if there is none.
    pub fn parse(bytes: &[u8; WIRELESS_LEN]) -> Option<Self> {
        // The magic is not compared, as it would be in the image once more; the CRC covers it.
        if bytes[CRC..] != crc32(&[&bytes[..CRC]]).to_le_bytes() {
            return None;
        }
        let address: [u8; 4] = *bytes[16..].first_chunk()?;
        let port = u16::from_le_bytes(*bytes[20..].first_chunk()?);
        Some(Self {
            name: text(&bytes[NAME..PASSWORD], bytes[22])?,
            password: text(&bytes[PASSWORD..CRC], bytes[23])?,
            server: SocketAddrV4::new(Ipv4Addr::from(address), port),
        })
    }
}

/// The text at the beginning of a field.
fn text<const N: usize>(field: &[u8], len: u8) -> Option<String<N>> {
    String::try_from(str::from_utf8(field.get(..len.into())?).ok()?).ok()
}

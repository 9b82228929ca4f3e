//! Where a port is, as text: a serial device, or a socket.

use std::{
    fmt,
    net::{Ipv4Addr, SocketAddr},
    path::PathBuf,
    str::FromStr,
};

/// The address of a port. As text a path, `udp:ADDRESS` or `tcp:ADDRESS`. An address without a host
/// (`udp:4000`) is on the loopback interface, which other machines can't reach.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Address {
    /// A serial port or a pseudo-terminal.
    Serial(PathBuf),
    /// A UDP socket.
    Udp(SocketAddr),
    /// A TCP socket.
    Tcp(SocketAddr),
}

/// The text after `udp:` or `tcp:` is not an address.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "{0}: not an address; give a port (udp:4000: this machine only) or HOST:PORT (udp:0.0.0.0:4000: from everywhere)"
)]
pub struct NotAnAddress(String);

impl FromStr for Address {
    type Err = NotAnAddress;

    fn from_str(text: &str) -> Result<Self, NotAnAddress> {
        let socket = |address: &str| match address.parse::<u16>() {
            Ok(port) => Ok(SocketAddr::from((Ipv4Addr::LOCALHOST, port))),
            Err(_) => address.parse().map_err(|_| NotAnAddress(text.to_owned())),
        };
        match text.split_once(':') {
            Some(("udp", address)) => Ok(Self::Udp(socket(address)?)),
            Some(("tcp", address)) => Ok(Self::Tcp(socket(address)?)),
            _ => Ok(Self::Serial(PathBuf::from(text))),
        }
    }
}

impl fmt::Display for Address {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Serial(path) => path.display().fmt(f),
            Self::Udp(address) => write!(f, "udp:{address}"),
            Self::Tcp(address) => write!(f, "tcp:{address}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_without_a_host_is_on_this_machine() {
        for (text, shown) in [
            ("udp:4000", "udp:127.0.0.1:4000"),
            ("tcp:0.0.0.0:4000", "tcp:0.0.0.0:4000"),
            ("udp:[::1]:4000", "udp:[::1]:4000"),
            ("/dev/ttyUSB0", "/dev/ttyUSB0"),
            ("/dev/serial/by-path/usb:1", "/dev/serial/by-path/usb:1"),
        ] {
            assert_eq!(text.parse::<Address>().unwrap().to_string(), shown);
        }
        for text in ["udp:", "tcp:robot", "udp:1.2.3.4", "udp:70000"] {
            let error = text.parse::<Address>().unwrap_err().to_string();
            assert!(error.starts_with(&format!("{text}: not an address; give")), "{error}");
        }
    }
}

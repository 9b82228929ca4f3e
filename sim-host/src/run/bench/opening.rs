//! The two halves of a session with a robot: the wire, and a server with one port.

use std::time;

use ubimap_protocol::{
    frame::{Key, MAX_FRAME},
    link::Terms,
    units::{Millimetres, RobotId},
};

use super::options::PortOptions;
use crate::{
    channel::{
        address::Address,
        serial::SerialPort,
        tcp::{self, TcpListener},
        udp::UdpSocket,
        wire::Wire,
    },
    run::{RunError, interruption},
    server::{Policy, Server},
};

/// How long a robot may take to connect.
const PATIENCE: time::Duration = time::Duration::from_secs(12);

/// Opens the wire. For TCP, waits until a robot has connected.
///
/// # Errors
/// [`RunError`] if the port can't be used.
pub(super) fn wire(options: &PortOptions) -> Result<Wire, RunError> {
    match &options.port {
        Address::Serial(path) => Ok(SerialPort::open(path, options.baud)?.into_wire()),
        Address::Udp(address) => Ok(UdpSocket::bind(*address)?.into_wire()),
        Address::Tcp(address) => {
            let listener = TcpListener::bind(*address)?;
            let began = time::Instant::now();
            while began.elapsed() < PATIENCE && !interruption::is_requested() {
                if let Some((stream, from)) =
                    listener.accept_within(time::Duration::from_millis(100))?
                {
                    return Ok(tcp::wire(stream, format!("{} from {from}", options.port))?);
                }
            }
            let reason = "no robot has connected".into();
            Err(RunError::Bench { port: options.port.to_string(), reason })
        }
    }
}

/// A server with one port, and the port's number.
///
/// # Errors
/// [`RunError::Randomness`].
pub(super) fn server(
    resolution: Millimetres,
    keys: &[(RobotId, Key)],
    is_keyed: bool,
) -> Result<(Server, usize), RunError> {
    let random = || getrandom::u32().map_err(RunError::Randomness);
    let frame = MAX_FRAME as u16;
    let terms = Terms { resolution, frame, server_epoch: random()?.max(1), stores: false };
    let mut server = Server::new(terms, 0);
    server.number_sessions_from(random()?);
    server.salt_from(u64::from(random()?) << 32 | u64::from(random()?));
    // Nothing here moves the robot but what the user has asked for.
    server.leave_errors();
    for &(robot, key) in keys {
        server.set_key(robot, key);
    }
    let port = server.open_port(if is_keyed { Policy::Keyed } else { Policy::Open });
    Ok((server, port))
}

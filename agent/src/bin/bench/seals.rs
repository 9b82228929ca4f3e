//! Sealed frames.

use core::hint::black_box;

use ubimap_protocol::{
    frame::{
        Attempt, DEFAULT_FRAME, Direction, FrameKind, Header, Key, SessionId, SessionKey, VERSION,
        open_session, seal_session, sealed_payload_capacity,
    },
    units::RobotId,
};

use crate::counter::Bench;

/// Measures sealing and opening the longest frame of 250 bytes on the wire, without stuffing.
/// `None` if it does not read back.
#[inline(never)]
pub(crate) fn run(bench: &mut Bench) -> Option<()> {
    let names = (RobotId(1), SessionId(7));
    let attempt = Attempt { boot: 1, clock: 2 };
    let key = SessionKey::derive(&Key::new([7; 16]), names.0, attempt, 3, names.1);
    let key = black_box(key);
    let header = Header { version: VERSION, kind: FrameKind::Reliable, sequence: 9 };
    let mut text = [0x55; sealed_payload_capacity(DEFAULT_FRAME)];
    let (clear, tag) = bench.measure("a frame of 250 bytes, sealed", || {
        seal_session(&key, names, Direction::ToRobot, header, 70_000, &mut text)
    });
    let is_hidden = text.iter().filter(|&&byte| byte == 0x55).count() < 10;
    let is_good = bench.measure("a frame of 250 bytes, opened", || {
        open_session(&key, names, Direction::ToRobot, &clear, 70_000, (&mut text, &tag))
    });
    (is_hidden && is_good && text.iter().all(|&byte| byte == 0x55)).then_some(())
}

//! Checks SQLite's log, the `-wal` file, for damage. SQLite silently drops a damaged frame and all
//! that follow, as it must after a crash in the middle of a commit.

use std::{
    ffi::OsString,
    fs::{self, File},
    io::{BufReader, Read},
    path::Path,
};

/// Length of the header of the log.
const HEADER: usize = 32;
/// Length of the header of a frame.
const FRAME_HEADER: usize = 24;
/// The first four bytes of a log. Their last bit, zero here, says whether checksums read big-endian
/// words.
const MAGIC: u32 = 0x377F_0682;

/// Whether a store's log has lost frames to damage: a frame is invalid, but later frames of the
/// same round (since the log was last restarted) exist. A killed process alone does not leave such
/// a log, but a failed write followed by a kill can. Damage of the last frame can't be
/// distinguished from an incomplete write. Format: sqlite.org/fileformat.html, 4.
pub(super) fn is_damaged(store: &Path) -> bool {
    let Ok(real) = fs::canonicalize(store) else { return false };
    let mut name = OsString::from(real);
    name.push("-wal");
    // Usually there is no log, because closing a store removes it.
    let Ok(file) = File::open(name) else { return false };
    let mut file = BufReader::new(file);
    let mut header = [0; HEADER];
    // A log without a header was never written.
    file.read_exact(&mut header).is_ok() && !are_frames_whole(&header, file)
}

fn are_frames_whole(header: &[u8; HEADER], mut frames: impl Read) -> bool {
    let magic = word(header, 0);
    let mut sum = Sum { is_big_endian: magic & 1 == 1, sums: [0; 2] };
    sum.add(&header[..24]);
    let page = word(header, 8) as usize;
    if magic & !1 != MAGIC || sum.sums != [word(header, 24), word(header, 28)] {
        return false;
    }
    let mut is_valid = true;
    let mut frame = vec![0; FRAME_HEADER + page.min(1 << 16)];
    while frames.read_exact(&mut frame).is_ok() {
        // Frames of an earlier round have other salts.
        let is_of_round = frame[8..16] == header[16..24];
        if is_of_round && !is_valid {
            return false;
        }
        sum.add(&frame[..8]);
        sum.add(&frame[FRAME_HEADER..]);
        is_valid &= is_of_round && sum.sums == [word(&frame, 16), word(&frame, 20)];
    }
    true
}

/// Reads a big-endian number of four bytes.
fn word(bytes: &[u8], at: usize) -> u32 {
    bytes[at..at + 4].iter().fold(0, |number, &byte| number << 8 | u32::from(byte))
}

/// The cumulative checksum of a log.
struct Sum {
    is_big_endian: bool,
    sums: [u32; 2],
}

impl Sum {
    fn add(&mut self, bytes: &[u8]) {
        let read = if self.is_big_endian { u32::from_be_bytes } else { u32::from_le_bytes };
        for &[first, second] in bytes.as_chunks::<4>().0.as_chunks::<2>().0 {
            let [even, odd] = &mut self.sums;
            *even = even.wrapping_add(read(first)).wrapping_add(*odd);
            *odd = odd.wrapping_add(read(second)).wrapping_add(*even);
        }
    }
}

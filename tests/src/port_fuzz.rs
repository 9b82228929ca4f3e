//! Fuzz targets for the commands for a robot at a port: arbitrary bytes from the port, and arbitrary words for
//! parameters. They must not panic on any input. The fuzzer's workspace (`fuzz/`) and the corpus test share
//! this file.

use ubimap_agent::Parameter;
use ubimap_sim_host::run::bench::{
    overheard::Ear,
    quantity::{meaning, named, parsed, range, shown, unit},
};

/// Listens to bytes at once and in pieces; the first byte is the length of the pieces.
pub fn overheard(data: &[u8]) {
    let Some((&length, data)) = data.split_first() else { return };
    let (mut whole, mut pieces) = (Ear::default(), Ear::default());
    let at_once = whole.hear(data);
    let heard: Vec<_> =
        data.chunks(usize::from(length).max(1)).flat_map(|piece| pieces.hear(piece)).collect();
    assert_eq!(heard, at_once);
    assert_eq!((whole.bytes(), pieces.bytes()), (data.len() as u64, data.len() as u64));
}

/// Reads a parameter's value: the first byte chooses the parameter, the next four are a value on the wire, the
/// rest is the text of another one. What is read is within its range and is shown as what is read again.
pub fn parameters(data: &[u8]) {
    let Some((&[number, a, b, c, d], text)) = data.split_first_chunk::<5>() else { return };
    let parameter = Parameter::ALL[usize::from(number) % Parameter::ALL.len()];
    let text = String::from_utf8_lossy(text);
    assert!(!meaning(parameter).is_empty() && !range(parameter).is_empty());
    // Names are not values.
    let _ = (named(&text), unit(parameter));
    shown(parameter, i32::from_le_bytes([a, b, c, d]));
    let (least, most) = parameter.range();
    match parsed(parameter, &text) {
        Ok(value) => {
            assert!((least..=most).contains(&value), "{value}");
            let again = parsed(parameter, &shown(parameter, value));
            assert!(again.is_ok(), "{parameter:?}: {}", shown(parameter, value));
        }
        Err(told) => assert_eq!(told.lines().count(), 1, "{told}"),
    }
}

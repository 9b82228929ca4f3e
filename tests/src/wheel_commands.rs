//! The commands on a Create 2's port, read from their bytes alone: an oracle of what a robot tells its
//! wheels, whatever the agent believes.

use std::time::Instant;

use crate::faulty_line::Spoken;

/// A command to the wheels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct WheelCommand {
    /// When its last byte left the robot.
    pub at: Instant,
    /// Speeds of the right and the left wheel, in mm/s.
    pub speeds: [i16; 2],
}

impl WheelCommand {
    /// Whether it moves the robot.
    pub fn moves(&self) -> bool {
        self.speeds != [0, 0]
    }
}

/// The "drive direct" commands (opcode 145) among a robot's bytes; the other opcodes that it uses are
/// passed over by their lengths in the Open Interface specification.
///
/// # Panics
/// On an opcode that is not in the list.
pub fn wheel_commands(spoken: &Spoken) -> Vec<WheelCommand> {
    let mut bytes = spoken.iter().flat_map(|(at, bytes)| bytes.iter().map(|byte| (*at, *byte)));
    let mut commands = Vec::new();
    while let Some((_, opcode)) = bytes.next() {
        match opcode {
            // Start, safe, full, reset, power off, stop.
            128 | 131 | 132 | 7 | 133 | 173 => {}
            145 => {
                let data: Vec<_> = bytes.by_ref().take(4).collect();
                // The last one may be incomplete.
                let [(_, r1), (_, r0), (_, l1), (at, l0)] = data[..] else { break };
                let speeds = [[r1, r0], [l1, l0]].map(i16::from_be_bytes);
                commands.push(WheelCommand { at, speeds });
            }
            // Stream: a count, then the packets' numbers. Pause or resume the stream: one byte.
            148 => {
                let count = bytes.next().map_or(0, |(_, count)| usize::from(count));
                bytes.by_ref().take(count).for_each(drop);
            }
            150 => drop(bytes.next()),
            other => panic!("opcode {other} is not one that a robot uses"),
        }
    }
    commands
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn commands_are_found_between_other_opcodes_and_across_pieces() {
        let now = Instant::now();
        let piece = |bytes: &[u8]| (now, bytes.to_vec());
        // The specification's example: -200 mm/s is FF 38.
        let spoken = vec![
            piece(&[128, 131, 148, 3, 145, 43, 44, 145, 0xff]),
            piece(&[0x38, 0x01]),
            piece(&[0xf4, 145, 0, 0, 0, 0, 145, 1]),
        ];
        let found: Vec<_> = wheel_commands(&spoken).iter().map(|it| it.speeds).collect();
        assert_eq!(found, [[-200, 500], [0, 0]]);
    }
}

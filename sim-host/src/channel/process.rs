//! A link to a process over its standard input and output.

use std::{
    io::{self, Read, Write},
    process::{Child, ChildStdin, Command, Stdio},
    sync::{Arc, Mutex, PoisonError, mpsc},
    thread,
    time::{self, Duration},
};

use super::wire::{Wire, WireError, WireReader, WireWriter};

/// How long a process whose output has closed may take to exit, before it counts as running.
const EXIT_WAIT: Duration = Duration::from_millis(200);
/// Bytes read from the process at once.
const CHUNK: usize = 4_096;

/// A running process; it is killed when both ends are dropped.
#[derive(Debug)]
struct Process {
    name: String,
    child: Mutex<Child>,
}

impl Drop for Process {
    fn drop(&mut self) {
        if let Ok(child) = self.child.get_mut() {
            // It may have ended by itself.
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

impl Process {
    /// How the process has ended, now that it has closed its output or no longer takes input.
    fn ended(&self) -> WireError {
        let began = time::Instant::now();
        let mut child = self.child.lock().unwrap_or_else(PoisonError::into_inner);
        let how = loop {
            match child.try_wait() {
                Ok(Some(status)) => break format!("the command has ended ({status})"),
                Ok(None) if began.elapsed() < EXIT_WAIT => thread::sleep(Duration::from_millis(5)),
                _ => break "the command has closed its output, and runs on".to_owned(),
            }
        };
        WireError::Ended { name: self.name.clone(), how }
    }
}

#[derive(Debug)]
struct Output {
    process: Arc<Process>,
    chunks: mpsc::Receiver<Vec<u8>>,
    /// Bytes that have not been read yet.
    rest: Vec<u8>,
}

#[derive(Debug)]
struct Input {
    process: Arc<Process>,
    stdin: ChildStdin,
}

/// Starts a command by the shell `sh`, and returns the link to it. Its standard error is the caller's.
///
/// # Errors
/// [`WireError::Open`].
pub fn start(command: &str) -> Result<Wire, WireError> {
    let open = |reason: io::Error| WireError::Open {
        name: command.to_owned(),
        reason: reason.to_string(),
    };
    let mut shell = Command::new("sh");
    // Ctrl-C is for this program alone, which then ends in order.
    #[cfg(unix)]
    std::os::unix::process::CommandExt::process_group(&mut shell, 0);
    let mut child = shell
        // So that the process itself, and not the shell, is killed.
        .args(["-c", &format!("exec {command}")])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .map_err(open)?;
    let (Some(stdin), Some(mut stdout)) = (child.stdin.take(), child.stdout.take()) else {
        return Err(open(io::Error::other("it has no standard input and output")));
    };
    let (send, chunks) = mpsc::channel();
    // It ends with the process's output.
    let reading = thread::Builder::new().name("process-read".into()).spawn(move || {
        let mut buffer = [0; CHUNK];
        while let Ok(count @ 1..) = stdout.read(&mut buffer) {
            if send.send(buffer[..count].to_vec()).is_err() {
                return;
            }
        }
    });
    reading.map_err(open)?;
    let process = Arc::new(Process { name: command.to_owned(), child: Mutex::new(child) });
    let reader = Output { process: Arc::clone(&process), chunks, rest: Vec::new() };
    Ok(Wire { reader: Box::new(reader), writer: Box::new(Input { process, stdin }) })
}

impl WireReader for Output {
    fn read_within(&mut self, buffer: &mut [u8], wait: Duration) -> Result<usize, WireError> {
        if self.rest.is_empty() {
            match self.chunks.recv_timeout(wait) {
                Ok(chunk) => self.rest = chunk,
                Err(mpsc::RecvTimeoutError::Timeout) => return Ok(0),
                Err(mpsc::RecvTimeoutError::Disconnected) => {
                    return Err(self.process.ended());
                }
            }
        }
        let count = self.rest.len().min(buffer.len());
        buffer[..count].copy_from_slice(&self.rest[..count]);
        self.rest.drain(..count);
        Ok(count)
    }
}

impl WireWriter for Input {
    fn write(&mut self, bytes: &[u8]) -> Result<(), WireError> {
        let written = self.stdin.write_all(bytes).and_then(|()| self.stdin.flush());
        written.map_err(|_| self.process.ended())
    }
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;

    #[test]
    fn bytes_cross_both_ways_and_an_end_is_told() {
        let Wire { mut reader, mut writer } = start("head -c 3").unwrap();
        writer.write(&[1, 0, 255]).unwrap();
        let mut arrived = Vec::new();
        let mut buffer = [0; 2];
        let end = loop {
            match reader.read_within(&mut buffer, Duration::from_secs(5)) {
                Ok(count) => arrived.extend_from_slice(&buffer[..count]),
                Err(error) => break error,
            }
        };
        assert_eq!(arrived, [1, 0, 255]);
        assert_eq!(end.to_string(), "head -c 3: the command has ended (exit status: 0)");
    }
}

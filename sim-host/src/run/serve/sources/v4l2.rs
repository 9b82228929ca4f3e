//! Frames of a Video4Linux device. Depth and pictures come from two devices, each with its own capture times:
//! each image is a frame.

use std::{
    fs, io,
    path::{Path, PathBuf},
    thread,
    time::Duration as RealTime,
};

use moq_v4l::{
    Device, Format, FourCC,
    buffer::{Flags, Metadata, Type},
    capability::Flags as Capability,
    framesize::FrameSizeEnum,
    io::{mmap::Stream, traits::CaptureStream},
    video::Capture,
};
use nix::time::{ClockId, clock_gettime};
use ubimap_protocol::time::{Duration, Instant};

use super::live_source::{LiveFrame, LiveSource};
use crate::{
    camera::{Frame, PixelFormat},
    channel::wire::WireError,
    run::serve::clock::Clock,
};

/// Interval between looks for a device that is away.
const RETRY: RealTime = RealTime::from_millis(100);
/// A device without an image for this long is opened again.
const SILENT: RealTime = RealTime::from_secs(1);
/// Maximum age of an image at its arrival; the stamp of an older one is wrong.
const OLDEST: Duration = Duration::from_secs(1);

/// The images of a device.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Images {
    Depth,
    Pictures,
}

/// A device, which may be away.
pub(super) struct Camera {
    camera: usize,
    /// "camera NAME: PATH", for messages.
    name: String,
    path: PathBuf,
    images: Images,
    size: (u32, u32),
    opened: Option<Opened>,
    /// What was said last of a device that can't be used, so that it is said once.
    said: String,
}

struct Opened {
    stream: Stream<'static>,
    format: PixelFormat,
    stride: usize,
}

/// Why a device can't be used.
enum Refusal {
    /// It is not there, or not ready yet.
    Away(String),
    /// It is not what the deployment says.
    Unfit(String),
}

impl Camera {
    /// Opens a device. One that is not plugged in is waited for.
    ///
    /// # Errors
    /// [`WireError::Open`] if the device does not offer images of this size.
    pub(super) fn open(
        camera: usize,
        name: &str,
        path: &Path,
        images: Images,
        size: (u32, u32),
    ) -> Result<Self, WireError> {
        let name = format!("camera {name}: {}", path.display());
        let path = path.to_owned();
        let said = String::new();
        let mut all = Self { camera, name, path, images, size, opened: None, said };
        match all.try_open() {
            Ok(opened) => all.begin(opened),
            Err(Refusal::Away(reason)) => all.say(format!("{reason}; waiting for it")),
            Err(Refusal::Unfit(reason)) => {
                return Err(WireError::Open { name: all.name, reason });
            }
        }
        Ok(all)
    }

    fn begin(&mut self, opened: Opened) {
        let (width, height) = self.size;
        let code = String::from_utf8_lossy(opened.format.code());
        log::info!("{}: {width} x {height} {}", self.name, code.trim());
        self.opened = Some(opened);
        self.said.clear();
    }

    fn say(&mut self, what: String) {
        if self.said != what {
            log::warn!("{}: {what}", self.name);
            self.said = what;
        }
    }

    fn try_open(&self) -> Result<Opened, Refusal> {
        let device = Device::with_path(&self.path).map_err(|error| match error.kind() {
            io::ErrorKind::NotFound => Refusal::Away(format!("no such device; {}", devices())),
            io::ErrorKind::PermissionDenied => Refusal::Unfit(
                "permission denied; add the user of the server to the group `video`".into(),
            ),
            _ => Refusal::Away(error.to_string()),
        })?;
        let away = |error: io::Error| match error.kind() {
            io::ErrorKind::ResourceBusy => Refusal::Away("another program uses it".into()),
            _ => Refusal::Away(error.to_string()),
        };
        let unfit = |reason: &str| Refusal::Unfit(reason.into());
        let able = device.query_caps().map_err(|_| unfit("not a camera"))?.capabilities;
        if !able.contains(Capability::VIDEO_CAPTURE | Capability::STREAMING) {
            return Err(unfit("not a camera that streams images of one plane"));
        }
        let formats: &[PixelFormat] = match self.images {
            Images::Depth => &PixelFormat::OF_DEPTH,
            Images::Pictures => &PixelFormat::OF_PICTURES,
        };
        let (width, height) = self.size;
        let offered = device.enum_formats().map_err(away)?;
        for &format in formats {
            let code = FourCC::new(format.code());
            if !offered.iter().any(|it| it.fourcc == code) {
                continue;
            }
            let set = device.set_format(&Format::new(width, height, code)).map_err(away)?;
            if (set.width, set.height, set.fourcc) == (width, height, code) {
                let mut stream = Stream::new(&device, Type::VideoCapture).map_err(away)?;
                stream.set_timeout(SILENT);
                return Ok(Opened { stream, format, stride: set.stride as usize });
            }
        }
        let codes = formats.iter().map(|it| String::from_utf8_lossy(it.code()).trim().to_owned());
        let codes: Vec<String> = codes.collect();
        Err(Refusal::Unfit(format!(
            "has no images of {width} x {height} pixels as {}, which the intrinsics ask for; it offers {}",
            codes.join(" or "),
            offer(&device, offered.iter().map(|it| it.fourcc))
        )))
    }

    /// The frame of an image, at its time of capture.
    fn frame(
        &self,
        image: &[u8],
        of: &Metadata,
        opened: (PixelFormat, usize),
        now: Instant,
    ) -> Option<Frame> {
        let image = image.get(..of.bytesused as usize).unwrap_or(image);
        log::trace!(
            "{}: image {} of {} bytes, stamped {}.{:06} s",
            self.name,
            of.sequence,
            image.len(),
            of.timestamp.sec,
            of.timestamp.usec
        );
        let is_damaged = of.flags.contains(Flags::ERROR);
        let (format, stride) = opened;
        let (depth, picture) = match self.images {
            Images::Depth => (format.depth(image, stride, self.size), None),
            Images::Pictures => (None, format.picture(image, stride, self.size)),
        };
        if is_damaged || depth.is_none() && picture.is_none() {
            return None;
        }
        let age = age(of).filter(|age| *age <= OLDEST).unwrap_or(Duration::from_micros(0));
        let captured = Instant(now.micros().saturating_sub(age.micros()));
        Some(Frame { camera: self.camera, captured, depth, picture })
    }
}

impl LiveSource for Camera {
    fn next(&mut self, clock: &Clock) -> Option<LiveFrame> {
        loop {
            let Some(mut opened) = self.opened.take() else {
                match self.try_open() {
                    Ok(opened) => self.begin(opened),
                    Err(Refusal::Away(reason) | Refusal::Unfit(reason)) => {
                        self.say(reason);
                        thread::sleep(RETRY);
                    }
                }
                continue;
            };
            let form = (opened.format, opened.stride);
            match opened.stream.next() {
                Ok((image, of)) => {
                    let at = clock.now();
                    let frame = self.frame(image, of, form, at);
                    self.opened = Some(opened);
                    if let Some(frame) = frame {
                        return Some(LiveFrame { frame, at, sender: None, waits: false });
                    }
                }
                // Dropped, and opened again.
                Err(error) => self.say(format!("{error}; waiting for it to come back")),
            }
        }
    }
}

/// The time since an image was captured, by the driver's monotonic clock; `None` if it has another.
fn age(of: &Metadata) -> Option<Duration> {
    if of.flags & Flags::TIMESTAMP_MASK != Flags::TIMESTAMP_MONOTONIC {
        return None;
    }
    let now = RealTime::from(clock_gettime(ClockId::CLOCK_MONOTONIC).ok()?);
    let age = now.checked_sub(of.timestamp.into())?;
    Some(Duration::from_micros(age.as_micros() as u64))
}

/// The devices that there are.
fn devices() -> String {
    let entries = fs::read_dir("/sys/class/video4linux").into_iter().flatten().flatten();
    let mut devices: Vec<String> = entries
        .map(|entry| {
            let card = fs::read_to_string(entry.path().join("name")).unwrap_or_default();
            format!("/dev/{} ({})", entry.file_name().display(), card.trim())
        })
        .collect();
    devices.sort();
    match devices.is_empty() {
        true => "there is no video device".into(),
        false => format!("there are {}", devices.join(", ")),
    }
}

/// The formats and sizes that a device offers.
fn offer(device: &Device, formats: impl Iterator<Item = FourCC>) -> String {
    let offer = formats.map(|code| {
        let sizes = device.enum_framesizes(code).unwrap_or_default().into_iter();
        let sizes: Vec<String> = sizes
            .map(|it| match it.size {
                FrameSizeEnum::Discrete(size) => format!("{} x {}", size.width, size.height),
                FrameSizeEnum::Stepwise(size) => format!(
                    "{} x {} to {} x {}",
                    size.min_width, size.min_height, size.max_width, size.max_height
                ),
            })
            .collect();
        let code = String::from_utf8_lossy(&code.repr);
        format!("{} ({})", code.trim(), sizes.join(", "))
    });
    offer.collect::<Vec<_>>().join(", ")
}

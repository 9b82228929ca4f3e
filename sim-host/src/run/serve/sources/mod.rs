//! Where live frames come from: a trait, and the sources that implement it.

mod live_source;
mod recording;
mod stream;
#[cfg(target_os = "linux")]
mod v4l2;

use std::path::Path;

use crate::{
    camera::Calibration,
    channel::{socket_file::SocketFile, wire::WireError},
    run::deployment_file::{CameraSource, DeployedCamera},
};
pub(super) use live_source::{LiveFrame, LiveSource};

/// Open sources, and the files of their sockets, which are removed when these are dropped: a source lives in a
/// thread that ends with the process.
pub(super) type Opened = (Vec<Box<dyn LiveSource>>, Vec<SocketFile>);

/// Opens the sources of all cameras. The recorded folders are one source: their frames share a clock, and
/// are played in the order in which they arrived, all of them if `every_frame`.
///
/// # Errors
/// [`WireError::Open`] if one can't be opened.
pub(super) fn open(cameras: &[DeployedCamera], every_frame: bool) -> Result<Opened, WireError> {
    let mut sources: Vec<Box<dyn LiveSource>> = Vec::new();
    let (mut files, mut folders) = (Vec::new(), Vec::new());
    for (index, DeployedCamera { name, source, calibration, .. }) in cameras.iter().enumerate() {
        match source {
            CameraSource::Folder(folder) => folders.push((index, folder.clone())),
            CameraSource::TcpStream(address) => {
                sources.push(Box::new(stream::tcp(index, name, *address)?));
            }
            CameraSource::UnixStream(path) => {
                let (source, file) = stream::unix(index, name, path)?;
                sources.push(Box::new(source));
                files.push(file);
            }
            CameraSource::V4l2 { depth, picture } => {
                sources.extend(v4l2(
                    index,
                    name,
                    [depth.as_deref(), picture.as_deref()],
                    calibration,
                )?);
            }
        }
    }
    if !folders.is_empty() {
        sources.push(Box::new(recording::Player::open(folders, every_frame)?));
    }
    Ok((sources, files))
}

/// The devices of a camera, for depth and pictures.
#[cfg(target_os = "linux")]
fn v4l2(
    camera: usize,
    name: &str,
    [depth, picture]: [Option<&Path>; 2],
    calibration: &Calibration,
) -> Result<Vec<Box<dyn LiveSource>>, WireError> {
    let mut sources: Vec<Box<dyn LiveSource>> = Vec::new();
    for (path, lens, images) in [
        (depth, calibration.depth, v4l2::Images::Depth),
        (picture, calibration.picture, v4l2::Images::Pictures),
    ] {
        if let (Some(path), Some(lens)) = (path, lens) {
            let crate::camera::Intrinsics { width, height, .. } = *lens.intrinsics();
            let device = v4l2::Camera::open(camera, name, path, images, (width, height))?;
            sources.push(Box::new(device));
        }
    }
    Ok(sources)
}

#[cfg(not(target_os = "linux"))]
fn v4l2(
    _: usize,
    name: &str,
    _: [Option<&Path>; 2],
    _: &Calibration,
) -> Result<Vec<Box<dyn LiveSource>>, WireError> {
    let reason = "v4l2 is for Linux; give stream:HOST:PORT".to_owned();
    Err(WireError::Open { name: format!("camera {name}"), reason })
}

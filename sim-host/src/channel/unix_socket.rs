//! Unix sockets that a server listens at.

use std::{
    fs,
    os::unix::{
        fs::{FileTypeExt, PermissionsExt},
        net::{UnixListener, UnixStream},
    },
    path::Path,
};

use super::{socket_file::SocketFile, wire::WireError};

/// Listens at a path, for this user alone. A socket that a killed server has left there is replaced; one
/// of a living server is not. The file is removed when the second part of the result is dropped.
///
/// # Errors
/// [`WireError::Open`].
pub fn listen(path: &Path) -> Result<(UnixListener, SocketFile), WireError> {
    let refuse = |reason| WireError::Open { name: path.display().to_string(), reason };
    if let Ok(there) = fs::symlink_metadata(path) {
        if !there.file_type().is_socket() {
            return Err(refuse("exists, and is not a socket".into()));
        }
        if UnixStream::connect(path).is_ok() {
            return Err(refuse(
                "another ubimap serve or record listens there; stop it first".into(),
            ));
        }
        fs::remove_file(path).map_err(|error| refuse(error.to_string()))?;
    }
    let listener = UnixListener::bind(path).map_err(|error| refuse(error.to_string()))?;
    let private = fs::set_permissions(path, fs::Permissions::from_mode(0o600));
    private.map_err(|error| refuse(error.to_string()))?;
    Ok((listener, SocketFile::new(path.to_owned())))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::Folder;

    #[test]
    fn a_dead_servers_socket_is_replaced_and_nothing_else() {
        let folder = Folder::new("unix-socket");
        let path = folder.path().join("s");
        let living = listen(&path).unwrap();
        let error = listen(&path).unwrap_err().to_string();
        assert!(error.contains("another ubimap serve"), "{error}");
        let (listener, file) = living;
        std::mem::forget(file);
        drop(listener);
        assert!(path.exists(), "as a killed server leaves it");
        drop(listen(&path).unwrap());
        assert!(!path.exists(), "nobody listens there any more");
        let file = folder.file("file", b"x");
        assert!(listen(&file).unwrap_err().to_string().contains("not a socket"));
    }
}

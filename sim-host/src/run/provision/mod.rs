//! `ubimap provision`: a robot's number, key, parameters and Wi-Fi network in a firmware image.

mod image;
mod uf2;

use std::{
    net::SocketAddrV4,
    path::{Path, PathBuf},
    time::{SystemTime, UNIX_EPOCH},
};

use clap::Args;
use ubimap_agent::flash::{MAX_NAME, Record, Seed, Wireless};
use ubimap_protocol::{
    message::{MAX_PARAMETERS, ParameterValue},
    units::RobotId,
};

use self::image::ImageFault;
use super::{
    bench::quantity::on_wire,
    keys::{self, KeysError},
};
use crate::{
    files,
    report::{OutputError, OutputFile},
};

/// Maximum size of an image in bytes; those with debug information take a few megabytes.
const MAX_IMAGE: u64 = 64 << 20;

/// Options of `ubimap provision`.
#[derive(Args, Clone, Debug)]
pub struct ProvisionOptions {
    /// The image: an ELF, BIN or UF2 file, built with `--features flash`
    #[arg(value_name = "IMAGE")]
    pub image: PathBuf,

    /// The robot's number, 1 to 65535, unique in a deployment; without, --out gets the image as it is: if it was never
    /// provisioned, an update that leaves a robot its number, key and parameters
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    pub id: Option<u16>,

    /// The robot's key, made by `ubimap keys make N`; without, its link is open
    #[arg(long, value_name = "FILE", requires = "id")]
    pub key: Option<PathBuf>,

    /// A parameter that differs from the image's, in the units of SPEC.md; can be repeated
    #[arg(long, value_name = "NAME=VALUE", requires = "id")]
    pub set: Vec<String>,

    /// The Wi-Fi network that the robot joins, for an image with a radio (`cargo esp32c3`)
    #[arg(long, value_name = "NAME", requires_all = ["server", "id"])]
    pub wifi: Option<String>,

    /// The network's password (WPA2), in the first line of a file; without, the network is open
    #[arg(long, value_name = "FILE", requires = "wifi")]
    pub wifi_password: Option<PathBuf>,

    /// The server's address and UDP port in that network, such as 192.168.1.10:4000
    #[arg(long, value_name = "IP:PORT", requires = "wifi")]
    pub server: Option<SocketAddrV4>,

    /// Where to write the image [default: in its place]; a name that ends in .uf2 makes a UF2 file of an ELF image
    /// for the RP2040 or RP2350
    #[arg(long, value_name = "FILE", required_unless_present = "id")]
    pub out: Option<PathBuf>,
}

/// Why an image can't be provisioned; nothing was written. Each message is one line.
#[derive(Debug, thiserror::Error)]
pub enum ProvisionError {
    /// The image can't be read.
    #[error("{path}: {error}", path = path.display())]
    Read {
        /// The image.
        path: PathBuf,
        /// The reason.
        error: std::io::Error,
    },
    /// The image has no place for a seed.
    #[error("{path}: {fault}", path = path.display())]
    Image {
        /// The image.
        path: PathBuf,
        /// The reason.
        fault: ImageFault,
    },
    /// A parameter can't be set.
    #[error("--set {given}: {reason}")]
    Set {
        /// What was given.
        given: String,
        /// The reason.
        reason: String,
    },
    /// The network can't be used.
    #[error("--wifi {name}: {reason}")]
    Wifi {
        /// The network's name.
        name: String,
        /// The reason.
        reason: String,
    },
    /// The key can't be read.
    #[error(transparent)]
    Key(#[from] KeysError),
    /// The result can't be written.
    #[error(transparent)]
    Output(#[from] OutputError),
}

/// Provisions an image. Returns what to print.
///
/// # Errors
/// [`ProvisionError`]; no file has changed then.
pub fn run(options: &ProvisionOptions) -> Result<String, ProvisionError> {
    let path = &options.image;
    let mut image = files::read(path, MAX_IMAGE)
        .map_err(|error| ProvisionError::Read { path: path.clone(), error })?;
    let refuse = |fault| ProvisionError::Image { path: path.clone(), fault };
    let what = match options.id {
        Some(id) => {
            let record = record(id, options)?;
            image::patch(&mut image, &Seed::to_bytes(&record)).map_err(refuse)?;
            let link = if record.key.is_some() { "a sealed link" } else { "an open link" };
            let network = match wireless(options)? {
                Some(wireless) => {
                    let patched = image::patch(&mut image, &wireless.to_bytes());
                    patched.map_err(|fault| match fault {
                        ImageFault::NoPlace => refuse(ImageFault::NoNetwork),
                        other => refuse(other),
                    })?;
                    format!(", Wi-Fi {} to {}", wireless.name, wireless.server)
                }
                None => String::new(),
            };
            format!("robot {id}, {link}{network}, parameters set: {}", record.parameters.len())
        }
        None => format!("the image as {} has it", path.display()),
    };
    let out: &Path = options.out.as_deref().unwrap_or(path);
    let is_uf2 = |path: &Path| path.extension().is_some_and(|it| it.eq_ignore_ascii_case("uf2"));
    if is_uf2(out) && !is_uf2(path) {
        image = uf2::from_elf(&image).map_err(refuse)?;
    }
    OutputFile::create(out)?.finish(&image)?;
    Ok(format!("{}: {what}\n", out.display()))
}

/// The record of a robot.
fn record(id: u16, options: &ProvisionOptions) -> Result<Record, ProvisionError> {
    let key = options.key.as_deref().map(keys::read_key).transpose()?;
    let parameters = parameters(&options.set)?;
    // No boot number is used twice with a key if the robot boots less than once a second.
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    let boots = u32::try_from(since.as_secs()).unwrap_or(u32::MAX / 2);
    Ok(Record { robot: RobotId(id), key, boots, parameters })
}

/// The network that the robot joins, if one is given.
fn wireless(options: &ProvisionOptions) -> Result<Option<Wireless>, ProvisionError> {
    let (Some(wifi), Some(server)) = (&options.wifi, options.server) else { return Ok(None) };
    let refuse = |reason: String| ProvisionError::Wifi { name: wifi.clone(), reason };
    let password = match &options.wifi_password {
        Some(path) => {
            let text = files::read_settings(path).map_err(|error| refuse(error.to_string()))?;
            let line = text.lines().next().unwrap_or_default().to_owned();
            // As IEEE 802.11 has it; 64 would be the digits of the key that is made from a password.
            if !(8..=63).contains(&line.len()) {
                let reason = format!("the password in {} has not 8 to 63 bytes", path.display());
                return Err(refuse(reason));
            }
            line
        }
        None => String::new(),
    };
    let name = heapless::String::try_from(wifi.as_str()).ok().filter(|name| !name.is_empty());
    let name = name.ok_or_else(|| refuse(format!("a name has 1 to {MAX_NAME} bytes")))?;
    let password = heapless::String::try_from(password.as_str())
        .map_err(|_| refuse("the password is too long".into()))?;
    if server.port() == 0 || server.ip().is_unspecified() {
        return Err(refuse(format!("{server} is not an address that a robot can reach")));
    }
    Ok(Some(Wireless { name, password, server }))
}

/// The parameters of `NAME=VALUE`s. Of two values of one parameter the last one counts.
fn parameters(
    given: &[String],
) -> Result<heapless::Vec<ParameterValue, MAX_PARAMETERS>, ProvisionError> {
    let mut values = heapless::Vec::<ParameterValue, MAX_PARAMETERS>::new();
    for given in given {
        let refuse = |reason| ProvisionError::Set { given: given.clone(), reason };
        let (name, value) =
            given.split_once('=').ok_or_else(|| refuse("NAME=VALUE is expected".into()))?;
        let value = on_wire(name, value).map_err(refuse)?;
        values.retain(|it| it.parameter != value.parameter);
        values.push(value).map_err(|_| refuse(format!("more than {MAX_PARAMETERS} parameters")))?;
    }
    Ok(values)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::Folder;
    use std::fs;
    use ubimap_agent::flash::{SEED_LEN, UNPROVISIONED, WIRELESS_LEN, WITHOUT_NETWORK};

    fn options(image: PathBuf, set: &[&str]) -> ProvisionOptions {
        let set = set.iter().map(ToString::to_string).collect();
        let (wifi, wifi_password, server) = (None, None, None);
        let id = Some(7);
        ProvisionOptions { image, id, key: None, set, wifi, wifi_password, server, out: None }
    }

    #[test]
    fn an_image_is_provisioned_whole_or_not_at_all() {
        let folder = Folder::new("provision");
        let image = [&[1; 100][..], &UNPROVISIONED, &[2; 50]].concat();
        let path = folder.file("image.bin", &image);
        let key = folder.file("7.key", b"000102030405060708090a0b0c0d0e0f\n");
        #[cfg(unix)]
        {
            use std::os::unix::fs::PermissionsExt;
            fs::set_permissions(&key, fs::Permissions::from_mode(0o600)).unwrap();
        }
        for (set, said) in [
            ("hold", "NAME=VALUE"),
            ("speed=1", "there are mounting-x, mounting-y"),
            ("hold=60001", "from 0 to 60000"),
            ("hold=fast", "from 0 to 60000"),
        ] {
            let error = run(&options(path.clone(), &[set])).unwrap_err().to_string();
            assert!(error.contains(set) && error.contains(said), "{error}");
            assert_eq!(fs::read(&path).unwrap(), image);
        }
        let out = folder.path().join("robot.bin");
        let mut options = options(path.clone(), &["hold=5", "mounting-x=-20", "hold=6"]);
        (options.key, options.out) = (Some(key.clone()), Some(out.clone()));
        run(&options).unwrap();
        let written = fs::read(&out).unwrap();
        assert_eq!((&written[..100], &written[100 + SEED_LEN..]), (&image[..100], &[2; 50][..]));
        let record = Seed::parse(written[100..].first_chunk().unwrap()).unwrap().record;
        let bytes = core::array::from_fn(|at| at as u8);
        assert_eq!((record.robot.0, record.key.unwrap().bytes()), (7, &bytes));
        let values: Vec<_> = record.parameters.iter().map(|it| (it.parameter, it.value)).collect();
        assert_eq!(values, [(1, -20), (6, 6)]);
        assert!(record.boots > 1_700_000_000);
        // A wrong key changes nothing.
        fs::write(&key, "0001\n").unwrap();
        assert!(run(&options).unwrap_err().to_string().contains("32 hexadecimal digits"));
        assert_eq!(fs::read(&out).unwrap(), written);
    }

    #[test]
    fn an_image_with_a_radio_is_given_a_network() {
        let folder = Folder::new("provision-wifi");
        let image = [&UNPROVISIONED[..], &[1; 100], &WITHOUT_NETWORK, &[2; 50]].concat();
        let path = folder.file("image.bin", &image);
        let options = |wifi: &str, password: &str, server: &str| ProvisionOptions {
            wifi: Some(wifi.into()),
            wifi_password: Some(folder.file("password", password.as_bytes())),
            server: Some(server.parse().unwrap()),
            ..options(path.clone(), &[])
        };
        for (wifi, password, server, said) in [
            ("", "12345678", "10.0.0.1:4000", "1 to 32 bytes"),
            ("a name of more than thirty-two bytes", "12345678", "10.0.0.1:4000", "1 to 32 bytes"),
            ("lab", "short\n", "10.0.0.1:4000", "8 to 63 bytes"),
            ("lab", &"long".repeat(16), "10.0.0.1:4000", "8 to 63 bytes"),
            ("lab", "12345678", "0.0.0.0:4000", "can reach"),
            ("lab", "12345678", "10.0.0.1:0", "can reach"),
        ] {
            let error = run(&options(wifi, password, server)).unwrap_err().to_string();
            assert!(error.contains(said), "{error}");
            assert_eq!(fs::read(&path).unwrap(), image);
        }
        let lab = options("lab", "correct horse\n", "192.168.1.10:4000");
        let said = run(&lab).unwrap();
        assert!(said.contains("Wi-Fi lab to 192.168.1.10:4000"), "{said}");
        let written = fs::read(&path).unwrap();
        let at = SEED_LEN + 100;
        let wireless = Wireless::parse(written[at..].first_chunk().unwrap()).unwrap();
        assert_eq!((&wireless.name[..], &wireless.password[..]), ("lab", "correct horse"));
        assert_eq!(wireless.server.to_string(), "192.168.1.10:4000");
        assert_eq!(written[at + WIRELESS_LEN..], [2; 50]);
        // Other images have no place for it.
        fs::write(&path, UNPROVISIONED).unwrap();
        let error = run(&lab).unwrap_err().to_string();
        assert!(error.contains("cargo esp32c3"), "{error}");
        assert_eq!(fs::read(&path).unwrap(), UNPROVISIONED);
    }
}

//! `ubimap provision`: a robot's number, key and parameters in a firmware image.

mod image;
mod uf2;

use std::{
    path::{Path, PathBuf},
    time::{SystemTime, UNIX_EPOCH},
};

use clap::Args;
use ubimap_agent::{
    Parameter,
    flash::{Record, Seed},
};
use ubimap_protocol::{
    message::{MAX_PARAMETERS, ParameterValue},
    units::RobotId,
};

use self::image::ImageFault;
use super::keys::{self, KeysError};
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
            format!("robot {id}, {link}, parameters set: {}", record.parameters.len())
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

/// The parameters of `NAME=VALUE`s. Of two values of one parameter the last one counts.
fn parameters(
    given: &[String],
) -> Result<heapless::Vec<ParameterValue, MAX_PARAMETERS>, ProvisionError> {
    let mut values = heapless::Vec::<ParameterValue, MAX_PARAMETERS>::new();
    for given in given {
        let refuse = |reason| ProvisionError::Set { given: given.clone(), reason };
        let (name, value) =
            given.split_once('=').ok_or_else(|| refuse("NAME=VALUE is expected".into()))?;
        let known = Parameter::ALL.iter().find(|it| it.name() == name).ok_or_else(|| {
            let names: Vec<_> = Parameter::ALL.iter().map(|it| it.name()).collect();
            refuse(format!("there is no such parameter; there are {}", names.join(", ")))
        })?;
        let (least, most) = known.range();
        let value = value.parse().ok().filter(|value| (least..=most).contains(value));
        let value = value.ok_or_else(|| {
            refuse(format!("the value must be a whole number from {least} to {most}"))
        })?;
        let parameter = *known as u16;
        values.retain(|it| it.parameter != parameter);
        values
            .push(ParameterValue { parameter, value })
            .map_err(|_| refuse(format!("more than {MAX_PARAMETERS} parameters")))?;
    }
    Ok(values)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::Folder;
    use std::fs;
    use ubimap_agent::flash::{SEED_LEN, UNPROVISIONED};

    fn options(image: PathBuf, set: &[&str]) -> ProvisionOptions {
        let set = set.iter().map(ToString::to_string).collect();
        ProvisionOptions { image, id: Some(7), key: None, set, out: None }
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
}

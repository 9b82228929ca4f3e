//! The parameters that a robot has stored for its later starts, in a file beside its configuration.

use std::{
    collections::BTreeMap,
    io,
    path::{Path, PathBuf},
};

use ubimap_agent::Parameter;
use ubimap_protocol::message::ParameterValue;

use crate::{
    files,
    report::OutputFile,
    run::{RunError, bench::quantity::on_wire},
};

/// The first line of the file.
const HEAD: &str = "# stored by ubimap param; values as on the wire, SPEC section 6\n";

/// Parameters by name, with their values on the wire.
#[derive(Debug)]
pub(super) struct Stored {
    path: PathBuf,
    values: BTreeMap<String, i32>,
    /// Those of the configuration.
    configured: Vec<ParameterValue>,
}

impl Stored {
    /// Those of the robot with this configuration, which has these parameters itself; none if there is no file.
    ///
    /// # Errors
    /// [`RunError::Deployment`] if the file can't be read, or is not what was written.
    pub(super) fn beside(config: &Path, configured: Vec<ParameterValue>) -> Result<Self, RunError> {
        let path = config.with_extension("parameters");
        let refuse = |reason| RunError::Deployment { path: path.clone(), reason };
        let values: BTreeMap<String, i32> = match files::read_settings(&path) {
            Ok(text) => {
                toml::from_str(&text).map_err(|error| refuse(files::toml_fault(&error, &text)))?
            }
            Err(error) if error.kind() == io::ErrorKind::NotFound => BTreeMap::new(),
            Err(error) => return Err(refuse(error.to_string())),
        };
        for (name, value) in &values {
            on_wire(name, &value.to_string())
                .map_err(|reason| refuse(format!("{name}: {reason}")))?;
        }
        Ok(Self { path, values, configured })
    }

    /// What was stored, in a line; `None` if nothing was.
    pub(super) fn told(&self) -> Option<String> {
        let values = self.values.iter().map(|(name, value)| format!("{name} = {value}"));
        let values = values.collect::<Vec<_>>().join(", ");
        (!values.is_empty()).then(|| format!("stored in {}: {values}", self.path.display()))
    }

    /// The parameters.
    pub(super) fn values(&self) -> impl Iterator<Item = ParameterValue> {
        self.values.iter().filter_map(|(name, value)| on_wire(name, &value.to_string()).ok())
    }

    /// Stores some, in the place of their former values; those that are as in the configuration follow it.
    ///
    /// # Errors
    /// [`RunError`] if the file can't be written; then it is as before.
    pub(super) fn store(&mut self, present: &[ParameterValue]) -> Result<(), RunError> {
        let mut values = self.values.clone();
        for present in present {
            let known = Parameter::ALL.iter().find(|it| **it as u16 == present.parameter);
            // The robot's parameters are those that this program knows.
            let Some(known) = known else { continue };
            if self.configured.contains(present) {
                values.remove(known.name());
            } else {
                values.insert(known.name().to_owned(), present.value);
            }
        }
        // Numbers by names: serialising them can't fail.
        let text = HEAD.to_owned() + &toml::to_string(&values).unwrap_or_default();
        OutputFile::create(&self.path)?.finish(text.as_bytes())?;
        self.values = values;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::Folder;

    #[test]
    fn what_was_stored_is_there_at_the_next_start() {
        let folder = Folder::new("stored-parameters");
        let config = folder.path().join("robot-1.toml");
        let value = |parameter, value| ParameterValue { parameter, value };
        let stored = || Stored::beside(&config, vec![value(1, 100), value(6, 1_000)]);
        assert_eq!(stored().unwrap().values().count(), 0);
        stored().unwrap().store(&[value(1, 100), value(6, 300), value(4, 40)]).unwrap();
        stored().unwrap().store(&[value(1, 130), value(6, 1_000)]).unwrap();
        let values: Vec<_> = stored().unwrap().values().collect();
        assert_eq!(values, [value(4, 40), value(1, 130)]);

        for (text, told) in [
            (
                "mounting-x = 2001\n",
                "mounting-x: the value must be a whole number from -2000 to 2000",
            ),
            ("speed = 1\n", "speed: there is no parameter \"speed\""),
            ("hold = \n", "line 1"),
        ] {
            folder.file("robot-1.parameters", text.as_bytes());
            let error = stored().unwrap_err().to_string();
            assert!(error.contains("robot-1.parameters") && error.contains(told), "{error}");
        }
    }
}

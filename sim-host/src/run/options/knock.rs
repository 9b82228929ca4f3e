//! `--knock CAMERA@S:X,Y,Z,HEADING,TILT,ROLL`.

use std::str::FromStr;

use crate::world::KnockConfig;

/// A knock of one simulated camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Knock {
    /// The camera's index.
    pub camera: usize,
    /// The movement.
    pub knock: KnockConfig,
}

/// The text is no knock.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "give camera, time, shift in metres and turn in degrees, such as 1@30:0.03,0,0,0,2,0 \
     (CAMERA@SECONDS:X,Y,Z,HEADING,TILT,ROLL)"
)]
pub struct NotAKnock;

impl FromStr for Knock {
    type Err = NotAKnock;

    fn from_str(text: &str) -> Result<Self, NotAKnock> {
        let (camera, rest) = text.split_once('@').ok_or(NotAKnock)?;
        let (at_s, way) = rest.split_once(':').ok_or(NotAKnock)?;
        let number = |text: &str| text.trim().parse::<f64>().map_err(|_| NotAKnock);
        let way: Vec<f64> = way.split(',').map(number).collect::<Result<_, _>>()?;
        let [x, y, z, heading_deg, tilt_deg, roll_deg] = way[..] else { return Err(NotAKnock) };
        let (at_s, shift_m, over_s) = (number(at_s)?, [x, y, z], 0.0);
        let camera = camera.trim().parse().map_err(|_| NotAKnock)?;
        let knock = KnockConfig { at_s, over_s, shift_m, heading_deg, tilt_deg, roll_deg };
        Ok(Self { camera, knock })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_knock_has_a_camera_a_time_and_six_numbers() {
        let Knock { camera, knock } = "2@30.5:0.03,0,-0.01,1,-2,0.5".parse().unwrap();
        assert_eq!((camera, knock.at_s, knock.shift_m), (2, 30.5, [0.03, 0.0, -0.01]));
        assert_eq!([knock.heading_deg, knock.tilt_deg, knock.roll_deg], [1.0, -2.0, 0.5]);
        for wrong in ["", "1", "1@3", "1:0,0,0,0,0,0", "1@3:0,0,0,0,0", "x@3:0,0,0,0,0,0"] {
            assert_eq!(wrong.parse::<Knock>(), Err(NotAKnock), "{wrong}");
        }
    }
}

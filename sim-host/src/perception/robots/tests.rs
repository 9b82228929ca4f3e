use ubimap_protocol::time::Duration;

use super::{super::markers::rendering::*, *};
use crate::{camera::Picture, perception::markers::Hue};

const SIDE_M: f64 = 0.1;
const HEIGHT_M: f64 = 0.3;
const FRAME: Duration = Duration(66_667);

fn tag(number: u16) -> (Identifier, Mount) {
    (Identifier::Tag(number), Mount::centred(RobotId(number), SIDE_M, HEIGHT_M))
}

fn plate(number: usize, pose: [f64; 3]) -> Plate {
    Plate::level(Paint::Tag(number), SIDE_M, HEIGHT_M, pose)
}

fn camera(lens: Lens) -> Calibration {
    Calibration { picture: Some(lens), ..Calibration::default() }
}

fn frame(number: u64, camera: usize, lens: &Lens, plates: &[Plate]) -> Frame {
    let captured = Instant(1_000_000 + number * FRAME.micros());
    let picture = Some(render_grey(lens, plates, 4.0, number));
    Frame { camera, captured, depth: None, picture }
}

/// The sightings in a frame that arrives without delay.
fn observe(localiser: &mut Localiser, frame: &Frame) -> Vec<Sighting> {
    localiser.observe(frame, frame.captured)
}

fn events(localiser: &mut Localiser) -> Vec<SightingEvent> {
    core::iter::from_fn(|| localiser.poll_event()).map(|(_, event)| event).collect()
}

/// The pose, at the given frame, of a robot that drives in a circle at 0.5 m/s.
fn circling(number: f64, radius: f64) -> [f64; 3] {
    let angle = 0.5 * number * FRAME.micros() as f64 / 1e6 / radius;
    let heading = angle + core::f64::consts::FRAC_PI_2;
    [radius * libm::cos(angle), radius * libm::sin(angle), heading]
}

fn error(sighting: &Sighting, [x, y, heading]: [f64; 3]) -> (f64, f64) {
    let turn = sighting.pose.heading.radians() - heading;
    let turn = (turn + core::f64::consts::PI).rem_euclid(core::f64::consts::TAU);
    let away = (sighting.pose.x.metres() - x).hypot(sighting.pose.y.metres() - y);
    (away, (turn - core::f64::consts::PI).to_degrees())
}

#[test]
fn robots_under_two_cameras_are_located_and_never_confused() {
    let lenses =
        [ceiling_camera([-0.3, 0.0, 2.8], 0.0, 1.6), ceiling_camera([0.4, 0.3, 2.8], 0.15, -1.5)];
    let mut localiser = Localiser::new(&lenses.map(camera), (1..=4).map(tag)).unwrap();
    let mut found = [0; 4];
    let (mut squares, mut count) = ((0.0, 0.0), 0.0);
    for number in 0..30 {
        // The second camera captures half a frame later.
        let moment = number as f64 / 2.0;
        let index = number as usize % 2;
        let at = |robot: usize| {
            let [x, y, heading] = circling(moment, 0.3);
            [x + 0.5 * (robot as f64 - 1.5), y + 0.2 * (robot % 2) as f64, heading]
        };
        let plates: Vec<Plate> = (0..4).map(|robot| plate(robot + 1, at(robot))).collect();
        let mut frame = frame(0, index, &lenses[index], &plates);
        frame.captured = Instant(1_000_000 + number * FRAME.micros() / 2);
        for sighting in observe(&mut localiser, &frame) {
            let robot = usize::from(sighting.robot.0) - 1;
            let (away, turn) = error(&sighting, at(robot));
            assert!(away < 0.03 && turn.abs() < 3.0, "{sighting:?}");
            squares = (squares.0 + away * away, squares.1 + turn * turn);
            count += 1.0;
            found[robot] += 1;
        }
    }
    let (away, turn) = ((squares.0 / count).sqrt(), (squares.1 / count).sqrt());
    println!("{count} poses: RMSE {:.1} mm, {turn:.2} degrees", 1000.0 * away);
    assert!(away < 0.01 && turn < 0.5 && found == [30; 4], "{found:?}");
    assert_eq!(events(&mut localiser), []);
}

#[test]
fn a_marker_without_a_pose_is_reported_once() {
    let lens = ceiling_camera([0.0, 0.0, 2.8], 0.0, 0.0);
    let mut localiser = Localiser::new(&[camera(lens)], [tag(1), tag(2), tag(3)]).unwrap();
    let mut sloping = plate(2, [0.5, -0.6, 1.0]);
    sloping.rise_m = 0.03;
    let mut poses = 0;
    for number in 0..30 {
        let twins = [plate(3, [-0.4, 0.3, 0.2]), plate(3, [0.6, 0.5, 0.2])];
        // Number 9 is not registered.
        let plates = [plate(1, [0.0, -0.3, 0.0]), sloping, plate(9, [0.0, 0.7, 0.0])];
        let plates: Vec<Plate> = plates.into_iter().chain(twins).collect();
        let sightings = observe(&mut localiser, &frame(number, 0, &lens, &plates));
        assert!(sightings.iter().all(|it| it.robot == RobotId(1)), "{sightings:?}");
        poses += sightings.len();
    }
    assert_eq!(poses, 30);
    let mut events = events(&mut localiser);
    events.sort_unstable();
    assert_eq!(
        events,
        [
            SightingEvent::Unregistered(Identifier::Tag(9)),
            SightingEvent::SeenTwice(RobotId(3)),
            SightingEvent::NotLevel(RobotId(2)),
        ]
    );
}

#[test]
fn a_robot_that_was_carried_away_is_accepted_after_a_second() {
    let lens = ceiling_camera([0.0, 0.0, 2.8], 0.0, 0.0);
    let mut localiser = Localiser::new(&[camera(lens)], [tag(1)]).unwrap();
    let (here, there) = ([-0.5, -0.5, 0.0], [0.7, 0.6, 2.0]);
    let mut at = |number: u64, pose: Option<[f64; 3]>| {
        let plates: Vec<Plate> = pose.into_iter().map(|pose| plate(1, pose)).collect();
        let sightings = observe(&mut localiser, &frame(number, 0, &lens, &plates));
        (sightings.len(), events(&mut localiser))
    };
    for number in 0..4 {
        assert_eq!(at(number, Some(here)), (1, vec![]));
    }
    // The robot is occluded for a while.
    for number in 4..9 {
        assert_eq!(at(number, None), (0, vec![]));
    }
    assert_eq!(at(9, Some(here)), (1, vec![]));
    let mut told = Vec::new();
    let poses: Vec<usize> = (10..40)
        .map(|number| {
            let (poses, events) = at(number, Some(there));
            told.extend(events);
            poses
        })
        .collect();
    assert_eq!(told, [SightingEvent::Jumped(RobotId(1))]);
    let first = poses.iter().position(|&it| it == 1).unwrap();
    assert!((8..=24).contains(&first), "{poses:?}");
    assert!(poses[first..].iter().all(|&it| it == 1), "{poses:?}");
}

#[test]
fn late_frames_are_used_and_future_or_very_old_ones_ignored() {
    let lens = ceiling_camera([0.0, 0.0, 2.8], 0.0, 0.0);
    let cameras = [camera(lens), camera(lens)];
    let mut localiser = Localiser::new(&cameras, [tag(1)]).unwrap();
    let plates = [plate(1, [0.3, 0.1, 0.4])];
    let of = |number, camera| frame(number, camera, &lens, &plates);
    let now = of(40, 0).captured;
    assert_eq!(localiser.observe(&of(41, 0), now), []);
    assert_eq!(localiser.observe(&of(90, 0), now), []);
    assert_eq!(events(&mut localiser), [SightingEvent::ClockAhead { camera: 0 }]);
    let [alone] = localiser.observe(&of(39, 0), now)[..] else { panic!("in view") };
    assert_eq!(localiser.observe(&of(2, 1), now), [], "two seconds late");
    assert_eq!(localiser.observe(&of(38, 1), now), [], "late: contributes to the next pose");
    let [joined] = localiser.observe(&of(40, 0), now)[..] else { panic!("in view") };
    for sighting in [alone, joined] {
        let (away, turn) = error(&sighting, [0.3, 0.1, 0.4]);
        assert!(away < 0.002 && turn.abs() < 0.5, "{sighting:?}");
    }
    // An older frame of the same camera.
    assert_eq!(localiser.observe(&of(38, 0), now), []);
    assert_eq!(events(&mut localiser), []);
}

/// Prints the time of a frame:
/// `cargo test --release -p ubimap-sim-host --lib in_a_second_of_frames -- --ignored --nocapture`
#[test]
#[ignore = "takes half a minute; its times hold on an idle machine, in release mode"]
fn ten_robots_are_found_in_a_second_of_frames() {
    let lens = ceiling_camera([0.0, 0.0, 2.8], 0.15, 1.5);
    let mut localiser = Localiser::new(&[camera(lens)], (0..10).map(tag)).unwrap();
    let at = |robot: usize, number: u64| {
        let y = if robot.is_multiple_of(2) { 0.0 } else { 0.5 };
        let x = 0.28 * robot as f64 - 1.3 + 0.01 * number as f64;
        plate(robot, [x, y, robot as f64])
    };
    let frames: Vec<Frame> = (0..30)
        .map(|number| {
            let plates: Vec<Plate> = (0..10).map(|robot| at(robot, number)).collect();
            let mut frame = frame(number, 0, &lens, &[]);
            frame.picture = Some(Picture::Colour(render(&lens, &plates, 5.0, number)));
            frame
        })
        .collect();
    let (mut times, mut found) = (Vec::new(), 0);
    for frame in &frames {
        let began = std::time::Instant::now();
        found += observe(&mut localiser, frame).len();
        times.push(began.elapsed().as_secs_f64() * 1000.0);
    }
    let mean = times.iter().sum::<f64>() / times.len() as f64;
    times.sort_by(f64::total_cmp);
    let (median, most) = (times[times.len() / 2], times[times.len() - 1]);
    println!("windows {median:.1} ms, everywhere up to {most:.1} ms, mean {mean:.1} ms a frame");
    assert_eq!(found, 300);
}

#[test]
fn colour_markers_are_as_accurate_and_need_a_colour_camera() {
    let lens = ceiling_camera([0.2, -0.3, 2.8], 0.15, 1.5);
    let pairs = [(Hue::Red, Hue::Blue), (Hue::Green, Hue::Magenta), (Hue::Cyan, Hue::Yellow)];
    let markers = pairs.iter().zip(1..).map(|(&(head, tail), robot)| {
        (Identifier::Colours { head, tail }, Mount::centred(RobotId(robot), 0.2, HEIGHT_M))
    });
    let mut localiser = Localiser::new(&[camera(lens)], markers).unwrap();
    let (mut squares, mut count) = ((0.0, 0.0), 0.0);
    for number in 0..20 {
        let at = |robot: usize| {
            let [x, y, heading] = circling(number as f64, 0.25 + 0.05 * robot as f64);
            [x + 0.4 * robot as f64 - 0.2, y, heading + robot as f64]
        };
        let plates = pairs.iter().enumerate().map(|(robot, &(head, tail))| {
            Plate::level(Paint::Colours(head, tail), 0.2, HEIGHT_M, at(robot))
        });
        let plates: Vec<Plate> = plates.collect();
        let mut frame = frame(number, 0, &lens, &[]);
        frame.picture = Some(Picture::Colour(render(&lens, &plates, 8.0, number)));
        let sightings = observe(&mut localiser, &frame);
        for sighting in &sightings {
            let (away, turn) = error(sighting, at(usize::from(sighting.robot.0) - 1));
            assert!(away < 0.03 && turn.abs() < 3.0, "{sighting:?}");
            squares = (squares.0 + away * away, squares.1 + turn * turn);
            count += 1.0;
        }
        assert_eq!(sightings.len(), 3);
    }
    let (away, turn) = ((squares.0 / count).sqrt(), (squares.1 / count).sqrt());
    println!("{count} poses: RMSE {:.1} mm, {turn:.2} degrees", 1000.0 * away);
    assert!(away < 0.01 && turn < 0.5);
    assert_eq!(events(&mut localiser), []);
}

#[test]
fn indistinguishable_markers_are_refused() {
    let colours = |robot, head, tail| {
        (Identifier::Colours { head, tail }, Mount::centred(RobotId(robot), 0.2, 0.3))
    };
    let of =
        |markers: &[(Identifier, Mount)]| Localiser::new(&[], markers.iter().copied()).map(|_| ());
    assert_eq!(of(&[tag(1), tag(2), colours(3, Hue::Red, Hue::Blue)]), Ok(()));
    let (mut same, turned) = (tag(1), colours(4, Hue::Blue, Hue::Red));
    same.1.robot = RobotId(2);
    assert_eq!(of(&[tag(1), same]), Err(RegistryError::Twice(RobotId(1), RobotId(2))));
    assert_eq!(
        of(&[colours(3, Hue::Red, Hue::Blue), turned]),
        Err(RegistryError::Twice(RobotId(3), RobotId(4)))
    );
    assert_eq!(of(&[colours(3, Hue::Red, Hue::Red)]), Err(RegistryError::OneColour(RobotId(3))));
    same.1.height_m = f64::NAN;
    assert_eq!(of(&[same]), Err(RegistryError::Mount(RobotId(2))));
}

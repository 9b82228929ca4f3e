//! A view, drawn with characters: the robot's x axis points up.

use super::view::View;

/// Size of a picture in characters. A character is about twice as high as it is wide.
const WIDTH: usize = 65;
const HEIGHT: usize = 26;
/// The least and the greatest distance from the robot to a picture's border, in metres.
const LEAST: f64 = 0.5;
const MOST: f64 = 5.4;

/// Draws a view: `#` what is seen, `.` what is free before it, `^` the robot.
pub(super) fn draw(view: &View) -> String {
    let is_around = view.from_to.iter().any(|bearing| bearing.abs() > 2.0);
    let farthest = |axis: usize| view.points().map(|point| point[axis].abs()).fold(0.0, f64::max);
    let [ahead, aside] = [farthest(0), farthest(1)].map(|it| (1.05 * it).clamp(LEAST, MOST));
    // The row of the robot, and metres per row; a column is half as wide.
    let base = if is_around { HEIGHT / 2 } else { HEIGHT - 1 };
    let per_row = (ahead / base as f64).max(aside / (WIDTH as f64 / 4.0));
    let place = |x: f64, y: f64| {
        let row = base as f64 - x / per_row;
        let column = (WIDTH / 2) as f64 - 2.0 * y / per_row;
        let (row, column) = (row.round(), column.round());
        let is_inside =
            (0.0..HEIGHT as f64).contains(&row) && (0.0..WIDTH as f64).contains(&column);
        is_inside.then_some((row as usize, column as usize))
    };
    let mut rows = vec![[b' '; WIDTH]; HEIGHT];
    for &(bearing, distance) in &view.seen {
        let (sin, cos) = (libm::sin(bearing), libm::cos(bearing));
        let steps = (distance / per_row * 2.0) as usize;
        for step in 0..steps {
            let part = distance * step as f64 / steps as f64;
            if let Some((row, column)) = place(part * cos, part * sin) {
                rows[row][column] = b'.';
            }
        }
    }
    for [x, y] in view.points() {
        if let Some((row, column)) = place(x, y) {
            rows[row][column] = b'#';
        }
    }
    if let Some((row, column)) = place(0.0, 0.0) {
        rows[row][column] = b'^';
    }
    let mut picture = String::new();
    for (index, row) in rows.iter().enumerate() {
        let metres = (base as f64 - index as f64) * per_row;
        let is_named = (base as i64 - index as i64) % 5 == 0;
        let name = if is_named { format!("{metres:5.2} m ") } else { "        ".into() };
        let text: String = row.iter().map(|&byte| char::from(byte)).collect();
        picture += &format!("{name}|{}\n", text.trim_end());
    }
    picture
}

/// A view in words: how far it is free ahead, what is nearest, and how many columns there are.
pub(super) fn described(view: &View) -> String {
    let at = |bearing: f64| {
        let degrees = bearing.to_degrees();
        match degrees.round() {
            0.0 => "ahead".to_owned(),
            left if left > 0.0 => format!("{left:.0} degrees to the left"),
            right => format!("{:.0} degrees to the right", -right),
        }
    };
    let [from, to] = view.from_to.map(f64::to_degrees);
    let columns = format!(
        "{} columns from {from:.0} to {to:.0} degrees, {} without a return",
        view.columns,
        view.columns - view.seen.len()
    );
    let nearest = view.seen.iter().min_by(|a, b| a.1.total_cmp(&b.1));
    let middle = view.seen.iter().min_by(|a, b| a.0.abs().total_cmp(&b.0.abs()));
    match (middle, nearest) {
        (Some(&(bearing, distance)), Some(&(near_at, nearest))) => format!(
            "{distance:.2} m {}; nearest {nearest:.2} m {}; {columns}",
            at(bearing),
            at(near_at)
        ),
        _ => format!("nothing is seen; {columns}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wall_ahead_is_at_the_top_and_one_to_the_left_at_the_left() {
        let degrees = |from: i32, to: i32| (from..=to).map(|it| f64::from(it).to_radians());
        let ahead = degrees(-30, 30).map(|bearing| (bearing, 1.5 / bearing.cos()));
        let view = View { seen: ahead.collect(), columns: 61, from_to: [-0.52, 0.52] };
        let picture = draw(&view);
        let rows: Vec<&str> = picture.lines().collect();
        assert_eq!(rows.len(), HEIGHT);
        let walls: Vec<usize> =
            (0..HEIGHT).filter(|&row| rows[row].matches('#').count() > 20).collect();
        assert_eq!(walls.len(), 1, "{picture}");
        assert!(walls[0] < 6 && rows[HEIGHT - 1].contains('^'), "{picture}");

        let left = degrees(60, 120).map(|bearing| (bearing, 1.0));
        let view = View { seen: left.collect(), columns: 61, from_to: [1.0, 2.1] };
        let picture = draw(&view);
        for row in picture.lines().filter(|row| row.contains('#')) {
            assert!(row.find('#') < Some(9 + WIDTH / 2), "{picture}");
        }
        assert!(described(&view).contains("60 degrees to the left"), "{}", described(&view));
        assert!(described(&View::default()).starts_with("nothing is seen"));
        draw(&View::default());
    }
}

//! Nothing grows while robots draw the same room for hours, whatever happens to them.
//!
//! ```text
//! cargo soak                         eight hours of simulated time
//! UBIMAP_SOAK_HOURS=1 cargo soak
//! ```

use std::{env, fs, path::Path};

use ubimap_protocol::time::Duration;
use ubimap_tests::schedule::{Row, Soak};

/// Simulated time in hours, unless set by `UBIMAP_SOAK_HOURS`.
const HOURS: u64 = 8;
const SEED: u64 = 18;
/// Maximum number of epochs that the server holds of a tile.
const EPOCHS: usize = 3;
/// The server's estimate of the memory of a tile with that many epochs, in bytes.
const TILE_MEMORY: usize = 8_064;
/// Bytes on disk that SQLite may take for itself, about 1 %: a cure deletes rows, and the rows that
/// follow may not fit into the pages that become free.
const PAGES: u64 = 48 << 10;
/// Resident memory that the allocator may keep for itself, in bytes.
const SLACK: u64 = 1 << 20;

/// Flat means: in the second half of the time the number of tiles never exceeds its maximum in the
/// first half, nor the disk by more than a few pages, nor the resident memory by more than a
/// mebibyte; and at any time a tile takes at most three epochs and their memory. In every calm all
/// maps converge and all tiles are stored; and in the calms that are measured no message waits.
#[test]
#[ignore = "long: cargo soak"]
fn nothing_grows_in_eight_hours() {
    let hours = env::var("UBIMAP_SOAK_HOURS").map_or(HOURS, |hours| hours.parse().unwrap());
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("soak");
    let _ = fs::remove_dir_all(&folder);
    fs::create_dir_all(&folder).unwrap();
    println!("{}", Row::HEAD);
    let soak = Soak::of(SEED, Duration::from_secs(3_600 * hours));
    let rows = soak.run(&folder.join("map.db"), |row| println!("{row}")).unwrap();
    for Row { tiles, epochs, memory, .. } in &rows {
        assert!(*epochs <= EPOCHS * tiles, "{epochs} epochs of {tiles} tiles");
        assert!(*memory <= TILE_MEMORY * tiles, "{memory} bytes for {tiles} tiles");
    }
    let (first, last) = rows.split_at(rows.len() / 2);
    let check_flat = |what: &str, value: fn(&Row) -> u64, slack: u64| {
        let most = |rows: &[Row]| rows.iter().map(value).max().unwrap();
        let [first, last] = [first, last].map(most);
        assert!(last <= first + slack, "{what} has grown from at most {first} to {last}");
    };
    check_flat("the number of tiles", |row| row.tiles as u64, 0);
    check_flat("the disk", |row| row.disk, PAGES);
    check_flat("the resident memory", |row| row.resident, SLACK);
    let begun = rows.last().unwrap().begun;
    assert!(begun > 1_000 * hours as u32, "robots have given up few tiles: {begun} epochs");
}

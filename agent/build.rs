//! Chooses the folder whose `memory.x` links an image for a Cortex-M: the chip follows from a feature or the target.

use std::env;

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    let has = |feature: &str| env::var_os(format!("CARGO_FEATURE_{feature}")).is_some();
    let [folder, target] =
        ["CARGO_MANIFEST_DIR", "TARGET"].map(|name| env::var(name).expect("cargo sets it"));
    let chip = match target.as_str() {
        _ if has("PICO") => "rp2040",
        _ if has("PICO2") => "rp2350",
        "thumbv8m.main-none-eabihf" => "mps2_an505",
        _ if target.starts_with("thumb") => "stm32f405",
        _ => return,
    };
    println!("cargo::rerun-if-changed=memory/{chip}/memory.x");
    println!("cargo::rustc-link-search={folder}/memory/{chip}");
}

#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| ubimap_fuzz::parameters(data));

//! Stops the build with a clear word where the page, which is built into the binary, is missing.

fn main() {
    println!("cargo::rerun-if-changed=../web/dist");
    if !std::path::Path::new("../web/dist/index.html").exists() {
        println!("cargo::error=web/dist is missing: run `make web`");
    }
}

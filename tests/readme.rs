//! The README's map is true: what it names exists, and what exists at the top is named.

use std::path::Path;
use std::process::Command;

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("tests/ lies in the repository")
}

/// The lines of the map: indented by four, or by six under a folder's `src/`.
fn map() -> Vec<String> {
    let readme = std::fs::read_to_string(root().join("README.md")).expect("README.md");
    let section = readme.split("## The map of the house").nth(1).expect("the map");
    let section = section.split("\n## ").next().expect("its text");
    section.lines().filter(|line| line.starts_with("    ")).map(str::to_string).collect()
}

#[test]
fn every_place_on_the_map_exists() {
    let mut folder = String::new();
    let mut checked = 0;
    for line in map() {
        // Names end where two spaces begin the explanation.
        let names = line.trim_start().split("  ").next().expect("names").to_string();
        for name in names.split(", ").map(str::trim) {
            let inside = line.starts_with("      ");
            let path = match (inside, name.starts_with("src/")) {
                (false, _) => name.to_string(),
                (true, true) => format!("{folder}{name}"),
                (true, false) => format!("{folder}src/{name}"),
            };
            assert!(root().join(&path).exists(), "the README's map names {path}, which does not exist");
            checked += 1;
            if !inside {
                folder = path;
            }
        }
    }
    assert!(checked > 15, "only {checked} places on the map");
}

#[test]
fn every_top_level_folder_is_on_the_map() {
    let listed = Command::new("git").args(["ls-tree", "-d", "--name-only", "HEAD"]).current_dir(root()).output();
    let listed = String::from_utf8(listed.expect("git").stdout).expect("UTF-8");
    let map = map().join("\n");
    for folder in listed.lines().filter(|folder| !folder.starts_with('.')) {
        assert!(map.contains(&format!("    {folder}/")), "{folder}/ is not on the README's map");
    }
}

//! Defects, sections, the change between runs and the report, from outside: simulated runs with known features are
//! processed by the real binary, and programs that we did not write read what it made.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

use serde_json::Value;
use stria_tests::support::run_stria;
use tempfile::TempDir;

/// A simulated run with its products.
struct Made {
    folder: TempDir,
}

/// Where the runs begin on their asset, mm.
const CHAINAGE_MM: f64 = 12000.0;
/// The operator's codes of these tests.
const CODES: &str = "defects.codes=dent=BAA; bulge=BAA; dent.severe=BAA A";

impl Made {
    /// Simulates a scene and processes it.
    fn new(scene: &str, options: &[&str]) -> Made {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let (run, products) = (folder.path().join("run"), folder.path().join("products"));
        let mut simulate = vec!["simulate", scene, "--out", text(&run)];
        simulate.extend(options);
        succeed(&simulate, &[0]);
        let made = Made { folder };
        made.process(&products, "depth,texture,defects,report", &["--set", CODES]);
        made
    }

    /// The same wall seen on the way back, by a camera that has turned half about its axis: the pictures turned so, the last
    /// one first. The world's x then counts from where the run ended.
    fn on_the_way_back(&self) -> Made {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let (run, back) = (self.folder.path().join("run"), folder.path().join("run"));
        std::fs::create_dir(&back).expect("a folder");
        let status = Command::new("ffmpeg")
            .args(["-v", "error", "-i", text(&run.join("video.mp4")), "-vf", "hflip,vflip,reverse", "-crf", "14"])
            .arg(back.join("video.mp4"))
            .status();
        assert!(status.expect("ffmpeg is missing: `make setup` installs it").success());
        let rig = std::fs::read_to_string(run.join("rig.toml")).expect("a rig");
        let turned = rig.lines().map(|line| match line.strip_prefix("plane_normal = [") {
            Some(values) => {
                let values: Vec<f64> =
                    values.trim_end_matches(']').split(", ").map(|v| v.parse().expect("a number")).collect();
                format!("plane_normal = [{:?}, {:?}, {:?}]\n", -values[0], -values[1], values[2])
            }
            None => format!("{line}\n"),
        });
        std::fs::write(back.join("rig.toml"), turned.collect::<String>()).expect("written");
        let trajectory = std::fs::read_to_string(run.join("truth/trajectory.csv")).expect("a trajectory");
        let column = trajectory.lines().next().expect("a header").split(',').position(|name| name == "x_mm");
        let last = trajectory.lines().last().expect("a row").split(',').nth(column.expect("x_mm")).expect("x_mm");
        let start_mm = CHAINAGE_MM + last.parse::<f64>().expect("a number");
        let made = Made { folder };
        let chainage = format!("--chainage-mm={start_mm}");
        made.process_at(&made.products(), "depth,defects", &[&chainage, "--direction", "backward"]);
        made
    }

    /// Processes the run, from [`CHAINAGE_MM`] on, into a folder.
    fn process(&self, out: &Path, groups: &str, options: &[&str]) {
        let chainage = format!("--chainage-mm={CHAINAGE_MM}");
        self.process_at(out, groups, &[&[chainage.as_str()], options].concat());
    }

    fn process_at(&self, out: &Path, groups: &str, options: &[&str]) {
        let run = self.folder.path().join("run");
        let (video, rig) = (run.join("video.mp4"), run.join("rig.toml"));
        let mut process = vec!["process", text(&video), "--rig", text(&rig), "--out", text(out), "--only", groups];
        process.extend(["--asset", "Tunnel <3>"]);
        process.extend(options);
        succeed(&process, &[0, 3]);
    }

    fn products(&self) -> PathBuf {
        self.folder.path().join("products")
    }

    fn list(&self) -> Value {
        json(&self.products().join("defects.json"))
    }

    fn defects(&self) -> Vec<Value> {
        self.list()["defects"].as_array().expect("a list").clone()
    }

    fn truth(&self) -> Value {
        json(&self.folder.path().join("run/truth/surface.json"))
    }
}

fn text(path: &Path) -> &str {
    path.to_str().expect("a plain path")
}

fn json(path: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(path).expect("the file")).expect("JSON")
}

fn succeed(arguments: &[&str], codes: &[i32]) {
    let output = run_stria(arguments);
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.code().is_some_and(|code| codes.contains(&code)), "stria {arguments:?}: {said}");
}

fn number(value: &Value, field: &str) -> f64 {
    value[field].as_f64().unwrap_or_else(|| panic!("{field} in {value:#}"))
}

fn damaged() -> &'static Made {
    static MADE: OnceLock<Made> = OnceLock::new();
    MADE.get_or_init(|| Made::new("damaged", &["--seconds", "3.4", "--seed", "51"]))
}

#[test]
fn every_known_defect_is_found_with_its_kind_and_figures_and_nothing_else() {
    let made = damaged();
    let defects = made.defects();
    let truth = made.truth();
    let features: Vec<&Value> = truth["features"].as_array().expect("features").iter().collect();
    assert_eq!(defects.len(), features.len(), "{defects:#?}");
    for feature in features {
        let apart =
            |d: &Value| (number(d, "x_mm") - number(feature, "x")).hypot(number(d, "y_mm") - number(feature, "y"));
        let found = defects.iter().min_by(|a, b| apart(a).total_cmp(&apart(b))).expect("some");
        assert!(apart(found) < 5.0, "{feature} is {} mm off: {found:#}", apart(found));
        let (depth, height) = (number(found, "depth_mm"), number(feature, "height"));
        assert!((depth - height).abs() < f64::max(0.3, 0.1 * height.abs()), "{height} mm: {found:#}");
        assert!((depth - height).abs() < 3.0 * number(found, "depth_sd_mm"), "{height} mm: {found:#}");
        let (kind, area) = match (feature["kind"].as_str(), height > 0.0) {
            (Some("bump"), dent) => {
                (if dent { "dent" } else { "bulge" }, std::f64::consts::PI * number(feature, "r").powi(2))
            }
            (_, lowered) => {
                let area = 4.0 * number(feature, "half_x") * number(feature, "half_y");
                (
                    if !lowered {
                        "step"
                    } else if height > 15.0 {
                        "hole"
                    } else {
                        "missing_material"
                    },
                    area,
                )
            }
        };
        assert_eq!(found["kind"], kind, "{found:#}");
        assert!((number(found, "area_mm2") / area - 1.0).abs() < 0.15, "{area} mm²: {found:#}");
        assert!((number(found, "chainage_mm") - number(found, "x_mm") - CHAINAGE_MM).abs() < 0.01);
        let code = match (kind, found["severity"].as_str()) {
            ("dent", Some("severe")) => "BAA A".into(),
            ("dent" | "bulge", _) => "BAA".into(),
            _ => Value::Null,
        };
        assert_eq!(found["code"], code, "{found:#}");
    }
}

#[test]
fn foreign_programs_read_the_list_the_sections_and_the_residual_map() {
    let root = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("..");
    let python = root.join("target/python/bin/python");
    assert!(python.exists(), "{} is missing: `make setup` installs it", python.display());
    let script = root.join("tests/readers/defects.py");
    let output = Command::new(&python).arg(script).arg(damaged().products()).output().expect("Python starts");
    let said = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    assert!(output.status.success(), "{}{}", said(&output.stdout), said(&output.stderr));
}

#[test]
fn a_sound_wall_gives_an_empty_list_also_under_a_gait() {
    for motion in ["wheels", "gait"] {
        let made = Made::new(
            "sound",
            &["--seconds", "2.5", "--fps", "20", "--size", "960x540", "--seed", "31", "--motion", motion],
        );
        let list = made.list();
        assert_eq!(made.defects(), Vec::<Value>::new(), "{motion}");
        let limit = number(&list, "detection_limit_mm");
        assert!(limit > 0.3 && limit < 3.0, "{motion}: {limit} mm");
        let report = std::fs::read_to_string(made.products().join("report.html")).expect("a report");
        assert!(report.contains("No defect above the detection limit"));
    }
}

#[test]
fn a_pipe_s_radius_and_ovality_are_measured() {
    for (scene, ovality) in [("pipe-oval", 1.0), ("pipe-steady", 0.0)] {
        let made = Made::new(
            scene,
            &["--seconds", "2.5", "--fps", "20", "--size", "960x540", "--motion", "steady", "--seed", "42"],
        );
        let reference = made.list()["reference"].clone();
        assert_eq!(reference["kind"], "cylinder");
        // From the arc alone, with what is said about how sure that is.
        let (found, sd) = (number(&reference, "ovality_percent"), number(&reference, "ovality_sd_percent"));
        assert!((found - ovality).abs() < f64::max(0.3, 3.0 * sd) && sd < 0.5, "{ovality} %: {reference:#}");
        if ovality == 0.0 {
            let radius = number(&reference, "radius_mm");
            assert!((radius / 300.0 - 1.0).abs() < 0.002, "{radius} mm");
        }
        // With the radius as built.
        let known = made.folder.path().join("known");
        made.process(&known, "defects", &["--set", "defects.nominal_radius_mm=300"]);
        let reference = json(&known.join("defects.json"))["reference"].clone();
        let (found, sd) = (number(&reference, "ovality_percent"), number(&reference, "ovality_sd_percent"));
        assert!((found - ovality).abs() < 0.2 && sd < 0.1, "{ovality} %: {reference:#}");
    }
}

#[test]
fn two_runs_show_what_became_of_the_wall_and_nothing_else_whichever_way_they_went() {
    let run = |seed: &str, later: bool| {
        let mut options = vec!["--seconds", "2.6", "--seed", seed, "--wall-seed", "7"];
        options.extend(later.then_some("--later"));
        Made::new("wall", &options)
    };
    let (first, again, later) = (run("61", false), run("62", false), run("63", true));
    let changes = |a: &Made, b: &Made| {
        let out = b.folder.path().join("change");
        succeed(&["compare", text(&a.products()), text(&b.products()), "--out", text(&out)], &[0]);
        json(&out.join("change.json"))
    };
    let same = changes(&first, &again);
    assert_eq!(same["changes"], Value::Array(Vec::new()), "the same wall, measured twice");
    assert!(same["unchanged"].as_array().is_some_and(|all| all.len() > 3), "{same:#}");

    let (before, after) = (first.truth(), later.truth());
    let heights = |truth: &Value| truth["features"].as_array().expect("features").clone();
    let at = |feature: &Value| (number(feature, "x"), number(feature, "y"));
    let changed: Vec<(Value, f64)> = heights(&after)
        .into_iter()
        .filter_map(|feature| {
            let known = heights(&before).into_iter().find(|other| at(other) == at(&feature));
            let delta = number(&feature, "height") - known.map_or(0.0, |other| number(&other, "height"));
            (delta != 0.0).then_some((feature, delta))
        })
        .collect();
    for list in [changes(&first, &later), changes(&first, &later.on_the_way_back())] {
        let found = list["changes"].as_array().expect("changes");
        assert_eq!((changed.len(), found.len()), (2, 2), "{list:#}");
        for (feature, delta) in &changed {
            let near = |c: &&Value| {
                (number(c, "x_mm") - number(feature, "x")).hypot(number(c, "y_mm") - number(feature, "y")) < 6.0
            };
            let change = found.iter().find(near).unwrap_or_else(|| panic!("{feature} is not in {list:#}"));
            assert_eq!(change["state"], if *delta == 2.0 { "grown" } else { "new" }, "{change:#}");
            assert!((number(change, "delta_depth_mm") - delta).abs() < 0.4, "{delta} mm: {change:#}");
            assert!((number(change, "chainage_mm") - CHAINAGE_MM - number(change, "x_mm")).abs() < 0.01, "{change:#}");
        }
        assert!(list["unchanged"].as_array().is_some_and(|all| all.len() > 3), "{list:#}");
    }
}

#[test]
fn what_cannot_be_compared_is_refused_in_words() {
    let nothing = tempfile::tempdir().expect("a temporary folder");
    let out = nothing.path().join("out");
    let output = run_stria(&["compare", text(nothing.path()), text(nothing.path()), "--out", text(&out)]);
    assert_eq!(output.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&output.stderr).contains("defects.json"));
}

#[test]
fn the_report_is_one_page_without_anything_to_fetch() {
    let made = damaged();
    let page = std::fs::read_to_string(made.products().join("report.html")).expect("a report");
    assert!(page.contains("Tunnel &lt;3&gt;") && page.contains("Detection limit") && page.contains("<td>BAA</td>"));
    for defect in made.defects() {
        assert!(page.contains(&format!("id=\"d{}\"", defect["id"])), "{defect:#} has its block");
    }
    let outside = ["src=\"http", "href=\"http", "url(", "<script", "@import", "<link"];
    assert!(outside.iter().all(|word| !page.contains(word)), "nothing is fetched");
    let pictures = page.matches("data:image/jpeg;base64,").count();
    assert!(pictures > 2 * made.defects().len(), "{pictures} pictures");
}

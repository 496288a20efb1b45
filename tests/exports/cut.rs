//! The writing is cut: at exact bytes by a limit of the file's size, which kills, and at random moments by kill -9.

use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant, SystemTime};

use stria_core::export::manifest::{FILE_NAME, Manifest, sha256_of_file};
use stria_core::mcap_file;
use stria_tests::support::readers::{python_program, run};
use stria_tests::support::{files_below, long_run, run_stria, short_run, stria};

use super::{said, text, write_cloud};

const FORMATS: [&str; 4] = ["ply", "laz", "pcd", "e57"];
/// What is made of a whole job's products, with the options that let it be made anew instead of copied.
const OF_A_JOB: [(&str, &[&str]); 5] =
    [("mcap", &["--every", "2"]), ("glb", &[]), ("csv", &["--at-mm", "100"]), ("tiff", &[]), ("rrd", &[])];

/// What is there under its final name: the old file or the whole new one, never anything else.
fn check(out: &Path, old: &str, new: &str, when: &str) -> bool {
    let found = sha256_of_file(out).expect("the file is always there");
    assert!(found == old || found == new, "{}: half a file, cut {when}", out.display());
    found == new
}

/// Exports with the file's size limited to so many shares of the whole: the old file must stay.
fn cut_at_bytes(products: &Path, folder: &Path, format: &str, more: &[&str], cuts: u64) {
    let whole = folder.join(format!("whole.{format}"));
    let command = ["export", text(products), "--format", format, "--out"];
    let done = run_stria(&[&command[..], &[text(&whole)], more].concat());
    assert!(done.status.success(), "{}", said(&done));
    let new = sha256_of_file(&whole).expect("hashed");
    let kilobytes = whole.metadata().expect("a file").len() / 1024;
    assert!(kilobytes > 0, "{format}: too small to be cut");
    let out = folder.join(format!("out.{format}"));
    for step in 0..cuts {
        // The shell's unit is a kilobyte; the signal at the limit kills like kill -9 does.
        let limit = (kilobytes * step / (cuts - 1)).min(kilobytes - 1);
        std::fs::write(&out, "old").expect("write");
        let old = sha256_of_file(&out).expect("hashed");
        let script = format!("ulimit -c 0 -f {limit}; exec \"$@\"");
        let done = Command::new("bash")
            .args(["-c", &script, "bash"])
            .arg(stria())
            .args(command)
            .arg(&out)
            .args(more)
            .output()
            .expect("bash starts");
        assert!(!done.status.success(), "{format}: {limit} of {kilobytes} kB were enough");
        assert!(!check(&out, &old, &new, &format!("after {limit} kB")), "{format}");
    }
}

#[test]
fn an_export_cut_at_any_byte_leaves_the_old_file_or_the_whole_new_one() {
    let folder = tempfile::tempdir().expect("a folder");
    write_cloud(folder.path(), 60_000);
    for format in FORMATS {
        cut_at_bytes(folder.path(), folder.path(), format, &[], 12);
    }
    let products = folder.path().join("job");
    let run = short_run();
    let done = run_stria(&["process", text(&run.video), "--rig", text(&run.rig), "--out", text(&products)]);
    assert!(matches!(done.status.code(), Some(0 | 3)), "{}", said(&done));
    for (format, more) in OF_A_JOB {
        cut_at_bytes(&products, folder.path(), format, more, 6);
    }
}

/// Numbers that differ from run to run; they only say when to cut.
struct Moments(u64);

impl Moments {
    fn new() -> Moments {
        let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).map_or(7, |d| d.as_nanos() as u64);
        Moments(now | 1)
    }

    fn within(&mut self, most: Duration) -> Duration {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        most.mul_f64((self.0 >> 11) as f64 / (1_u64 << 53) as f64)
    }
}

fn kill_after(mut command: Command, delay: Duration) {
    let mut process = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("starts");
    std::thread::sleep(delay);
    // It may have ended by itself.
    let _ = process.kill();
    process.wait().expect("ends");
}

#[test]
fn an_export_killed_at_any_moment_leaves_the_old_file_or_the_whole_new_one() {
    let folder = tempfile::tempdir().expect("a folder");
    write_cloud(folder.path(), 400_000);
    let mut moments = Moments::new();
    for format in FORMATS {
        let out = folder.path().join(format!("out.{format}"));
        let command = || {
            let mut command = Command::new(stria());
            command.args(["export", text(folder.path()), "--format", format, "--out", text(&out)]);
            command
        };
        let begun = Instant::now();
        assert!(command().output().expect("starts").status.success());
        let (whole, took) = (sha256_of_file(&out).expect("hashed"), begun.elapsed());
        for _ in 0..10 {
            std::fs::write(&out, "old").expect("write");
            let old = sha256_of_file(&out).expect("hashed");
            let delay = moments.within(took);
            kill_after(command(), delay);
            check(&out, &old, &whole, &format!("after {delay:?} of {took:?}"));
        }
    }
}

/// A product is whole: what its format's own end says, by another program where there is one.
fn check_product(folder: &Path, name: &str) {
    let path = folder.join(name);
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or_default();
    match extension {
        "mcap" => {
            let contents = mcap_file::contents(std::slice::from_ref(&path), name).expect("an MCAP file");
            assert_eq!(contents.damage, None, "{name}");
        }
        "rrd" => drop(run(python_program("rerun"), &["rrd", "verify", text(&path)])),
        "ply" | "csv" => {
            let text = std::fs::read(&path).expect("read");
            assert!(!text.is_empty(), "{name} is empty");
        }
        _ => {}
    }
}

#[test]
fn a_job_killed_at_any_moment_leaves_no_half_product() {
    let folder = tempfile::tempdir().expect("a folder");
    let process = |out: &Path| {
        let mut command = Command::new(stria());
        let (video, rig) = (text(&long_run().video), text(&long_run().rig));
        command.args(["process", video, "--rig", rig, "--out", text(out)]);
        command
    };
    let whole = folder.path().join("whole");
    let begun = Instant::now();
    assert!(process(&whole).output().expect("starts").status.success());
    let took = begun.elapsed();
    let expected = Manifest::load(&whole).expect("a manifest");
    // The same bytes every time; the others hold times and identities of their own job.
    let fixed: Vec<_> = expected
        .products
        .iter()
        .filter(|p| !p.name.starts_with("tiles/") && !p.name.ends_with(".mcap") && !p.name.ends_with(".rrd"))
        .collect();
    assert!(fixed.len() >= 6, "{fixed:?}");
    let mut moments = Moments::new();
    let mut pictures = Vec::new();
    for attempt in 0..10 {
        let out = folder.path().join(attempt.to_string());
        let delay = moments.within(took.mul_f64(1.1));
        kill_after(process(&out), delay);
        for name in files_below(&out).iter().filter(|name| !name.split('/').any(|part| part.starts_with('.'))) {
            if let Some(product) = fixed.iter().find(|product| product.name == *name) {
                let found = sha256_of_file(&out.join(name)).expect("hashed");
                assert_eq!(found, product.sha256, "{name}, killed after {delay:?} of {took:?}");
            } else if name == FILE_NAME {
                let manifest = Manifest::load(&out).expect("a manifest");
                for product in &manifest.products {
                    let found = sha256_of_file(&out.join(&product.name)).expect("what is listed is there");
                    assert_eq!(found, product.sha256, "{}", product.name);
                }
            } else {
                check_product(&out, name);
                if name.ends_with(".png") || name.ends_with(".jpg") {
                    pictures.push(out.join(name));
                }
            }
        }
        // What was interrupted can be started again over it.
        if attempt % 5 == 0 && !out.join(FILE_NAME).exists() {
            assert!(process(&out).output().expect("starts").status.success(), "a second try");
            assert!(Manifest::load(&out).is_ok());
        }
    }
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("readers/whole_pictures.py");
    let list = folder.path().join("pictures.txt");
    let lines: Vec<&str> = pictures.iter().map(|path| text(path)).collect();
    std::fs::write(&list, lines.join("\n")).expect("write");
    run(python_program("python"), &[text(&script), text(&list)]);
}

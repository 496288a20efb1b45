//! The process that decodes what strangers send: no network, no files but its own, no secrets; pictures of any size.

use std::path::Path;
use std::process::Command;

use stria_tests::support::server::{Server, json_of, send, text};
use stria_tests::support::{form, long_run, readers, short_run, stria};

fn namespace_of(process: u32) -> String {
    let link = std::fs::read_link(format!("/proc/{process}/ns/net")).expect("a network namespace");
    link.display().to_string()
}

#[test]
fn a_job_works_without_network_foreign_files_or_secrets() {
    let secret = ("AWS_SECRET_ACCESS_KEY".to_string(), "not for children".to_string());
    let server = Server::start_with(&["--workers", "1"], &[secret]);
    // On a system that lacks a fence this says which; the tests' machines have both.
    let ready = server.json("/readyz");
    assert!(ready.get("warnings").is_none(), "{ready:#}");
    let metrics = send(server.get("/metrics")).text().expect("text");
    for what in ["network", "files"] {
        assert!(metrics.contains(&format!("stria_fences{{what=\"{what}\"}} 1")), "{metrics}");
    }
    let run = server.upload(long_run(), "Wall");
    let job = text(&run, "/job/id");
    server.wait_for(&job, "at work", |j| j["progress"].as_f64().is_some_and(|p| p > 0.0));
    let child = *server.children().first().expect("a child at work");
    assert_ne!(namespace_of(child), namespace_of(server.id()), "a network of its own, with nobody in it");
    let read = |name: &str| std::fs::read_to_string(format!("/proc/{child}/{name}")).expect("the child is there");
    assert!(read("status").lines().any(|line| line == "NoNewPrivs:\t1"), "{}", read("status"));
    assert!(!read("environ").contains("not for children"), "a child needs no keys");
    let folder = read("cmdline").split('\0').skip_while(|word| *word != "--keep-to").nth(1).map(String::from);
    assert!(folder.is_some_and(|folder| folder.ends_with(&format!("/{job}.1"))), "{}", read("cmdline"));
    server.wait_for_state(&job, "done");
}

#[test]
fn what_a_source_points_at_outside_is_not_read() {
    let place = tempfile::tempdir().expect("folder");
    let (own, outside) = (place.path().join("own"), place.path().join("outside.png"));
    let source = own.join("images");
    std::fs::create_dir_all(&source).expect("makes");
    let png = |path: &Path| {
        let made = Command::new("ffmpeg")
            .args(["-hide_banner", "-loglevel", "error", "-nostdin", "-i"])
            .arg(&short_run().video)
            .args(["-frames:v", "1", "-y"])
            .arg(path)
            .status();
        assert!(made.expect("ffmpeg is installed: docker/set-up.sh brings it").success());
    };
    png(&outside);
    png(&source.join("0001.png"));
    std::os::unix::fs::symlink(&outside, source.join("0002.png")).expect("links");
    std::fs::copy(&short_run().rig, own.join("rig.toml")).expect("copies");
    let process = |out: &str, fence: &[&str]| {
        let done = Command::new(stria())
            .arg("process")
            .arg(&source)
            .arg("--rig")
            .arg(own.join("rig.toml"))
            .arg("--out")
            .arg(own.join(out))
            .args(["--json", "--only", "depth"])
            .args(fence)
            .current_dir(&own)
            .output()
            .expect("starts");
        String::from_utf8_lossy(&done.stdout).into_owned()
    };
    let free = process("free", &[]);
    assert!(free.contains("\"frames\":2"), "without a fence both images are read: {free}");
    let fenced = process("fenced", &["--keep-to", own.to_str().expect("plain")]);
    assert!(fenced.contains("Permission denied"), "{fenced}");
}

#[test]
fn pictures_of_hostile_sizes_end_their_job_with_a_clear_word() {
    let server = Server::start(&["--workers", "1", "--job-memory-limit-gb", "1"]);
    let folder = tempfile::tempdir().expect("folder");
    // A few kB that would be 3.6 GB of pixels; one just over the limit; one pixel; nothing at all.
    for (name, width, height) in [("bomb", 30_000, 30_000), ("wide", 8_200, 64), ("dot", 1, 1), ("flat", 4_000, 8)] {
        let file = folder.path().join(format!("{name}.png"));
        let script =
            "import sys, PIL.Image; PIL.Image.new('1', (int(sys.argv[1]), int(sys.argv[2]))).save(sys.argv[3])";
        let made = Command::new(readers::python_program("python"))
            .args(["-c", script, &width.to_string(), &height.to_string()])
            .arg(&file)
            .status();
        assert!(made.expect("python starts").success());
        let bytes = std::fs::read(&file).expect("reads");
        assert!(bytes.len() < 1_000_000, "{name} is small as a file: {}", bytes.len());
        let body = form::form(&[("asset", "Wall"), ("rig", &short_run().rig_text())], &format!("{name}.png"), &bytes);
        let made = send(server.post("/api/runs").header("Content-Type", form::content_type()).body(body));
        let failed = server.wait_for_state(&text(&json_of(made, 201), "/job/id"), "failed");
        assert_eq!(
            (text(&failed, "/error/type").as_str(), failed["attempt"].as_u64()),
            ("urn:stria:job:bad_input", Some(1)),
            "{failed:#}"
        );
        let said = format!("{} {}", text(&failed, "/error/detail"), failed["error"]["expected"]);
        assert!(said.contains("16 to 8192 px"), "{name}: {said}");
    }
}

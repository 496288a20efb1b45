//! The container files say what is true: every command, flag, variable, port, path, user and package is checked against the
//! binary, the repository and this machine, as far as that goes without an engine.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;

use serde_json::Value;
use stria_tests::support::readers::{read, run};
use stria_tests::support::server::Server;
use stria_tests::support::{run_stria, stria};

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("tests/ lies in the repository").to_path_buf()
}

fn files() -> &'static Value {
    static FILES: OnceLock<Value> = OnceLock::new();
    FILES.get_or_init(|| read("containers.py", &[&root().join("docker")]))
}

fn words(value: &Value) -> Vec<String> {
    let list = value.as_array().unwrap_or_else(|| panic!("a list, not {value}"));
    list.iter().map(|word| word.as_str().unwrap_or_else(|| panic!("a word, not {word}")).to_string()).collect()
}

fn text(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned()
}

/// What a command's own help says that it takes.
struct Help {
    flags: BTreeSet<String>,
    variables: BTreeSet<String>,
}

impl Help {
    fn of(command: &str) -> Help {
        let done = run_stria(&[command, "--help"]);
        assert!(done.status.success(), "`stria {command}` is no command");
        let help = text(&done);
        let flags = help.split(|c: char| c.is_whitespace() || c == ',' || c == '[').filter(|w| w.starts_with("--"));
        let variables = help.split("[env: ").skip(1).filter_map(|rest| rest.split(['=', ']']).next());
        Help { flags: flags.map(String::from).collect(), variables: variables.map(String::from).collect() }
    }
}

/// Variables that the S3 client reads; `stria serve --help` names them.
const S3_VARIABLES: [&str; 5] =
    ["AWS_ENDPOINT", "AWS_ALLOW_HTTP", "AWS_REGION", "AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"];

/// A container that runs the binary.
struct Ours {
    place: String,
    command: Vec<String>,
    variables: BTreeMap<String, String>,
}

fn instruction<'a>(name: &str) -> Vec<&'a Value> {
    let all = files()["dockerfile"].as_array().expect("instructions");
    all.iter().filter(|instruction| instruction["do"] == name).collect()
}

fn last<'a>(name: &str) -> &'a Value {
    instruction(name).pop().unwrap_or_else(|| panic!("the Dockerfile has no {name}"))
}

fn environment(of: &Value) -> BTreeMap<String, String> {
    let pairs = of.as_object().into_iter().flatten();
    pairs.map(|(name, value)| (name.clone(), value.as_str().map_or_else(|| value.to_string(), String::from))).collect()
}

/// Every container with our image: the image's own command, compose's services, Kubernetes' deployments.
fn ours() -> Vec<Ours> {
    let image = words(&last("CMD")["list"]);
    let mut all = vec![Ours { place: "Dockerfile".into(), command: image.clone(), variables: BTreeMap::new() }];
    for (file, compose) in files()["compose"].as_object().expect("files") {
        for (name, service) in compose["document"]["services"].as_object().expect("services") {
            if service["build"].is_object() {
                let command = if service["command"].is_null() { image.clone() } else { words(&service["command"]) };
                let variables = environment(&service["environment"]);
                all.push(Ours { place: format!("{file}: {name}"), command, variables });
            }
        }
    }
    for (file, document) in kubernetes() {
        for container in document["spec"]["template"]["spec"]["containers"].as_array().into_iter().flatten() {
            assert_eq!(container["image"], "stria", "{file}");
            assert_eq!(container["envFrom"][0]["secretRef"]["name"], secret()["metadata"]["name"], "{file}");
            let variables = environment(&secret()["stringData"]);
            all.push(Ours { place: file.into(), command: words(&container["args"]), variables });
        }
    }
    all
}

fn kubernetes() -> Vec<(&'static str, &'static Value)> {
    let files = files()["kubernetes"].as_object().expect("files");
    files
        .iter()
        .flat_map(|(file, all)| all.as_array().expect("a list").iter().map(move |d| (file.as_str(), d)))
        .collect()
}

fn of_kind(kind: &str) -> Vec<&'static Value> {
    kubernetes().into_iter().map(|(_, document)| document).filter(|document| document["kind"] == kind).collect()
}

fn secret() -> &'static Value {
    of_kind("Secret")[0]
}

#[test]
fn every_command_flag_and_variable_exists() {
    assert_eq!(last("ENTRYPOINT")["list"], serde_json::json!(["stria"]));
    let all = ours();
    assert!(all.len() >= 6, "the image, one service, two services and two deployments");
    for Ours { place, command, variables } in all {
        let help = Help::of(&command[0]);
        for flag in command.iter().filter(|word| word.starts_with('-')) {
            assert!(help.flags.contains(flag), "{place}: `stria {}` has no {flag}", command[0]);
        }
        for name in variables.keys() {
            let known = help.variables.contains(name) || S3_VARIABLES.contains(&name.as_str());
            assert!(known, "{place}: `stria {}` reads no {name}", command[0]);
        }
        if command[0] == "work" {
            let given = |flag: &str, name: &str| command.iter().any(|w| w == flag) || variables.contains_key(name);
            assert!(given("--database", "STRIA_DATABASE") && given("--store", "STRIA_STORE"), "{place}");
        }
    }
    let help = text(&run_stria(&["serve", "--help"]));
    S3_VARIABLES.iter().for_each(|name| assert!(help.contains(name), "`stria serve --help` names {name}"));
}

/// The port in a `--listen`.
fn port(command: &[String]) -> Option<String> {
    let at = command.iter().position(|word| word == "--listen")?;
    command[at + 1].rsplit(':').next().map(String::from)
}

#[test]
fn ports_probes_and_volumes_fit_the_commands() {
    let listens = port(&words(&last("CMD")["list"])).expect("it listens");
    assert_eq!(last("EXPOSE")["rest"], listens.as_str());
    assert_eq!(words(&last("HEALTHCHECK")["check"])[1], listens);
    let published = words(&files()["compose"]["compose.yaml"]["document"]["services"]["stria"]["ports"]);
    // Without a log-in, nobody but this machine.
    assert_eq!(published, [format!("127.0.0.1:{listens}:{listens}")]);
    let paths: Value = serde_json::from_str(&text(&run_stria(&["openapi"]))).expect("JSON");
    for container in of_kind("Deployment").iter().flat_map(|d| d["spec"]["template"]["spec"]["containers"].as_array()) {
        let container = &container[0];
        let command = words(&container["args"]);
        let data = &command[command.iter().position(|w| w == "--data").expect("a folder") + 1];
        let mounts = container["volumeMounts"].as_array().expect("mounts");
        assert!(mounts.iter().any(|mount| mount["mountPath"] == data.as_str()), "{data} is a volume");
        assert!(mounts.iter().any(|mount| mount["mountPath"] == "/tmp"), "the rest of the file system is read-only");
        assert_eq!(container["securityContext"]["readOnlyRootFilesystem"], true);
        let Some(listens) = port(&command) else { continue };
        assert_eq!(container["ports"][0]["containerPort"].to_string(), listens);
        for probe in ["readinessProbe", "livenessProbe"] {
            let get = &container[probe]["httpGet"];
            assert_eq!(get["port"], container["ports"][0]["name"], "{probe}");
            assert!(paths["paths"][get["path"].as_str().expect("a path")].is_object(), "{probe}: {get}");
        }
    }
    let service = of_kind("Service")[0];
    let server = of_kind("Deployment").into_iter().find(|d| d["metadata"]["name"] == "stria-server").expect("servers");
    assert_eq!(service["spec"]["selector"], server["spec"]["template"]["metadata"]["labels"]);
    assert_eq!(service["spec"]["ports"][0]["targetPort"], "http");
    let backend = &of_kind("Ingress")[0]["spec"]["rules"][0]["http"]["paths"][0]["backend"]["service"];
    assert_eq!((&backend["name"], &backend["port"]["name"]), (&service["metadata"]["name"], &"http".into()));
    let caddy = std::fs::read_to_string(root().join("docker/Caddyfile")).expect("the edge");
    let scale = &files()["compose"]["compose.scale.yaml"]["document"]["services"];
    let behind = port(&words(&scale["server"]["command"])).expect("it listens");
    assert!(caddy.contains(&format!("port {behind}")) && caddy.contains("name server"), "{caddy}");
    assert!(scale["server"].is_object() && scale["edge"]["volumes"][0] == "./Caddyfile:/etc/caddy/Caddyfile:ro");
}

#[test]
fn the_image_is_built_from_what_is_there_and_runs_as_nobody() {
    for copy in instruction("COPY").into_iter().filter(|copy| copy["from"].is_null()) {
        for source in words(&copy["sources"]) {
            let path = root().join(&source);
            assert!(path.exists(), "the Dockerfile copies {source}, which is not there");
            let tracked = run("git", &["-C", root().to_str().expect("a path"), "ls-files", "--", &source]);
            assert!(!tracked.is_empty(), "{source} is not in the repository");
        }
    }
    let user = last("USER")["rest"].as_str().expect("a user").to_string();
    let number: u32 = user.split(':').next().and_then(|n| n.parse().ok()).expect("a number, for orchestrators");
    assert!(number > 0, "root");
    let made = instruction("RUN").iter().any(|run| {
        run["rest"].as_str().is_some_and(|rest| rest.contains(&format!("useradd --system --uid {number} ")))
    });
    assert!(made, "nobody makes the user {number}");
    for deployment in of_kind("Deployment") {
        let context = &deployment["spec"]["template"]["spec"]["securityContext"];
        assert_eq!((&context["runAsUser"], &context["runAsNonRoot"]), (&number.into(), &true.into()));
    }
    // Every stage's first image can be pinned by its digest.
    let arguments: Vec<String> = instruction("ARG").iter().map(|a| a["rest"].to_string()).collect();
    for from in instruction("FROM") {
        let image =
            from["rest"].as_str().unwrap_or_default().trim_start_matches("${").split('}').next().expect("a name");
        assert!(arguments.iter().any(|a| a.starts_with(&format!("\"{image}="))), "{from}");
    }
    assert!(!arguments.iter().any(|a| a.contains("latest")), "{arguments:?}");
    for (file, compose) in files()["compose"].as_object().expect("files") {
        for (name, service) in compose["document"]["services"].as_object().expect("services") {
            match service["build"].as_object() {
                Some(build) => {
                    let context = root().join("docker").join(build["context"].as_str().expect("a folder"));
                    assert!(context.join(build["dockerfile"].as_str().expect("a file")).exists(), "{file}: {name}");
                }
                None => {
                    let image = service["image"].as_str().expect("an image");
                    let tag = image.rsplit_once(':').map(|(_, tag)| tag);
                    assert!(tag.is_some_and(|tag| tag != "latest"), "{file}: {name}: {image} is not pinned");
                }
            }
            for other in service["depends_on"].as_object().into_iter().flatten() {
                assert!(compose["document"]["services"][other.0].is_object(), "{file}: {name} waits for {}", other.0);
            }
            for volume in service["volumes"].as_array().into_iter().flatten() {
                let source = volume.as_str().and_then(|v| v.split(':').next()).expect("a volume");
                let known = if source.starts_with('.') {
                    root().join("docker").join(source).exists()
                } else {
                    compose["document"]["volumes"].as_object().is_some_and(|v| v.contains_key(source))
                };
                assert!(known, "{file}: {name}: {source}");
            }
        }
        // Whoever starts it finds every variable in the head of the file.
        let head: String = compose["text"].as_str().expect("text").lines().take_while(|l| l.starts_with('#')).collect();
        for variable in words(&compose["variables"]) {
            assert!(head.contains(&variable), "{file}: the head does not explain {variable}");
        }
    }
}

/// The steps of the image as the script without an engine would carry them out, and as another reader of the Dockerfile
/// sees them.
#[test]
fn the_script_without_an_engine_carries_out_every_step_of_the_image() {
    let plan = run(root().join("docker/build-without-engine.sh"), &["--plan"]);
    let plain = |line: &str| line.split_whitespace().collect::<Vec<_>>().join(" ");
    let steps: Vec<String> = String::from_utf8_lossy(&plan).lines().map(plain).collect();
    let mut expected = Vec::new();
    let mut stage = String::new();
    for step in files()["dockerfile"].as_array().expect("instructions") {
        let rest = step["rest"].as_str().expect("what it does");
        match step["do"].as_str().expect("a name") {
            "FROM" => {
                let (variable, name) = rest.split_once(" AS ").unwrap_or((rest, "image"));
                let variable = variable.trim_start_matches("${").trim_end_matches('}');
                let given = instruction("ARG").into_iter().filter_map(|arg| arg["rest"].as_str()?.split_once('='));
                let image = given.filter(|(name, _)| *name == variable).map(|(_, image)| image).next_back();
                stage = name.to_string();
                expected.push(format!("[{stage}] FROM {}", image.expect("its default")));
            }
            name @ ("RUN" | "COPY") => expected.push(plain(&format!("[{stage}] {name} {rest}"))),
            _ => {}
        }
    }
    let start = [words(&last("ENTRYPOINT")["list"]), words(&last("CMD")["list"])].concat().join(" ");
    expected.push(format!("[{stage}] {start} (as {})", last("USER")["rest"].as_str().expect("a user")));
    expected.push(format!("[{stage}] {}", words(&last("HEALTHCHECK")["check"]).join(" ")));
    assert_eq!(steps, expected);
    assert!(expected.iter().filter(|step| step.contains("] RUN ")).count() >= 5, "{expected:?}");
    // What it does not know it does not pass over.
    let odd = Command::new(root().join("docker/build-without-engine.sh")).arg("--everything").output().expect("bash");
    assert_eq!(odd.status.code(), Some(2));
}

#[test]
fn the_set_up_step_brings_what_the_binary_needs() {
    let script = root().join("docker/set-up.sh");
    for run in instruction("RUN") {
        let rest = run["rest"].as_str().expect("a command");
        let Some(at) = rest.find("set-up.sh ") else { continue };
        let part = rest[at + 10..].split_whitespace().next().expect("a part");
        assert!(["build", "run"].contains(&part), "{rest}");
    }
    let refused = Command::new(&script).arg("everything").output().expect("bash");
    assert_eq!(refused.status.code(), Some(2));
    // Every library that the binary loads belongs to a package of the part `run`, or to what these need.
    let packages = std::fs::read_to_string(&script).expect("the script");
    let packages = packages.split("RUN=\"").nth(1).and_then(|rest| rest.split('"').next()).expect("RUN=");
    let names: Vec<&str> = packages.split_whitespace().collect();
    let arguments = ["depends", "--recurse", "--no-recommends", "--no-suggests", "--no-conflicts", "--no-breaks"];
    let arguments = [&arguments[..], &["--no-replaces", "--no-enhances"], &names].concat();
    let needed = String::from_utf8_lossy(&run("apt-cache", &arguments)).into_owned();
    let needed: BTreeSet<&str> = needed.lines().filter(|line| !line.starts_with([' ', '<', '|'])).collect();
    assert!(needed.len() > 50, "apt-cache knows no packages: run `apt-get update`");
    let binary = stria();
    let libraries = String::from_utf8_lossy(&run("ldd", &[binary.to_str().expect("a path")])).into_owned();
    let mut checked = 0;
    for path in libraries.lines().filter_map(|line| line.split("=> ").nth(1)?.split_whitespace().next()) {
        let real = std::fs::canonicalize(path).expect("a library");
        let real = real.to_str().expect("a path");
        // Older packages still name their files under /lib, which is /usr/lib.
        let names = [real, real.strip_prefix("/usr").unwrap_or(real)];
        let owners = names.map(|name| Command::new("dpkg").args(["-S", name]).output().expect("dpkg"));
        let owner = owners.iter().map(text).find(|owner| !owner.is_empty()).unwrap_or_default();
        let package = owner.split(':').next().unwrap_or_default();
        // The C library and the compiler's own are in every Debian.
        let base = ["libc6", "libgcc-s1", "libstdc++6", "zlib1g"].contains(&package);
        assert!(base || needed.contains(package), "{path} is of `{package}`, which `set-up.sh run` does not install");
        checked += 1;
    }
    assert!(checked > 10, "{libraries}");
}

#[test]
fn the_health_check_tells_a_ready_server_from_none() {
    let check = words(&last("HEALTHCHECK")["check"]);
    let script = root().join("docker").join(Path::new(&check[0]).file_name().expect("a script"));
    let copied = instruction("COPY").iter().any(|copy| copy["to"] == check[0].as_str());
    assert!(copied, "{} is in the image", check[0]);
    let healthy = |port: &str| Command::new(&script).arg(port).output().expect("bash").status.success();
    let mut server = Server::start(&["--workers", "0"]);
    let url = server.url("");
    let port = url.rsplit(':').next().expect("a port").to_string();
    assert!(healthy(&port));
    server.kill();
    assert!(!healthy(&port));
    assert!(!healthy("1"));
}

#[test]
fn the_autoscaler_asks_what_the_records_answer() {
    let scaler = of_kind("ScaledObject")[0];
    let target = &scaler["spec"]["scaleTargetRef"]["name"];
    let worker = of_kind("Deployment").into_iter().find(|d| d["metadata"]["name"] == *target).expect("workers");
    assert!(worker["spec"]["replicas"].is_null(), "the autoscaler's number is not fought with");
    let trigger = &scaler["spec"]["triggers"][0]["metadata"];
    let variable = trigger["connectionFromEnv"].as_str().expect("a variable");
    assert!(secret()["stringData"][variable].is_string(), "{variable}");
    // The query runs on the records as the service makes them.
    let server = Server::start(&["--workers", "0"]);
    let run = server.upload(stria_tests::support::short_run(), "Wall");
    assert!(run["id"].is_string());
    let records = server.data().join("stria.db");
    let query = trigger["query"].as_str().expect("a query");
    let script = "import sqlite3,sys; print(sqlite3.connect(sys.argv[1]).execute(sys.argv[2]).fetchone()[0])";
    let found = run_python(&["-c", script, records.to_str().expect("a path"), query]);
    assert_eq!(found.trim(), "1", "one job waits");
    let one_each =
        worker["spec"]["template"]["spec"]["containers"][0]["args"].to_string().contains("\"--slots\",\"1\"");
    assert!(one_each && trigger["targetQueryValue"] == "1", "a worker for each job");
}

fn run_python(arguments: &[&str]) -> String {
    let python = stria_tests::support::readers::python_program("python");
    String::from_utf8_lossy(&run(python, arguments)).into_owned()
}

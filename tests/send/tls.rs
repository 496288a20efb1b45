//! https, with an authority of the site's own.

use std::path::Path;
use std::process::{Command, Stdio};

use stria_tests::support::server::Server;
use stria_tests::support::short_run;

use super::sender::{Robot, plain, runs, source};

/// Ends the encryption in front of a server; prints its port.
const TERMINATOR: &str = r#"
import socket, ssl, sys, threading
folder, target = sys.argv[1], int(sys.argv[2])
context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
context.load_cert_chain(folder + "/server.pem", folder + "/server.key")
listener = socket.create_server(("127.0.0.1", 0))
print(listener.getsockname()[1], flush=True)

def pump(source, sink):
    try:
        while data := source.recv(65536):
            sink.sendall(data)
    except OSError:
        pass
    for end in (source, sink):
        try:
            end.shutdown(socket.SHUT_RDWR)
        except OSError:
            pass

def carry(raw):
    try:
        inside = context.wrap_socket(raw, server_side=True)
    except (OSError, ssl.SSLError):
        return
    outside = socket.create_connection(("127.0.0.1", target))
    threading.Thread(target=pump, args=(outside, inside), daemon=True).start()
    pump(inside, outside)

while True:
    threading.Thread(target=carry, args=(listener.accept()[0],), daemon=True).start()
"#;

fn openssl(folder: &Path, arguments: &str) {
    let done = Command::new("openssl").args(arguments.split_whitespace()).current_dir(folder).output();
    let done = done.expect("openssl is missing: apt-get install openssl");
    assert!(done.status.success(), "openssl {arguments}: {}", String::from_utf8_lossy(&done.stderr));
}

/// An authority, and a certificate of 127.0.0.1 by it.
fn certificates(folder: &Path) {
    openssl(folder, "req -x509 -newkey rsa:2048 -nodes -days 2 -subj /CN=site -keyout ca.key -out ca.pem");
    openssl(folder, "req -newkey rsa:2048 -nodes -subj /CN=server -keyout server.key -out server.csr");
    std::fs::write(folder.join("names"), "subjectAltName=IP:127.0.0.1\nbasicConstraints=CA:FALSE\n").expect("writes");
    openssl(
        folder,
        "x509 -req -in server.csr -CA ca.pem -CAkey ca.key -CAcreateserial -days 2 -extfile names -out server.pem",
    );
}

struct Terminator(std::process::Child);

impl Drop for Terminator {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[test]
fn files_and_frames_go_over_https_and_only_to_who_can_be_trusted() {
    let (server, robot) = (Server::start(&["--workers", "0"]), Robot::new());
    let file = robot.file("run.mp4", 300_000, 1);
    certificates(&robot.path(""));
    let port = server.url("").rsplit(':').next().expect("a port").to_string();
    let mut process = Command::new("python3")
        .args(["-c", TERMINATOR, plain(&robot.path("")), &port])
        .stdout(Stdio::piped())
        .spawn()
        .expect("python3 is missing: apt-get install python3");
    let mut line = String::new();
    let stdout = process.stdout.take().expect("piped");
    let _terminator = Terminator(process);
    std::io::BufRead::read_line(&mut std::io::BufReader::new(stdout), &mut line).expect("a port");
    let url = format!("https://127.0.0.1:{}", line.trim());
    let (rig, authority) = (plain(&short_run().rig), robot.path("ca.pem"));
    let usual = ["--server", url.as_str(), "--asset", "A", "--rig", rig, "--give-up-h", "0.0004"];

    let strangers = robot.send(&[&[plain(&file)][..], &usual].concat());
    let (code, _, said) = strangers.end();
    assert_eq!(code, Some(1), "{said}");
    assert!(said.to_lowercase().contains("certificate"), "{said}");

    let trusted = [("SSL_CERT_FILE", plain(&authority))];
    let (code, lines, said) = robot.send_with(&[&[plain(&file)][..], &usual].concat(), &trusted).end();
    assert_eq!(code, Some(0), "{lines:?} {said}");
    assert!(lines[1].starts_with(&url), "{lines:?}");
    let first = &runs(&server)[0];
    assert!(source(&server, first) == std::fs::read(&file).expect("the file"));

    let live = [&["-", "--live", "--stream", "r"][..], &usual].concat();
    let mut sender = robot.send_with(&live, &trusted);
    let mut stdin = sender.stdin.take().expect("piped");
    std::io::Write::write_all(&mut stdin, &super::live::jpeg(1, 5000)).expect("writes");
    drop(stdin);
    let (code, lines, said) = sender.end();
    assert_eq!(code, Some(0), "{lines:?} {said}");
    assert_eq!(runs(&server).len(), 2);
}

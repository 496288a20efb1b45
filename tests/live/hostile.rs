//! WebSocket senders that nobody would want: cut again and again, repeating themselves, out of order, broken, hostile.

use std::time::{Duration, Instant};

use futures::{SinkExt, StreamExt};
use serde_json::{Value, json};
use stria_core::source::frame_file::FrameFile;
use stria_tests::support::long_run;
use stria_tests::support::server::{Server, send, text};
use tokio::net::TcpStream;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::{MaybeTlsStream, WebSocketStream, connect_async};

use super::{jpegs, server};

type Socket = WebSocketStream<MaybeTlsStream<TcpStream>>;

const PATIENCE: Duration = Duration::from_secs(30);

fn images() -> Vec<Vec<u8>> {
    let mut files: Vec<_> = std::fs::read_dir(jpegs()).expect("lists").flatten().map(|e| e.path()).collect();
    files.sort();
    files.iter().map(|file| std::fs::read(file).expect("reads")).collect()
}

fn frame(seq: u64, image: &[u8]) -> Message {
    let mut bytes = seq.to_le_bytes().to_vec();
    bytes.extend((1_700_000_000_000_000_000 + seq as i64 * 33_000_000).to_le_bytes());
    bytes.extend(crc32c::crc32c(image).to_le_bytes());
    bytes.extend(image);
    Message::Binary(bytes.into())
}

async fn open(server: &Server, stream: &str) -> Socket {
    let url = server.url(&format!("/api/live/{stream}")).replacen("http", "ws", 1);
    connect_async(url).await.expect("a WebSocket").0
}

async fn next_said(socket: &mut Socket) -> Option<Value> {
    loop {
        match tokio::time::timeout(PATIENCE, socket.next()).await.expect("an answer in time")? {
            Ok(Message::Text(text)) => return Some(serde_json::from_str(&text).expect("JSON")),
            Ok(_) => {}
            Err(_) => return None,
        }
    }
}

async fn said_of_type(socket: &mut Socket, kind: &str) -> Value {
    while let Some(said) = next_said(socket).await {
        if said["type"] == kind {
            return said;
        }
    }
    panic!("the server went without saying {kind:?}");
}

/// Says hello; the welcome.
async fn hello(server: &Server, stream: &str) -> (Socket, Value) {
    let mut socket = open(server, stream).await;
    let hello = json!({"type": "hello", "asset": "Live", "rig": long_run().rig_text(), "resume": true});
    socket.send(Message::text(hello.to_string())).await.expect("sends");
    let welcome = said_of_type(&mut socket, "welcome").await;
    (socket, welcome)
}

async fn end(mut socket: Socket) -> Value {
    socket.send(Message::text(r#"{"type":"end"}"#)).await.expect("sends");
    said_of_type(&mut socket, "closed").await
}

/// The numbers of a run's frames as they are stored; each image is checked against what was sent.
fn stored(server: &Server, run: &str, images: &[Vec<u8>]) -> Vec<u64> {
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("stored.frames");
    let fetch = || send(server.get(&format!("/api/runs/{run}/source"))).bytes().expect("a body");
    let source = tokio::task::block_in_place(fetch);
    std::fs::write(&file, source).expect("writes");
    let (mut frames, mut numbers) = (FrameFile::open(&file, "stored").expect("opens"), Vec::new());
    while let Some(record) = frames.next_record() {
        assert!(record.image == images[record.seq as usize % images.len()], "frame {}", record.seq);
        numbers.push(record.seq);
    }
    assert_eq!(frames.damage, None);
    numbers
}

/// For a minute the connection is cut every two seconds, and after each cut the sender repeats the last frames and sends
/// the next ones out of order.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn cut_again_and_again_with_repeats_and_disorder_nothing_durable_is_lost_or_doubled() {
    let (server, images) = tokio::task::block_in_place(|| (server(), images()));
    let begun = Instant::now();
    let (mut durable, mut run, mut cuts) = (None, None, 0);
    while begun.elapsed() < Duration::from_secs(60) {
        let (mut socket, welcome) = hello(&server, "cut").await;
        let (next, this_run) = (welcome["next_seq"].as_u64().expect("a number"), text(&welcome, "/run"));
        assert_eq!(*run.get_or_insert_with(|| this_run.clone()), this_run, "one run for all connections");
        assert!(Some(next) > durable, "asked for frame {next}, but {durable:?} was promised");
        let until = Instant::now() + Duration::from_secs(2);
        let mut seq = next.saturating_sub(5);
        while Instant::now() < until {
            // Neighbours change places, and each third comes twice.
            for seq in [seq + 1, seq, seq + if seq % 3 == 0 { 1 } else { 0 }] {
                if socket.send(frame(seq, &images[seq as usize % images.len()])).await.is_err() {
                    break;
                }
            }
            seq += 2;
            while let Ok(Some(Ok(message))) = tokio::time::timeout(Duration::from_millis(60), socket.next()).await {
                if let Message::Text(text) = message {
                    let said: Value = serde_json::from_str(&text).expect("JSON");
                    assert_eq!(said["type"], "ack", "{said}");
                    durable = durable.max(said["durable_seq"].as_u64());
                }
            }
        }
        // The network is gone: no goodbye.
        drop(socket);
        cuts += 1;
    }
    assert!(cuts >= 20, "{cuts} cuts");
    let (socket, welcome) = hello(&server, "cut").await;
    let next = welcome["next_seq"].as_u64().expect("a number");
    let closed = end(socket).await;
    let numbers = stored(&server, &text(&welcome, "/run"), &images);
    assert!(numbers.is_sorted_by(|a, b| a < b), "each frame once, in order");
    assert_eq!(closed["frames"].as_u64(), Some(numbers.len() as u64));
    // What is not stored is listed, and nothing else.
    let missing: Vec<u64> = closed["missing"]
        .as_array()
        .expect("a list")
        .iter()
        .flat_map(|range| range[0].as_u64().expect("a number")..=range[1].as_u64().expect("a number"))
        .collect();
    let mut all = [numbers.clone(), missing].concat();
    all.sort_unstable();
    assert_eq!(all, (0..next).collect::<Vec<_>>());
    assert!(numbers.last() >= durable.as_ref(), "the last promised frame is there");
    let job = tokio::task::block_in_place(|| server.wait_for_state(&text(&welcome, "/job"), "done"));
    assert_eq!(job["frames"].as_u64(), Some(numbers.len() as u64));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_is_broken_is_told_and_what_came_before_it_is_kept() {
    let (server, images) = tokio::task::block_in_place(|| (server(), images()));
    let mut wrong_crc = frame(3, &images[3]).into_data().to_vec();
    wrong_crc[17] ^= 1;
    let no_image = frame(3, b"this is no image at all");
    let cases = [
        ("wrong-crc", Message::Binary(wrong_crc.into()), "CRC-32C", true),
        ("no-image", no_image, "no image", false),
        ("short", Message::Binary(vec![1, 2, 3].into()), "3 bytes", false),
        ("huge", Message::Binary(vec![0xff; 100_000_000].into()), "limit", false),
        ("garbage", Message::text("{\"type\":"), "cannot be read", false),
        ("stranger", Message::text(r#"{"type":"open the door"}"#), "cannot be read", false),
    ];
    for (stream, bad, words, retryable) in cases {
        let (mut socket, welcome) = hello(&server, stream).await;
        for seq in 0..3 {
            socket.send(frame(seq, &images[seq as usize])).await.expect("sends");
        }
        // A message that is refused while it is sent breaks the connection under the sender.
        let (mut sink, mut stream_in) = socket.split();
        let sending = tokio::spawn(async move { drop(sink.send(bad).await) });
        let error = loop {
            match tokio::time::timeout(PATIENCE, stream_in.next()).await.expect("an answer in time") {
                Some(Ok(Message::Text(said))) => {
                    let said: Value = serde_json::from_str(&said).expect("JSON");
                    if said["type"] == "error" {
                        break said;
                    }
                }
                Some(Ok(_)) => {}
                other => panic!("{stream}: the server went without a word: {other:?}"),
            }
        };
        sending.abort();
        assert!(text(&error, "/detail").contains(words), "{stream}: {error}");
        assert_eq!(error["retryable"], retryable, "{stream}: {error}");
        let (socket, again) = hello(&server, stream).await;
        assert_eq!((again["next_seq"].as_u64(), &again["run"]), (Some(3), &welcome["run"]), "{stream}");
        let closed = end(socket).await;
        assert_eq!(closed["frames"], 3, "{stream}");
        assert_eq!(stored(&server, &text(&welcome, "/run"), &images), [0, 1, 2], "{stream}");
    }
    // Before hello nothing else is heard.
    for first in [frame(0, &images[0]), Message::text("{}"), Message::text(r#"{"type":"end"}"#)] {
        let mut socket = open(&server, "rude").await;
        socket.send(first).await.expect("sends");
        let error = said_of_type(&mut socket, "error").await;
        assert_eq!(error["retryable"], false, "{error}");
    }
}

//! The engines go away in the middle of the work and come back: it goes on by itself.

use std::time::Duration;

use stria_tests::support::cluster::Cluster;
use stria_tests::support::server::{send, text};
use stria_tests::support::{Run, long_run, short_run};

use super::many::assert_products_whole;

/// How long an engine stays away.
const AWAY: Duration = Duration::from_secs(30);

/// One job at work and more waiting when `take_away` strikes; all are done in the end, none twice.
fn survives(what: &str, take_away: fn(&mut Cluster), bring_back: fn(&mut Cluster)) {
    let mut cluster = Cluster::start();
    let server = cluster.server(&["--workers", "0"]);
    let mut workers: Vec<_> = (0..2).map(|_| cluster.worker(&["--slots", "1", "--lease-s", "120"])).collect();
    let send_in = |run: &Run| text(&server.upload(run, "Wall"), "/job/id");
    let jobs = [send_in(long_run()), send_in(long_run()), send_in(short_run()), send_in(short_run())];
    server.wait_for(&jobs[0], "at work", |j| j["progress"].as_f64().is_some_and(|p| p > 0.2));
    take_away(&mut cluster);
    let begun = std::time::Instant::now();
    while begun.elapsed() < AWAY {
        assert_eq!(send(server.get("/livez")).status(), 200, "{what} is away, the server lives");
        let ready = send(server.get("/readyz")).status().as_u16();
        assert_eq!(ready, 503, "{what} is away");
        std::thread::sleep(Duration::from_secs(2));
    }
    bring_back(&mut cluster);
    for job in &jobs {
        let done = server.wait_for_state(job, "done");
        assert_eq!(done["attempt"], 1, "{what} away costs no attempt: {done:#}");
        assert_products_whole(&server, job);
    }
    for worker in &mut workers {
        assert!(worker.stop().success());
    }
}

#[test]
fn a_postgresql_that_is_gone_for_30_s_costs_nothing() {
    survives("PostgreSQL", |c| c.postgres.stop_hard(), |c| c.postgres.start_again());
}

#[test]
fn an_s3_that_is_gone_for_30_s_costs_nothing() {
    survives("S3", |c| c.s3.stop_hard(), |c| c.s3.start_again());
}

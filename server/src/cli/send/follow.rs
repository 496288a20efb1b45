//! `--wait`: a job is looked at until it ends; a server that restarts meanwhile is waited for.

use std::time::Duration;

use reqwest::Method;
use serde_json::Value;

use super::super::progress::{JobBar, duration};
use super::super::{Failed, Outcome, Success};
use super::Desk;
use super::backoff::{GiveUp, Patience};
use super::trouble::Trouble;

/// Pause between two looks.
const LOOK_EVERY: Duration = Duration::from_millis(500);

/// Follows a job to its end and says how it ended.
pub(super) async fn follow(desk: &Desk, run: &str, job: &str, give_up: GiveUp) -> Outcome {
    let bar = (!desk.report.is_json()).then(JobBar::new);
    let ended = tokio::select! {
        biased;
        () = desk.stop.cancelled() => Err(Failed::Cancelled),
        ended = look_until_ended(desk, job, bar.as_ref(), give_up) => ended,
    };
    if let Some(bar) = bar {
        bar.clear();
    }
    say(desk, &ended?, desk.contact.page(run).as_str())
}

async fn look_until_ended(desk: &Desk, job: &str, bar: Option<&JobBar>, give_up: GiveUp) -> Result<Value, Failed> {
    let mut patience = Patience::new(give_up);
    loop {
        let wait = match look(desk, job).await {
            Ok(job) => {
                patience.progress();
                desk.report.job(&job);
                if let Some(bar) = bar {
                    show(bar, &job);
                }
                if matches!(text(&job, "/state").as_str(), "done" | "failed" | "cancelled") {
                    return Ok(job);
                }
                LOOK_EVERY
            }
            Err(Trouble::Passing { why, wait, .. }) => {
                let Some(wait) = patience.next_wait(wait) else {
                    return Err(Failed::Other(format!("{} is gone: {why}", desk.contact.server())));
                };
                wait
            }
            Err(other) => return Err(other.into()),
        };
        tokio::time::sleep(wait).await;
    }
}

async fn look(desk: &Desk, job: &str) -> Result<Value, Trouble> {
    let url = desk.contact.url(&format!("/api/jobs/{job}"));
    let answer = desk.contact.ask(desk.contact.request(Method::GET, url)).await?;
    Ok(answer.json().await?)
}

fn show(bar: &JobBar, job: &Value) {
    let number = |name: &str| job.pointer(name).and_then(Value::as_f64);
    let state = text(job, "/state");
    let stage = if state == "running" { text(job, "/stage") } else { state };
    let total = job.pointer("/frames_total").and_then(Value::as_u64);
    let frames = job.pointer("/frames").and_then(Value::as_u64).unwrap_or(0);
    let (fraction, rate) = (number("/progress").unwrap_or(0.0), number("/frames_per_s").unwrap_or(0.0));
    bar.show(&stage, fraction, frames, total, rate, number("/time_left_s"));
}

fn say(desk: &Desk, job: &Value, page: &str) -> Outcome {
    match text(job, "/state").as_str() {
        "done" => {}
        "cancelled" => return Err(Failed::Cancelled),
        _ => return Err(Failed::Other(format!("the job failed: {}\n{page}", text(job, "/error/detail")))),
    }
    let warnings = job.pointer("/warnings").and_then(Value::as_array).cloned().unwrap_or_default();
    if desk.report.is_json() {
        desk.report.result(job, page);
    } else {
        let time = |name: &str| text(job, name).parse::<jiff::Timestamp>().ok();
        let took = time("/finished_at").zip(time("/started_at")).map(|(b, a)| b.duration_since(a).as_secs_f64());
        let frames = job.pointer("/frames").and_then(Value::as_u64).unwrap_or(0);
        println!("Done: {frames} frames in {}", duration(took.unwrap_or(0.0)));
        for warning in warnings.iter().filter_map(Value::as_str) {
            println!("warning: {warning}");
        }
        println!("{page}");
    }
    Ok(if warnings.is_empty() { Success::Done } else { Success::DoneWithWarnings })
}

fn text(value: &Value, pointer: &str) -> String {
    value.pointer(pointer).and_then(Value::as_str).unwrap_or_default().into()
}

//! What people read off a finished job: a cross-section of its depth map, its trajectory.

use std::io::{BufRead, BufReader};

use axum::extract::State;
use axum::http::header::CONTENT_TYPE;
use axum::response::{IntoResponse, Response};
use serde::Deserialize;
use stria_core::export::depth_tif::section::{self, Cut, Section};
use stria_core::export::{section_csv, trajectory_csv};
use utoipa::IntoParams;

use super::App;
use super::extract::{Path, Query};
use super::stored::StoredFileReader;
use crate::error::{Error, Result};
use crate::wire::{CrossSection, Direction, Problem, Trajectory};

/// Most points of a cross-section.
const MOST_POINTS: usize = 20_000;
/// Points of a cross-section when no step is asked for: more than any screen is wide.
const USUAL_POINTS: usize = 4000;
/// Lines of a trajectory when nothing is said.
const USUAL_LINES: u64 = 2000;
/// Most lines of a trajectory.
const MOST_LINES: u64 = 100_000;

#[derive(Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct ProfileQuery {
    /// Across the whole map at this chainage, mm.
    chainage_mm: Option<f64>,
    /// Where a line begins: world x,y in mm; with `to`.
    from: Option<String>,
    /// Where it ends: world x,y in mm.
    to: Option<String>,
    #[param(minimum = 0)]
    /// Way from one point to the next, mm; the map's pixel when nothing is said, or longer for a long line.
    step_mm: Option<f64>,
    /// `json` (when nothing is said) or `csv`.
    format: Option<String>,
}

/// A cross-section of the depth map, in mm: the map's own values along a line, the nearest pixel's at each point.
#[utoipa::path(get, path = "/api/jobs/{job}/profile", tag = "jobs",
    params(("job" = String, Path, description = "The job"), ProfileQuery),
    responses((status = 200, description = "Or as text/csv, by `format`",
            content((CrossSection = "application/json"), (String = "text/csv"))),
        (status = 400, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn get_profile(
    State(app): State<App>,
    Path(job): Path<String>,
    Query(query): Query<ProfileQuery>,
) -> Result<Response> {
    let run = app.runs.get(&app.runs.job(&job).await?.run).await?;
    let sign = if run.direction == Direction::Backward { -1.0 } else { 1.0 };
    let cut = cut_of(&query, run.chainage_mm, sign)?;
    let (step_mm, most) = match query.step_mm {
        Some(step) if step.is_finite() && step > 0.0 => (Some(step), MOST_POINTS),
        Some(step) => return Err(Error::field("step_mm", format!("step_mm is {step}"), "a length above 0 mm")),
        None => (None, USUAL_POINTS),
    };
    let csv = match query.format.as_deref() {
        None | Some("json") => false,
        Some("csv") => true,
        Some(other) => return Err(Error::field("format", format!("format is {other:?}"), "json or csv")),
    };
    let file = app.runs.product(&job, "depth.tif").await?;
    let reader = StoredFileReader::new(app.store.clone(), file.key, file.facts.bytes);
    let section = off_thread(move || section::cut(reader, cut, step_mm, most)).await?;
    let section = section.map_err(|e| Error::from_core("profile", e))?;
    let chainage_mm = |x_mm: f64| run.chainage_mm + sign * x_mm;
    if csv {
        let headers = [(CONTENT_TYPE, "text/csv; charset=utf-8")];
        return Ok((headers, section_csv::text(&section, chainage_mm)).into_response());
    }
    Ok(axum::Json(wire_of(job, &section, chainage_mm)).into_response())
}

fn cut_of(query: &ProfileQuery, start_mm: f64, sign: f64) -> Result<Cut> {
    let expected = "chainage_mm, or from=x,y and to=x,y in mm";
    match (query.chainage_mm, &query.from, &query.to) {
        (Some(chainage_mm), None, None) if chainage_mm.is_finite() => {
            Ok(Cut::Across { x_mm: sign * (chainage_mm - start_mm) })
        }
        (None, Some(from), Some(to)) => Ok(Cut::Line { from_mm: place("from", from)?, to_mm: place("to", to)? }),
        _ => Err(Error::field("query", "the query does not say where to cut", expected)),
    }
}

fn place(field: &str, text: &str) -> Result<[f64; 2]> {
    let bad = || Error::field(field, format!("{field} is {text:?}"), "x,y in mm, such as 120.5,-30");
    let (x, y) = text.split_once(',').ok_or_else(bad)?;
    let number = |t: &str| t.trim().parse::<f64>().ok().filter(|v| v.is_finite()).ok_or_else(bad);
    Ok([number(x)?, number(y)?])
}

fn wire_of(job: String, section: &Section, chainage_mm: impl Fn(f64) -> f64) -> CrossSection {
    let points = &section.points;
    CrossSection {
        job,
        mm_per_px: section.map.mm_per_px,
        step_mm: section.step_mm,
        distance_mm: points.iter().map(|p| p.distance_mm).collect(),
        chainage_mm: points.iter().map(|p| chainage_mm(p.x_mm)).collect(),
        x_mm: points.iter().map(|p| p.x_mm).collect(),
        y_mm: points.iter().map(|p| p.y_mm).collect(),
        z_mm: points.iter().map(|p| p.z_mm.is_finite().then_some(p.z_mm)).collect(),
    }
}

#[derive(Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct TrajectoryQuery {
    #[param(minimum = 2, maximum = 100_000)]
    /// Most frames to answer, 2 to 100,000; 2,000 when nothing is said. Of longer runs every n-th frame is answered.
    frames: Option<u64>,
}

/// `trajectory.csv` as columns, thinned for plots.
#[utoipa::path(get, path = "/api/jobs/{job}/trajectory", tag = "jobs",
    params(("job" = String, Path, description = "The job"), TrajectoryQuery),
    responses((status = 200, body = Trajectory),
        (status = 400, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn get_trajectory(
    State(app): State<App>,
    Path(job): Path<String>,
    Query(query): Query<TrajectoryQuery>,
) -> Result<Response> {
    let most = query.frames.unwrap_or(USUAL_LINES);
    if !(2..=MOST_LINES).contains(&most) {
        return Err(Error::field("frames", format!("frames is {most}"), format!("2 to {MOST_LINES}")));
    }
    let frames = app.runs.job(&job).await?.frames;
    let file = app.runs.product(&job, "trajectory.csv").await?;
    let reader = StoredFileReader::new(app.store.clone(), file.key, file.facts.bytes);
    let every = frames.div_ceil(most).max(1);
    let read = off_thread(move || columns(BufReader::new(reader), every)).await?;
    let columns = read.map_err(|e| Error::Internal(format!("trajectory.csv: {e}")))?;
    Ok(axum::Json(Trajectory { job, frames, every, columns }).into_response())
}

/// Every n-th line's values by the names of the first line; `None` where there is no value.
fn columns(file: impl BufRead, every: u64) -> std::io::Result<std::collections::BTreeMap<String, Vec<Option<f64>>>> {
    let names: Vec<&str> = trajectory_csv::HEADER.split(',').collect();
    let mut columns = vec![Vec::new(); names.len()];
    for (index, line) in (0_u64..).zip(file.lines().skip(1)) {
        let line = line?;
        if index % every == 0 {
            let mut fields = line.split(',');
            for column in &mut columns {
                column.push(fields.next().and_then(|field| field.parse().ok()));
            }
        }
    }
    Ok(names.into_iter().map(str::to_string).zip(columns).collect())
}

/// Runs a read that blocks off the async threads.
async fn off_thread<T: Send + 'static>(read: impl FnOnce() -> T + Send + 'static) -> Result<T> {
    tokio::task::spawn_blocking(read).await.map_err(|e| Error::Internal(format!("reading a product stopped: {e}")))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn query(chainage_mm: Option<f64>, from: Option<&str>, to: Option<&str>) -> ProfileQuery {
        let text = |t: Option<&str>| t.map(String::from);
        ProfileQuery { chainage_mm, from: text(from), to: text(to), step_mm: None, format: None }
    }

    #[test]
    fn a_cut_is_read_from_the_query() {
        let backward = cut_of(&query(Some(900.0), None, None), 1000.0, -1.0).expect("across");
        assert_eq!(backward, Cut::Across { x_mm: 100.0 });
        let line = cut_of(&query(None, Some("1, 2.5"), Some("-3,4")), 0.0, 1.0).expect("line");
        assert_eq!(line, Cut::Line { from_mm: [1.0, 2.5], to_mm: [-3.0, 4.0] });
        for (chainage, from, to) in [
            (None, None, None),
            (Some(1.0), Some("1,2"), Some("3,4")),
            (None, Some("1"), Some("3,4")),
            (Some(f64::NAN), None, None),
            (None, Some("1,x"), Some("3,4")),
        ] {
            assert!(cut_of(&query(chainage, from, to), 0.0, 1.0).is_err(), "{chainage:?} {from:?} {to:?}");
        }
    }

    #[test]
    fn every_nth_line_of_a_trajectory() {
        let lines: String = (0..10).map(|i| format!("{i},{}.5,,,,,,,,,,7,0,\n", i)).collect();
        let text = format!("{}\n{lines}", trajectory_csv::HEADER);
        let columns = columns(text.as_bytes(), 4).expect("read");
        assert_eq!(columns["frame"], [Some(0.0), Some(4.0), Some(8.0)]);
        assert_eq!(columns["time_s"][2], Some(8.5));
        assert_eq!(columns["x_mm"], [None; 3]);
    }
}

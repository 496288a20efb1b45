//! Defects of all runs: list, read, say something about one; as a table and as GeoJSON; one over all runs.

use axum::Extension;
use axum::extract::State;
use axum::http::header::{CONTENT_DISPOSITION, CONTENT_TYPE};
use axum::response::{IntoResponse, Response};
use serde::Deserialize;
use serde_json::json;
use utoipa::IntoParams;

use super::App;
use super::extract::{IfMatch, Json, Path, Query};
use crate::auth::Visitor;
use crate::defects::{DefectFilter, DefectSort};
use crate::error::{Error, Result};
use crate::runs::Page;
use crate::wire::{Defect, DefectChange, DefectHistory, DefectPage, Problem};

/// Most rows of a table or of a GeoJSON document: more is asked for in parts.
const MAX_ROWS: usize = 50_000;
/// How far runs may lie shifted to each other, where nothing is said, mm.
const USUAL_SLACK_MM: f64 = 100.0;
/// The most that may be said, mm.
const MOST_SLACK_MM: f64 = 1000.0;

#[derive(Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct DefectQuery {
    /// Defects on this asset only.
    asset: Option<String>,
    /// Defects of this run only.
    run: Option<String>,
    /// Defects of this job only; when nothing is said, of every run's latest job that is done.
    job: Option<String>,
    /// `dent`, `bulge`, `step`, `hole` or `missing_material`.
    kind: Option<String>,
    /// `minor`, `moderate` or `severe`.
    severity: Option<String>,
    /// `open`, `acknowledged`, `watched`, `repaired` or `dismissed`.
    state: Option<String>,
    /// At this chainage or behind it, mm.
    from_mm: Option<f64>,
    /// Before this chainage, mm.
    to_mm: Option<f64>,
    /// At least so deep or high, mm.
    depth_min_mm: Option<f64>,
    /// With this text in the asset's name, the comment, the kind or the code.
    q: Option<String>,
    /// `created`, `chainage` or `depth`, with a minus before it for the other way round; `-created` when nothing is said.
    sort: Option<String>,
    /// `next_cursor` of the page before.
    cursor: Option<String>,
    /// Most items, 1 to 1000; 50 when nothing is said.
    limit: Option<u64>,
}

impl DefectQuery {
    fn read(self) -> Result<(DefectFilter, Page)> {
        let page = Page::new(self.cursor, self.limit)?;
        for (field, value) in [("from_mm", self.from_mm), ("to_mm", self.to_mm), ("depth_min_mm", self.depth_min_mm)] {
            if let Some(value) = value.filter(|v| !v.is_finite()) {
                return Err(Error::field(field, format!("{field} is {value}"), "a number of mm"));
            }
        }
        let filter = DefectFilter {
            asset: self.asset,
            run: self.run,
            job: self.job,
            kind: self.kind,
            severity: self.severity,
            state: self.state,
            from_mm: self.from_mm,
            to_mm: self.to_mm,
            depth_min_mm: self.depth_min_mm,
            q: self.q,
            sort: DefectSort::parse(self.sort.as_deref())?,
        };
        Ok((filter, page))
    }
}

/// Defects of all runs, those of the newest jobs first or in another order.
#[utoipa::path(get, path = "/api/defects", tag = "defects", params(DefectQuery),
    responses((status = 200, body = DefectPage), (status = 400, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn list_defects(State(app): State<App>, Query(query): Query<DefectQuery>) -> Result<Response> {
    let (filter, page) = query.read()?;
    Ok(axum::Json(app.defects.list(&filter, &page).await?).into_response())
}

/// A defect.
#[utoipa::path(get, path = "/api/defects/{defect}", tag = "defects",
    params(("defect" = String, Path, description = "The defect")),
    responses((status = 200, body = Defect), (status = 404, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn get_defect(State(app): State<App>, Path(defect): Path<String>) -> Result<Response> {
    Ok(axum::Json(app.defects.get(&defect).await?).into_response())
}

/// Changes what people say about a defect: its state, a comment.
#[utoipa::path(patch, path = "/api/defects/{defect}", tag = "defects",
    params(("defect" = String, Path, description = "The defect"),
        ("If-Match" = Option<String>, Header, description = "The defect's `version`, quoted: changes nothing where it has another by now")),
    request_body = DefectChange,
    responses((status = 200, body = Defect), (status = 400, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json"),
        (status = 412, body = Problem, content_type = "application/problem+json", description = "Somebody else has changed it")))]
pub(super) async fn change_defect(
    State(app): State<App>,
    Extension(visitor): Extension<Visitor>,
    Path(defect): Path<String>,
    IfMatch(versions): IfMatch,
    Json(change): Json<DefectChange>,
) -> Result<Response> {
    Ok(axum::Json(app.defects.change(&defect, change, versions.as_deref(), &visitor.name).await?).into_response())
}

#[derive(Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct HistoryQuery {
    /// How far runs may lie shifted to each other, mm; 100 when nothing is said.
    slack_mm: Option<f64>,
}

/// One defect over all runs of its asset that go the same way, matched by place and by the defects around it.
#[utoipa::path(get, path = "/api/defects/{defect}/history", tag = "defects",
    params(("defect" = String, Path, description = "The defect"), HistoryQuery),
    responses((status = 200, body = DefectHistory),
        (status = 400, body = Problem, content_type = "application/problem+json"),
        (status = 404, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn get_history(
    State(app): State<App>,
    Path(defect): Path<String>,
    Query(query): Query<HistoryQuery>,
) -> Result<Response> {
    let slack_mm = query.slack_mm.unwrap_or(USUAL_SLACK_MM);
    if !(0.0..=MOST_SLACK_MM).contains(&slack_mm) {
        return Err(Error::field("slack_mm", format!("slack_mm is {slack_mm}"), format!("0 to {MOST_SLACK_MM} mm")));
    }
    Ok(axum::Json(app.defects.history(&defect, slack_mm).await?).into_response())
}

/// The first line of the table.
const HEADER: &str = "id,asset,run,job,number,kind,severity,code,chainage_mm,clock_h,height_mm,x_mm,y_mm,z_mm,depth_mm,\
                      length_mm,width_mm,area_mm2,volume_mm3,steepest_slope_deg,confidence,at_edge,state,comment,\
                      changed_at,changed_by\n";

/// The filtered defects as CSV, up to 50,000; `cursor` and `limit` have no say.
#[utoipa::path(get, path = "/api/defects.csv", tag = "defects", params(DefectQuery),
    responses((status = 200, content_type = "text/csv", body = String),
        (status = 400, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn get_csv(State(app): State<App>, Query(query): Query<DefectQuery>) -> Result<Response> {
    let mut table = String::from(HEADER);
    for d in all(&app, query).await? {
        let number = |value: Option<f64>| value.map_or(String::new(), |v| format!("{v:.3}"));
        let fields = [
            d.id,
            d.asset,
            d.run,
            d.job,
            d.number.to_string(),
            d.kind,
            d.severity,
            d.code.unwrap_or_default(),
            number(Some(d.chainage_mm)),
            number(d.clock_h),
            number(d.height_mm),
            number(Some(d.x_mm)),
            number(Some(d.y_mm)),
            number(Some(d.z_mm)),
            number(Some(d.depth_mm)),
            number(Some(d.length_mm)),
            number(Some(d.width_mm)),
            number(Some(d.area_mm2)),
            number(Some(d.volume_mm3)),
            number(Some(d.steepest_slope_deg)),
            number(Some(d.confidence)),
            d.at_edge.to_string(),
            d.state.as_str().into(),
            d.comment,
            d.changed_at.unwrap_or_default(),
            d.changed_by.unwrap_or_default(),
        ];
        table.push_str(&fields.map(|field| quoted(&field)).join(","));
        table.push('\n');
    }
    Ok(named(table, "text/csv; charset=utf-8", "defects.csv"))
}

/// The filtered defects as GeoJSON, up to 50,000. The coordinates are the asset's own, no places on Earth: x is the chainage
/// in metres; y is the height in metres on a wall and the clock position in hours in a pipe, as each feature's `y_is` says.
#[utoipa::path(get, path = "/api/defects.geojson", tag = "defects", params(DefectQuery),
    responses((status = 200, content_type = "application/geo+json", body = Object),
        (status = 400, body = Problem, content_type = "application/problem+json")))]
pub(super) async fn get_geojson(State(app): State<App>, Query(query): Query<DefectQuery>) -> Result<Response> {
    let features: Vec<serde_json::Value> = all(&app, query).await?.iter().map(feature).collect();
    let document = json!({
        "type": "FeatureCollection",
        // "No reference system can be assumed" (GeoJSON 2008, section 3); readers of RFC 7946 pass it over.
        "crs": null,
        "coordinates_are": "local to each asset: x = chainage in m; y = height in m (walls) or clock position in h (pipes), \
                            see y_is; no places on Earth",
        "features": features,
    });
    Ok(named(document.to_string(), "application/geo+json", "defects.geojson"))
}

fn feature(d: &Defect) -> serde_json::Value {
    let (y, y_is) = match (d.clock_h, d.height_mm) {
        (Some(hours), _) => (hours, "clock_h"),
        (None, Some(height_mm)) => (height_mm / 1000.0, "height_m"),
        (None, None) => (-d.y_mm / 1000.0, "height_m"),
    };
    let mut properties = json!(d);
    properties["y_is"] = y_is.into();
    json!({
        "type": "Feature",
        "id": d.id,
        "geometry": {"type": "Point", "coordinates": [d.chainage_mm / 1000.0, y]},
        "properties": properties,
    })
}

/// All pages of a filter. A part of a list that looks like the whole would be worse than none.
async fn all(app: &App, query: DefectQuery) -> Result<Vec<Defect>> {
    let (filter, _) = query.read()?;
    let mut rows = Vec::new();
    let mut cursor = None;
    loop {
        let page = app.defects.list(&filter, &Page::new(cursor, Some(Page::MAX))?).await?;
        rows.extend(page.items);
        if rows.len() > MAX_ROWS {
            let expected = "a narrower filter: an asset, a run, a part of the chainage";
            return Err(Error::field("query", format!("more than {MAX_ROWS} defects fit"), expected));
        }
        if page.next_cursor.is_none() {
            return Ok(rows);
        }
        cursor = page.next_cursor;
    }
}

fn named(body: String, content_type: &str, name: &str) -> Response {
    let disposition = format!("attachment; filename=\"{name}\"");
    ([(CONTENT_TYPE, content_type.to_string()), (CONTENT_DISPOSITION, disposition)], body).into_response()
}

/// A text as a field of a CSV file. A spreadsheet takes what begins like a formula for one: it gets a mark before it.
fn quoted(text: &str) -> String {
    let formula = text.starts_with(['=', '+', '@', '\t']) || text.starts_with('-') && text.parse::<f64>().is_err();
    let text = if formula { format!("'{text}") } else { text.to_string() };
    if text.contains([',', '"', '\n', '\r']) { format!("\"{}\"", text.replace('"', "\"\"")) } else { text }
}

#[cfg(test)]
mod tests {
    use super::quoted;

    #[test]
    fn fields_hold_any_text_and_no_formula() {
        assert_eq!(quoted("plain"), "plain");
        assert_eq!(quoted("-3.25"), "-3.25");
        assert_eq!(quoted("a, \"b\""), "\"a, \"\"b\"\"\"");
        assert_eq!(quoted("=1+1"), "'=1+1");
    }
}

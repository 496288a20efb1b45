//! The report's words: head, table, blocks, method and limits.

use std::fmt::Write;

use super::ReportRun;
use super::drawings;
use super::pictures::{Placed, Views};
use crate::defects::{Defect, DefectKind, DefectList};
use crate::motion::metric::Drift;

/// An ovality of fewer standard deviations is not told from none.
const TOLD_APART_SDS: f64 = 2.0;

const STYLE: &str = include_str!("style.css");

/// Everything above the overview.
pub(super) fn head(page: &mut String, run: &ReportRun, list: &DefectList) {
    let title = if run.asset.is_empty() { run.source } else { run.asset };
    let quality = run.quality;
    let _ = write!(
        page,
        "<!doctype html><html lang=\"en\"><head><meta charset=\"utf-8\">\
         <meta name=\"viewport\" content=\"width=device-width\"><title>Inspection report: {t}</title><style>{STYLE}</style>\
         </head><body><header><h1>Inspection report</h1><p class=\"asset\">{t}</p></header>",
        t = escaped(title)
    );
    let chainage = |x: f64| list.start_chainage_mm + if list.chainage_falls { -x } else { x };
    let (from, to) = (chainage(list.inspected.x_min_mm), chainage(list.inspected.x_min_mm + list.inspected.length_mm));
    let facts = [
        ("Run", escaped(run.source)),
        ("Recorded", run.recorded_at.strftime("%Y-%m-%d %H:%M UTC").to_string()),
        ("Rig", escaped(run.rig)),
        ("Chainage", format!("{:.3} m to {:.3} m", from / 1000.0, to / 1000.0)),
        (
            "Surface inspected",
            format!("{:.2} m², {:.1} % of the map", list.inspected.area_mm2 / 1e6, 100.0 * list.inspected.coverage),
        ),
        ("Undamaged shape", reference(list)),
        (
            "Frames",
            format!(
                "{}, line found in {}, motion found in {}",
                quality.frames, quality.frames_with_stripe, quality.frames_tracked
            ),
        ),
        ("Breaks of the way", quality.breaks.to_string()),
        ("Drift of the places", drift(quality.drift.as_ref())),
        ("Found", found(list)),
        (
            "Detection limit",
            format!(
                "{:.2} mm for a round dent of {:.0} mm radius (see Method and limits)",
                list.detection_limit_mm, list.detection_limit_radius_mm
            ),
        ),
    ];
    page.push_str("<dl class=\"facts\">");
    for (name, value) in facts {
        let _ = write!(page, "<dt>{name}</dt><dd>{value}</dd>");
    }
    page.push_str("</dl>");
    if !run.warnings.is_empty() {
        page.push_str("<ul class=\"warnings\">");
        run.warnings.iter().for_each(|warning| {
            let _ = write!(page, "<li>{}</li>", escaped(warning));
        });
        page.push_str("</ul>");
    }
}

fn drift(drift: Option<&Drift>) -> String {
    let Some(drift) = drift else { return "not known for this way".into() };
    format!(
        "up to the end {:.1} mm along the way, {:.1} mm across it, {:.1} mm in depth (one standard deviation)",
        drift.x_mm, drift.y_mm, drift.z_mm
    )
}

fn reference(list: &DefectList) -> String {
    let shape = &list.reference;
    match (shape.radius_mm, shape.radius_sd_mm) {
        (Some(radius), sd) => format!(
            "pipe of radius {radius:.1} mm (standard deviation {:.2} mm), seen from {}; ovality {}",
            sd.unwrap_or(0.0),
            shape.seen_from.as_deref().unwrap_or("one side"),
            match (shape.ovality_percent, shape.ovality_sd_percent) {
                (Some(ovality), Some(sd)) if ovality.abs() < TOLD_APART_SDS * sd => format!(
                    "not told from a round pipe: {:.2} % with a standard deviation of {sd:.2} % from the arc that was seen",
                    ovality.abs()
                ),
                (Some(ovality), Some(sd)) => format!("{:.2} % (standard deviation {sd:.2} %)", ovality.abs()),
                _ => "not determined".into(),
            }
        ),
        _ => "plane".into(),
    }
}

fn found(list: &DefectList) -> String {
    if list.defects.is_empty() {
        return "no defect above the detection limit".into();
    }
    let counts = DefectKind::ALL.iter().filter_map(|kind| {
        let count = list.defects.iter().filter(|d| d.kind == *kind).count();
        (count > 0).then(|| format!("{count} {}", kind.name().replace('_', " ")))
    });
    counts.collect::<Vec<_>>().join(", ")
}

/// All defects.
pub(super) fn table(page: &mut String, list: &DefectList) {
    if list.defects.is_empty() {
        page.push_str("<p class=\"none\">No defect above the detection limit.</p>");
        return;
    }
    let place = if list.reference.radius_mm.is_some() { "Clock" } else { "Height, mm" };
    let _ = write!(
        page,
        "<h2>Defects</h2><table><thead><tr><th>No</th><th>Kind</th><th>Class</th><th>Code</th><th>Chainage, m</th>\
         <th>{place}</th><th>Depth, mm</th><th>Length × width, mm</th><th>Area, mm²</th><th>Volume, mm³</th>\
         <th>Steepest</th><th>Sure</th></tr></thead><tbody>"
    );
    for d in &list.defects {
        let _ = write!(
            page,
            "<tr class=\"{s}\"><td><a href=\"#d{}\">{}</a></td><td>{}</td><td>{s}</td><td>{}</td><td>{:.3}</td><td>{}</td>\
             <td>{:+.2}</td><td>{:.0} × {:.0}</td><td>{:.0}</td><td>{:.0}</td><td>{:.0}°</td><td>{:.0} %</td></tr>",
            d.id,
            d.id,
            d.kind.name().replace('_', " "),
            escaped(d.code.as_deref().unwrap_or("")),
            d.chainage_mm / 1000.0,
            position(d),
            d.depth_mm,
            d.length_mm,
            d.width_mm,
            d.area_mm2,
            d.volume_mm3,
            d.steepest_slope_deg,
            100.0 * d.confidence,
            s = escaped(&d.severity),
        );
    }
    page.push_str("</tbody></table><p class=\"note\">Depth: + away from the camera, − towards it.</p>");
    if list.omitted > 0 {
        let _ = write!(page, "<p>{} shallower ones are not listed.</p>", list.omitted);
    }
}

/// Clock position or height, in words.
fn position(d: &Defect) -> String {
    match (d.clock_h, d.height_mm) {
        (Some(hour), _) => {
            let minutes = (hour * 60.0).round() as i64;
            let hours = (minutes / 60 + 11) % 12 + 1;
            format!("{hours}:{:02}", minutes % 60)
        }
        (None, Some(height)) => format!("{height:.0}"),
        (None, None) => String::new(),
    }
}

/// One defect with its pictures.
pub(super) fn block(page: &mut String, d: &Defect, views: &Views) {
    let _ = write!(
        page,
        "<section class=\"defect\" id=\"d{}\"><h3>{} · {} · {:+.2} mm</h3><p>Depth ± {:.2} mm. Chainage {:.3} m, {} {}; {:.0} × {:.0} mm, area \
         {:.0} mm², volume {:.0} mm³, steepest slope {:.0}°, {:+.2} mm square to the surface. Scatter of the surface beside it \
         {:.2} mm, {:.0} % of it measured, {:.0} % sure{}.</p><div class=\"views\">",
        d.id,
        d.id,
        d.kind.name().replace('_', " "),
        d.depth_mm,
        d.depth_sd_mm,
        d.chainage_mm / 1000.0,
        if d.clock_h.is_some() { "clock" } else { "height (mm)" },
        position(d),
        d.length_mm,
        d.width_mm,
        d.area_mm2,
        d.volume_mm3,
        d.steepest_slope_deg,
        d.depth_normal_mm,
        d.noise_mm,
        100.0 * d.measured_share,
        100.0 * d.confidence,
        if d.at_edge { "; it reaches the edge of what was seen and may be larger" } else { "" },
    );
    picture(page, &views.residual, "deviation from the undamaged shape");
    if let Some(texture) = &views.texture {
        picture(page, texture, "visible image");
    }
    drawings::cross_section(page, "Along the travel", &views.along_x);
    drawings::cross_section(page, "Across the travel", &views.along_y);
    page.push_str("</div></section>");
}

fn picture(page: &mut String, placed: &Placed, name: &str) {
    let _ = write!(
        page,
        "<figure><img src=\"{}\" width=\"{}\" height=\"{}\" alt=\"{name}\"><figcaption>{name}, {:.0} mm wide</figcaption></figure>",
        placed.url,
        placed.width_px,
        placed.height_px,
        placed.width_px as f64 * placed.mm_per_px
    );
}

/// What was done and what it cannot see.
pub(super) fn method(page: &mut String, run: &ReportRun, list: &DefectList) {
    let pipe = list.reference.radius_mm.is_some();
    let _ = write!(
        page,
        "<h2>Method and limits</h2><p>A line laser and a camera (method <em>{}</em>) measured the surface; {} was fitted to it, \
         and what departs from that shape by more than the scatter beside it is listed. Waves longer than {:.0} mm count as \
         the undamaged surface. The surface was searched in cells of {:.1} mm; it scatters by {:.3} mm (one standard deviation). \
         Profiles lie {:.1} mm apart: what only one of them shows is not listed, nor a dent of less than {:.0} mm radius.</p>",
        escaped(run.method),
        if pipe { "a cylinder along the travel" } else { "a plane" },
        list.reference.wave_mm,
        list.cell_mm,
        list.noise_mm,
        list.profile_step_mm,
        list.least_radius_mm(),
    );
    page.push_str(
        "<p>A round dent or bulge must be at least so deep to be listed:</p><table class=\"limits\"><thead><tr><th>Radius, mm</th>",
    );
    list.detection_limits.iter().for_each(|l| {
        let _ = write!(page, "<th>{:.0}</th>", l.radius_mm);
    });
    page.push_str("</tr></thead><tbody>");
    for (name, limits) in
        [("typical rows, mm", &list.detection_limits), ("worst rows, mm", &list.detection_limits_worst_rows)]
    {
        let _ = write!(page, "<tr><td>{name}</td>");
        limits.iter().for_each(|l| {
            let _ = write!(page, "<td>{:.2}</td>", l.depth_mm);
        });
        page.push_str("</tr>");
    }
    page.push_str("</tbody></table><ul>");
    let _ = write!(
        page,
        "<li>{:.1} % of the map was not measured, or not surely (highlights, shadows, lamps, edges): nothing can be said there, the \
         overview is grey. {} departures beside such places were too little seen to be believed.</li>",
        100.0 * (1.0 - list.inspected.coverage),
        list.doubtful
    );
    if let Some(resolution) = run.resolution {
        let _ = write!(
            page,
            "<li>At {:.0} mm, one pixel is {:.2} mm of depth and {:.2} mm along the line.</li>",
            resolution.distance_mm, resolution.r_depth_mm, resolution.r_vertical_mm
        );
    }
    page.push_str(
        "<li>Cracks, discolouration, corrosion without relief and leaks are not looked for. Depths are along the viewing \
         direction unless said otherwise. Positions along the chainage drift with the way travelled (Drift of the places, above; an error of the rig adds to it).</li></ul>",
    );
}

/// Text inside HTML.
fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

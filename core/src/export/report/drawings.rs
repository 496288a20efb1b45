//! The report's drawings, as SVG: numbered strips, sections through a defect, curves along the chainage.

use std::fmt::Write;

use super::pictures::{Colours, Placed};
use crate::defects::{DefectList, SectionRow};

/// Size of a curve, px.
const CURVE: (f64, f64) = (1060.0, 150.0);
/// Room for the numbers beside a curve, px.
const MARGIN: (f64, f64) = (58.0, 22.0);

/// A strip of the overview with its defects' numbers and the chainage below.
pub(super) fn strip(page: &mut String, strip: &Placed, list: &DefectList) {
    let (width, height) = (strip.width_px as f64, strip.height_px as f64);
    let (x0, y0) = strip.corner_mm;
    let _ = write!(
        page,
        "<svg class=\"strip\" viewBox=\"0 -14 {width} {:.0}\" role=\"img\" \
         aria-label=\"Deviation from the undamaged shape\"><image href=\"{}\" width=\"{width}\" height=\"{height}\"/>",
        height + 32.0,
        strip.url
    );
    let to = |x: f64, y: f64| ((x - x0) / strip.mm_per_px, (y - y0) / strip.mm_per_px);
    for defect in &list.defects {
        let b = &defect.bounds;
        let ((left, top), (right, bottom)) = (to(b.x_min_mm, b.y_min_mm), to(b.x_max_mm, b.y_max_mm));
        let middle = to(defect.x_mm, defect.y_mm).0;
        if middle < 0.0 || middle >= width {
            continue;
        }
        let _ = write!(
            page,
            "<a href=\"#d{id}\"><rect x=\"{left:.1}\" y=\"{top:.1}\" width=\"{:.1}\" height=\"{:.1}\"/>\
             <text x=\"{:.1}\" y=\"{:.1}\">{id}</text></a>",
            right - left,
            bottom - top,
            left + 2.0,
            (top - 3.0).max(-2.0),
            id = defect.id
        );
    }
    let sign = if list.chainage_falls { -1.0 } else { 1.0 };
    let step_mm = round_step(width * strip.mm_per_px / 6.0);
    let mut at_mm = (x0 / step_mm).ceil() * step_mm;
    while at_mm < x0 + width * strip.mm_per_px {
        let x = (at_mm - x0) / strip.mm_per_px;
        let chainage = list.start_chainage_mm + sign * at_mm;
        let _ = write!(
            page,
            "<path d=\"M{x:.1} {height}v5\"/><text class=\"tick\" x=\"{x:.1}\" y=\"{:.1}\">{:.2} m</text>",
            height + 15.0,
            chainage / 1000.0
        );
        at_mm += step_mm;
    }
    page.push_str("</svg>");
}

/// What the colours mean.
pub(super) fn legend(page: &mut String, colours: &Colours) {
    page.push_str("<svg class=\"legend\" viewBox=\"0 0 420 34\" role=\"img\" aria-label=\"Colours\">");
    for i in 0..60 {
        let [r, g, b] = colours.at((f64::from(i) / 29.5 - 1.0) * colours.reach_mm);
        let _ =
            write!(page, "<rect x=\"{}\" y=\"2\" width=\"5.2\" height=\"12\" fill=\"rgb({r},{g},{b})\"/>", 60 + 5 * i);
    }
    let reach = colours.reach_mm;
    let _ = write!(
        page,
        "<text class=\"tick\" x=\"60\" y=\"28\">−{reach:.1} mm, towards the camera</text>\
         <text class=\"tick end\" x=\"360\" y=\"28\">+{reach:.1} mm, away</text></svg>"
    );
}

/// A cross-section through a defect: residual over the way.
pub(super) fn cross_section(page: &mut String, name: &str, values: &[(f64, f64)]) {
    const SIZE: (f64, f64) = (330.0, 120.0);
    let known = values.iter().filter(|v| v.1.is_finite());
    let (from, to) = (values.first().map_or(0.0, |v| v.0), values.last().map_or(1.0, |v| v.0));
    let (low, high) = known.fold((-0.5_f64, 0.5_f64), |(a, b), v| (a.min(v.1), b.max(v.1)));
    let (left, bottom) = (40.0, SIZE.1 - 24.0);
    let x = |mm: f64| left + (mm - from) / (to - from).max(1e-9) * (SIZE.0 - left - 6.0);
    // Away from the camera is down: as one would see it in the wall.
    let y = |mm: f64| 10.0 + (mm - low) / (high - low) * (bottom - 16.0);
    let _ = write!(
        page,
        "<figure><svg class=\"curve\" viewBox=\"0 0 {} {}\"><path class=\"zero\" d=\"M{left} {:.1}H{}\"/>{}\
         <text class=\"tick end\" x=\"36\" y=\"{:.1}\">{low:.1}</text><text class=\"tick end\" x=\"36\" y=\"{:.1}\">{high:.1}</text>\
         <text class=\"tick\" x=\"{left}\" y=\"{:.1}\">{from:.0} mm</text><text class=\"tick end\" x=\"{}\" y=\"{:.1}\">{to:.0} mm</text>\
         </svg><figcaption>{name}, residual in mm</figcaption></figure>",
        SIZE.0,
        SIZE.1,
        y(0.0),
        SIZE.0 - 6.0,
        path(values, &x, &y),
        y(low) + 4.0,
        y(high) + 4.0,
        SIZE.1 - 6.0,
        SIZE.0 - 6.0,
        SIZE.1 - 6.0
    );
}

/// A line with gaps where there is no value.
fn path(values: &[(f64, f64)], x: &impl Fn(f64) -> f64, y: &impl Fn(f64) -> f64) -> String {
    let mut d = String::new();
    let mut down = false;
    for (at, value) in values {
        if value.is_finite() {
            let _ = write!(d, "{}{:.1} {:.1}", if down { 'L' } else { 'M' }, x(*at), y(*value));
        }
        down = value.is_finite();
    }
    format!("<path class=\"line\" d=\"{d}\"/>")
}

/// The measures of the sections over the chainage.
pub(super) fn sections(page: &mut String, rows: &[SectionRow]) {
    type Pick = fn(&SectionRow) -> Option<f64>;
    let curves: [(&str, Pick); 6] = [
        ("Radius, mm", |r| r.radius_mm),
        ("Ovality, %", |r| r.ovality_percent),
        ("Loss of radius, mm", |r| r.radius_loss_mm),
        ("Flatness, mm", |r| r.flatness_mm),
        ("Roughness, mm", |r| Some(r.roughness_mm)),
        ("Measured share", |r| Some(r.measured_share)),
    ];
    for (name, pick) in curves {
        let values: Vec<(f64, f64)> = rows.iter().filter_map(|r| Some((r.chainage_mm / 1000.0, pick(r)?))).collect();
        if values.len() > 1 {
            curve(page, name, &values);
        }
    }
}

fn curve(page: &mut String, name: &str, values: &[(f64, f64)]) {
    let (from, to) = values.iter().fold((f64::MAX, f64::MIN), |(a, b), v| (a.min(v.0), b.max(v.0)));
    let (low, high) = values.iter().fold((f64::MAX, f64::MIN), |(a, b), v| (a.min(v.1), b.max(v.1)));
    let room = (0.08 * (high - low)).max(1e-3 * high.abs()).max(1e-6);
    let (low, high) = (low - room, high + room);
    let x = |m: f64| MARGIN.0 + (m - from) / (to - from).max(1e-9) * (CURVE.0 - MARGIN.0 - 8.0);
    let y = |v: f64| 8.0 + (high - v) / (high - low) * (CURVE.1 - MARGIN.1 - 12.0);
    let digits = if high - low > 20.0 {
        0
    } else if high - low > 0.5 {
        2
    } else {
        4
    };
    let _ = write!(
        page,
        "<figure class=\"wide\"><svg class=\"curve\" viewBox=\"0 0 {} {}\"><path class=\"zero\" d=\"M{} {:.1}H{}M{} {:.1}H{}\"/>{}\
         <text class=\"tick end\" x=\"{}\" y=\"{:.1}\">{high:.digits$}</text><text class=\"tick end\" x=\"{}\" y=\"{:.1}\">{low:.digits$}</text>\
         <text class=\"tick\" x=\"{}\" y=\"{:.1}\">{from:.2} m</text><text class=\"tick end\" x=\"{}\" y=\"{:.1}\">{to:.2} m</text>\
         </svg><figcaption>{name}</figcaption></figure>",
        CURVE.0,
        CURVE.1,
        MARGIN.0,
        y(low),
        CURVE.0 - 8.0,
        MARGIN.0,
        y(high),
        CURVE.0 - 8.0,
        path(values, &x, &y),
        MARGIN.0 - 5.0,
        y(high) + 5.0,
        MARGIN.0 - 5.0,
        y(low) + 4.0,
        MARGIN.0,
        CURVE.1 - 4.0,
        CURVE.0 - 8.0,
        CURVE.1 - 4.0
    );
}

/// 1, 2 or 5 times a power of ten, not below a length.
fn round_step(least: f64) -> f64 {
    let power = 10.0_f64.powf(least.max(1e-9).log10().floor());
    [1.0, 2.0, 5.0, 10.0].into_iter().map(|n| n * power).find(|step| *step >= least).unwrap_or(10.0 * power)
}

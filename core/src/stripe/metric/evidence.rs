//! Where the line may be: ridges of the laser's colour against their surroundings, from the chroma alone.
//!
//! Not a fixed range of hues: a wall tinted green, green paint and the edge of a green lamp's light are as green on one
//! side as in the middle; only a line is greener than both its sides.

use crate::rig::{LaserColour, LineDirection};
use crate::source::Yuv;
use crate::stripe::choice::Candidate;

/// Line positions per group.
pub(super) const GROUP: usize = 8;
/// Luma pixels per cell across the line.
const CELL_PX: usize = 2;
/// Half widths of the ridges that are looked for, cells: a fine line, and one whose clipped core has lost its colour.
const HALF_WIDTHS: [usize; 2] = [2, 5];
/// Above this width, px, a line is a wide one.
const WIDE_PX: f32 = 14.0;
/// Cells that are looked at together.
const SKIP: usize = 32;
/// Peaks closer than this are one, cells.
const PEAK_DISTANCE: usize = 6;
/// Cells that tell the colour of the wall beside the line.
const SIDE_CELLS: usize = 3;
pub(super) const SIDE_PX: usize = SIDE_CELLS * CELL_PX;
/// Candidates of one group, at most: the strongest.
const MAX_CANDIDATES: usize = 8;

/// The ridges of each group of [`GROUP`] line positions, across the line in luma px; their contrast is the mean
/// difference in chroma levels. `width_px` is the line's width where it is known.
pub(super) fn ridges(
    image: Yuv<'_>,
    colour: LaserColour,
    line: LineDirection,
    width_px: Option<f32>,
    least: f32,
    scratch: &mut Scratch,
) -> Vec<Vec<Candidate>> {
    let half_widths = match width_px {
        None => &HALF_WIDTHS[..],
        Some(width) if width < WIDE_PX => &HALF_WIDTHS[..1],
        Some(_) => &HALF_WIDTHS[1..],
    };
    scratch.field.fill(image, colour, line);
    let Scratch { field, prefix, response } = scratch;
    prefix.clear();
    prefix.resize(field.cells + 1, 0);
    response.resize(field.cells, 0.0);
    let scale = 1.0 / field.samples as f32;
    (0..field.groups)
        .map(|group| {
            let row = &field.values[group * field.cells..][..field.cells];
            let mut sum = 0;
            for (to, value) in prefix[1..].iter_mut().zip(row) {
                sum += i32::from(*value);
                *to = sum;
            }
            response.fill(0.0);
            half_widths.iter().for_each(|half| ridge_response(prefix, *half, scale, response));
            peaks(response, least, row, prefix)
        })
        .collect()
}

/// What is filled anew for each frame, in memory that is kept.
#[derive(Default)]
pub(super) struct Scratch {
    field: Field,
    prefix: Vec<i32>,
    response: Vec<f32>,
}

impl Scratch {
    /// How much of the laser's colour the wall has on both sides of a place, in chroma levels (below 0: poorer than gray).
    /// The sides begin `away_px` from it and are [`SIDE_PX`] wide; `None` where one is not in the image.
    pub(super) fn sides(&self, group: usize, across_px: f32, away_px: f32) -> Option<[f32; 2]> {
        let Field { values, groups, cells, samples } = &self.field;
        let side = |first_px: f32| {
            let first = (first_px / CELL_PX as f32).round();
            let inside = group < *groups && first >= 0.0 && first as usize + SIDE_CELLS <= *cells;
            let side = inside.then(|| &values[group * cells + first as usize..][..SIDE_CELLS])?;
            Some(side.iter().map(|value| f32::from(*value)).sum::<f32>() / (SIDE_CELLS * samples) as f32)
        };
        Some([side(across_px - away_px - SIDE_PX as f32)?, side(across_px + away_px)?])
    }
}

/// The difference between a box and the greater of its two neighbours; keeps the larger of what is there and this.
fn ridge_response(prefix: &[i32], half: usize, scale: f32, response: &mut [f32]) {
    let width = 2 * half + 1;
    let cells = response.len();
    if cells < 3 * width {
        return;
    }
    let scale = scale / width as f32;
    let count = cells - 3 * width + 1;
    let edges: [&[i32]; 4] = std::array::from_fn(|i| &prefix[i * width..][..count]);
    for (i, out) in response[width + half..][..count].iter_mut().enumerate() {
        let middle = edges[2][i] - edges[1][i];
        let sides = (edges[1][i] - edges[0][i]).max(edges[3][i] - edges[2][i]);
        *out = out.max((middle - sides) as f32 * scale);
    }
}

fn peaks(response: &[f32], least: f32, row: &[i16], prefix: &[i32]) -> Vec<Candidate> {
    let mut found: Vec<Candidate> = Vec::new();
    let mut at = 0;
    while at < response.len() {
        if response[at] < least {
            // Mostly there is nothing: skip what is below the least at once.
            let none = |part: &[f32]| part.iter().map(|r| u32::from(*r >= least)).sum::<u32>() == 0;
            at += match response.get(at..at + SKIP) {
                Some(part) if none(part) => SKIP,
                _ => 1,
            };
            continue;
        }
        // The highest of this stretch, as long as it keeps rising within the distance.
        let mut best = at;
        let mut look = at + 1;
        while look < response.len() && look <= best + PEAK_DISTANCE {
            if response[look] > response[best] {
                best = look;
            }
            look += 1;
        }
        let across_px = centroid(row, prefix, best) * CELL_PX as f32 + 0.5;
        found.push(Candidate { across_px, contrast: response[best] });
        at = best + PEAK_DISTANCE + 1;
    }
    if found.len() > MAX_CANDIDATES {
        found.sort_by(|a, b| b.contrast.total_cmp(&a.contrast));
        found.truncate(MAX_CANDIDATES);
        found.sort_by(|a, b| a.across_px.total_cmp(&b.across_px));
    }
    found
}

/// The colour's centroid around a cell, cells: what is greener than the surroundings on both sides.
fn centroid(row: &[i16], prefix: &[i32], cell: usize) -> f32 {
    const REACH: usize = 8;
    const SIDE: usize = 4;
    if cell < REACH + SIDE || cell + REACH + SIDE >= row.len() {
        return cell as f32;
    }
    let mean = |from: usize| (prefix[from + SIDE] - prefix[from]) as f32 / SIDE as f32;
    let base = mean(cell - REACH - SIDE).max(mean(cell + REACH + 1));
    let (mut sum, mut moment) = (0.0, 0.0);
    for (i, value) in row[cell - REACH..=cell + REACH].iter().enumerate() {
        let above = (f32::from(*value) - base).max(0.0);
        sum += above;
        moment += above * (i as f32 - REACH as f32);
    }
    if sum > 0.0 { cell as f32 + moment / sum } else { cell as f32 }
}

/// The laser's colour in cells of [`CELL_PX`] px across and [`GROUP`] px along the line.
#[derive(Default)]
struct Field {
    values: Vec<i16>,
    groups: usize,
    cells: usize,
    /// Chroma samples summed in a cell.
    samples: usize,
}

impl Field {
    fn fill(&mut self, image: Yuv<'_>, colour: LaserColour, line: LineDirection) {
        let (u, v) = image.chroma();
        let (shift_x, shift_y) = image.chroma_shifts();
        let (width, height) = (image.width_px(), image.height_px());
        let (chroma_width, chroma_height) = (width >> shift_x, height >> shift_y);
        // Samples per cell along the columns and the rows of the image.
        let (cell_x, cell_y) = match line {
            LineDirection::Vertical => (CELL_PX >> shift_x.min(1), GROUP >> shift_y.min(3)),
            LineDirection::Horizontal => (GROUP >> shift_x.min(3), CELL_PX >> shift_y.min(1)),
        };
        let (columns, rows) = (chroma_width / cell_x, chroma_height / cell_y);
        let (groups, cells, group_step, cell_step) = match line {
            LineDirection::Vertical => (rows, columns, 1, 0),
            LineDirection::Horizontal => (columns, rows, 0, 1),
        };
        let (weight_u, weight_v) = match colour {
            LaserColour::Green => (-1i16, -1i16),
            LaserColour::Red => (0, 1),
            LaserColour::Blue => (1, 0),
        };
        let values = &mut self.values;
        values.resize(groups * cells, 0);
        let mut line_sum = vec![0i16; columns];
        for row in 0..rows {
            line_sum.fill(0);
            for k in 0..cell_y {
                let r = row * cell_y + k;
                let u_row = &u.data[r * u.stride_bytes..][..columns * cell_x];
                let v_row = &v.data[r * v.stride_bytes..][..columns * cell_x];
                let value = |u: &u8, v: &u8| weight_u * (i16::from(*u) - 128) + weight_v * (i16::from(*v) - 128);
                if cell_x == 1 {
                    for ((sum, u), v) in line_sum.iter_mut().zip(u_row).zip(v_row) {
                        *sum += value(u, v);
                    }
                } else {
                    for (sum, (u, v)) in
                        line_sum.iter_mut().zip(u_row.chunks_exact(cell_x).zip(v_row.chunks_exact(cell_x)))
                    {
                        *sum += u.iter().zip(v).map(|(u, v)| value(u, v)).sum::<i16>();
                    }
                }
            }
            if group_step == 1 {
                values[row * cells..][..cells].copy_from_slice(&line_sum);
            } else {
                line_sum.iter().enumerate().for_each(|(group, sum)| values[group * cells + cell_step * row] = *sum);
            }
        }
        (self.groups, self.cells, self.samples) = (groups, cells, cell_x * cell_y);
    }
}

//! The stripe, measured: colour evidence says where the line is, the light's own profile where its centre lies.
//!
//! ```text
//! Yuv ▶ evidence (colour ridges, chroma only) ▶ choice ▶ spots (luma, plain) ▶ Seen
//! Seen + the wall as it looks without the laser ▶ the line's cross-section laid on ▶ smoothing along the line ▶ Stripe with σ
//! ```
//!
//! The centre comes from the luma alone. Encoders halve the chroma and do not agree on where its samples lie: using
//! it moves the centre by a constant 0.08 px and more, which is a constant error in every depth. Luma is full-size and
//! its place is certain. It is turned into light first, the surroundings are taken off, and the centroid under a
//! bell-shaped window finds the centre of a line whose core may be clipped: clipping is as symmetric as the line.
//!
//! What then remains is mostly the wall's own pattern under the line. Dividing by the same strip of wall as
//! another frame saw it, without the laser ([`Wall`]), and laying the line's own cross-section on what is left
//! (`shape`) take most of that away; smoothing along the line, never across an edge, takes some of the rest.

mod evidence;
mod shape;
mod smoothing;
mod spot;

use std::sync::mpsc::{Receiver, Sender, channel};

use crate::recipe::SpotOptions;
use crate::rig::{Laser, LaserColour, LineDirection};
use crate::source::{PlaneView, Yuv};
use crate::stripe::Stripe;
use crate::stripe::choice::{self, Candidate};
use shape::LineShape;
use spot::SpotShape;

/// Line positions that share one search for colour.
const GROUP: usize = evidence::GROUP;
/// Width of the line at half its height that is assumed before the first frame, as a share of the image's width.
const FIRST_WIDTH_SHARE: f32 = 1.0 / 160.0;
/// Narrowest and widest line that is measured, px at half its height.
const WIDTH_RANGE_PX: (f32, f32) = (2.0, 60.0);
/// Share of a frame's own line width in the width that the next frame expects.
const WIDTH_GAIN: f32 = 0.2;
/// A spot may lie this far from where the colour is: at least, px, and as a share of the line's width.
const OFF_COLOUR_PX: f32 = 3.0;
const OFF_COLOUR_WIDTHS: f32 = 0.4;
/// Standard deviation of a place that only the colour tells, px: chroma has half the image's size.
const COLOUR_SIGMA_PX: f32 = 2.0;
/// Error of a spot's centre, widths of the line, where the wall on one side is so many chroma levels poorer in the laser's
/// colour than gray, or richer, and on the other is not: paint that swallows the laser begins there, or a lamp's glow. It
/// grows with the square of the levels, up to the greatest.
const PAINT: f32 = 0.3;
const LAMP: f32 = 0.05;
const TINT_LEVELS: f32 = 40.0;
const TINT_MOST: f32 = 1.5;
/// Error of a spot's centre, widths of the line, where the wall beside it is as bright in the laser's colour as the sensor
/// goes: from the first to the second light.
const CLIPPED: f32 = 0.1;
const CLIPPED_LIGHT: (f32, f32) = (0.85, 0.95);
/// The laser's own colour is the luma and so much of its chroma level (see [`evidence`]): of green, red and blue, about as
/// in all standards.
const OWN_SHARES: [f32; 3] = [0.33, 1.5, 1.8];
/// The wall beside the line begins so far from its middle, widths of the line and px: the chroma smears the line's colour.
const BESIDE_WIDTHS: f32 = 1.2;
const BESIDE_PX: f32 = 2.0;
/// Shortest piece of the line that the colour is believed in, groups; the spots themselves then need more.
const PIECE_MIN_GROUPS: usize = 2;
/// Groups on each side that say where the line goes on.
const LINE_REACH: usize = 10;
/// What the wall's pattern, divided out, leaves of a spot's σ: it was most of the error (measured on simulated concrete).
const DIVIDED_SIGMA: f32 = 0.6;
/// Turns in which the first frame teaches the line's cross-section.
const FIRST_TURNS: usize = 6;
/// A spot laid on the line's cross-section lies no further from its centroid than this, widths of the line.
const LAID_ON_WIDTHS: f32 = 0.5;
/// The line goes on from one row to the next where the row before lies this near to where the colour is, px.
const GOES_ON_PX: f32 = 2.5;
/// Two candidates closer than this are one, px.
const SAME_START_PX: f32 = 3.0;

/// Finds the stripe frame by frame; remembers how wide the line is.
pub struct StripeFinder {
    laser: Laser,
    options: SpotOptions,
    width_px: Option<f32>,
    scratch: evidence::Scratch,
    /// Memory of profiles that were measured, to be used again: a frame's take a third of a megabyte.
    spare: Receiver<Vec<f32>>,
}

/// Measures what a [`StripeFinder`] has seen, in another thread.
pub struct StripeMeasurer {
    options: SpotOptions,
    shape: LineShape,
    pattern: Vec<f32>,
    /// Each line position's light, divided by the pattern, as [`Seen::light`] lies.
    divided: Vec<f32>,
    spare: Sender<Vec<f32>>,
}

/// A finder and a measurer that belong together.
pub fn stripe_stages(laser: &Laser, options: &SpotOptions) -> (StripeFinder, StripeMeasurer) {
    let (give, take) = channel();
    let finder = StripeFinder {
        laser: laser.clone(),
        options: options.clone(),
        width_px: None,
        scratch: evidence::Scratch::default(),
        spare: take,
    };
    let measurer = StripeMeasurer {
        options: options.clone(),
        shape: LineShape::default(),
        pattern: Vec::new(),
        divided: Vec::new(),
        spare: give,
    };
    (finder, measurer)
}

/// The line as one frame shows it, before the wall's own pattern is taken out.
pub struct Seen {
    /// The line, spot by spot, not smoothed; its σ is that of a spot on an even wall.
    pub stripe: Stripe,
    /// How far what lies beside each spot may draw it aside, px: a part of its σ that its neighbours share.
    drawn_px: Vec<f32>,
    /// Light along each line position around its spot, [`Seen::samples`] values each.
    light: Vec<f32>,
    /// First sample of each line position.
    starts: Vec<i32>,
    shape: SpotShape,
}

/// The wall without the laser: another frame and where in it each spot's place on the wall lies.
pub struct Wall<'a> {
    /// The other frame.
    pub image: Yuv<'a>,
    /// For each line position: (across, along) in that frame, px; `None` where the place is unknown, out of the image
    /// or lit by the laser in that frame too.
    pub places: Vec<Option<(f32, f32)>>,
}

impl StripeFinder {
    /// Finds the line in a frame.
    pub fn see(&mut self, image: Yuv<'_>) -> Seen {
        let least = self.options.evidence_min as f32;
        let mut candidates =
            evidence::ridges(image, self.laser.colour, self.laser.line, self.width_px, least, &mut self.scratch);
        // The choice counts in steps from row to row: here a row is a group of them.
        let group = GROUP as f32;
        candidates.iter_mut().flatten().for_each(|c| c.across_px /= group);
        let mut chosen = choice::choose(&candidates, self.options.choice, PIECE_MIN_GROUPS);
        chosen.iter_mut().flatten().for_each(|c| c.across_px *= group);
        let luma = Lines::of(image, self.laser.line);
        let first_width_px = FIRST_WIDTH_SHARE * image.width_px().max(image.height_px()) as f32;
        let mut width_px = self.width_px.unwrap_or(first_width_px);
        let mut seen = self.spots(&luma, image.light(), &chosen, width_px);
        // The first frame tells the width: look again with it.
        for _ in 0..if self.width_px.is_none() { 2 } else { 1 } {
            let Some(found_px) = seen.median_width_px() else { return seen };
            let first = self.width_px.is_none();
            width_px = if first { found_px } else { width_px + WIDTH_GAIN * (found_px - width_px) };
            width_px = width_px.clamp(WIDTH_RANGE_PX.0, WIDTH_RANGE_PX.1);
            if first {
                seen = self.spots(&luma, image.light(), &chosen, width_px);
            }
        }
        self.width_px = Some(width_px);
        seen
    }

    fn spots(&self, luma: &Lines<'_>, light: &[f32; 256], chosen: &[Option<Candidate>], width_px: f32) -> Seen {
        let shape = SpotShape::new(width_px);
        let (positions, samples) = (luma.positions, shape.samples());
        let mut seen = Seen {
            stripe: Stripe::empty(self.laser.line, positions),
            drawn_px: vec![0.0; positions],
            light: self.spare.try_recv().unwrap_or_default(),
            starts: vec![0; positions],
            shape,
        };
        seen.light.resize(positions * samples, 0.0);
        let contrast_min = self.options.contrast_min as f32 / 255.0;
        let line = line_around(chosen);
        for position in 0..positions {
            // Mostly the line goes on from the row before; where it may not, look for the most light.
            let expected_px = chosen.get(position / GROUP).copied().flatten().map(|c| c.across_px);
            let before_px = position.checked_sub(1).map_or(f32::NAN, |before| seen.stripe.across_px[before]);
            let start = match expected_px {
                Some(expected_px) if (before_px - expected_px).abs() < GOES_ON_PX => {
                    Some(Start { expected_px, centre: before_px.round() as i32, coloured: true })
                }
                _ => strongest_start(luma, light, chosen, &line, position, width_px),
            };
            let Some(start) = start else { continue };
            let first = start.centre - seen.shape.half as i32;
            if first < 0 || first as usize + samples > luma.length {
                continue;
            }
            seen.starts[position] = first;
            let profile = &mut seen.light[position * samples..][..samples];
            luma.read(position, first as usize, light, profile);
            let spot = seen.shape.find(profile, seen.shape.half as f32);
            // The brightest place may be a glint beside the line: it is not where the colour is.
            let largest_px = OFF_COLOUR_PX.max(OFF_COLOUR_WIDTHS * width_px);
            let spot = spot.filter(|spot| (first as f32 + spot.at - start.expected_px).abs() <= largest_px);
            let (at, sigma, drawn, height) = match spot {
                // A weak spot is no spot. Light is compared as the eye and the encoder do: relative to where it stands.
                Some(spot) if spot.height >= contrast_min * (0.15 + 2.0 * spot.background) => {
                    (first as f32 + spot.at, spot.sigma, spot.drawn, spot.height)
                }
                Some(_) => continue,
                None if start.coloured => (start.expected_px, COLOUR_SIGMA_PX, 0.0, contrast_min),
                None => continue,
            };
            seen.stripe.across_px[position] = at;
            seen.drawn_px[position] = drawn + self.beside_px(luma, light, position, at, width_px);
            seen.stripe.sigma_px[position] = sigma + seen.drawn_px[position];
            seen.stripe.confidence[position] = height.min(1.0);
        }
        seen
    }

    /// What the wall's colours beside a spot do to its centre, px. Where paint that swallows the laser begins, its luma may
    /// be as the wall's, but the laser's light is not; and a wall as bright in the laser's colour as the sensor goes shows
    /// next to nothing of it.
    fn beside_px(&self, luma: &Lines<'_>, light: &[f32; 256], position: usize, across_px: f32, width_px: f32) -> f32 {
        let away_px = BESIDE_WIDTHS * width_px + BESIDE_PX;
        let Some(sides) = self.scratch.sides(position / GROUP, across_px, away_px) else { return 0.0 };
        let step = |[left, right]: [f32; 2]| ((left - right).abs() / TINT_LEVELS).min(TINT_MOST).powi(2);
        let paint = step(sides.map(|side| side.min(0.0)));
        let lamp = step(sides.map(|side| side.max(0.0)));
        let own_share = OWN_SHARES[match self.laser.colour {
            LaserColour::Green => 0,
            LaserColour::Red => 1,
            LaserColour::Blue => 2,
        }];
        let firsts = [across_px - away_px - evidence::SIDE_PX as f32, across_px + away_px];
        let brightest = sides.iter().zip(firsts).map(|(side, first)| {
            let value = luma.mean(position, first, evidence::SIDE_PX) + own_share * side;
            light[value.clamp(0.0, 255.0) as usize]
        });
        let clipped =
            ((brightest.fold(0.0, f32::max) - CLIPPED_LIGHT.0) / (CLIPPED_LIGHT.1 - CLIPPED_LIGHT.0)).clamp(0.0, 1.0);
        (PAINT * paint + LAMP * lamp + CLIPPED * clipped) * width_px
    }
}

impl StripeMeasurer {
    /// The stripe with all that is known: the wall without the laser where another frame saw it, and smoothed along the
    /// line.
    pub fn measure(&mut self, seen: &Seen, wall: Option<&Wall<'_>>) -> Stripe {
        let mut stripe = seen.stripe.clone();
        if let Some(wall) = wall.filter(|_| self.options.wall_reference) {
            self.divide_by_wall(seen, wall);
            self.lay_on(seen, &mut stripe);
        }
        smoothing::smooth(&mut stripe, &seen.drawn_px, &self.options);
        stripe
    }

    /// Gives the memory of what was measured back to the finder.
    pub fn done_with(&mut self, seen: Seen) {
        // The finder may have ended: then nobody needs it.
        let _ = self.spare.send(seen.light);
    }

    /// Each spot's light divided by the wall's own pattern; NaN where that is not known.
    fn divide_by_wall(&mut self, seen: &Seen, wall: &Wall<'_>) {
        let luma = Lines::of(wall.image, seen.stripe.line);
        let table = wall.image.light();
        let samples = seen.samples();
        let pattern = &mut self.pattern;
        pattern.resize(seen.light.len(), f32::NAN);
        for (position, out) in pattern.chunks_exact_mut(samples).enumerate() {
            let at = seen.stripe.across_px[position];
            let (Some(Some((across, along))), true) = (wall.places.get(position), at.is_finite()) else {
                out[0] = f32::NAN;
                continue;
            };
            luma.read_between(*along, across + seen.starts[position] as f32 - at, table, out);
        }
        let trust = spot::soften(pattern, samples);
        self.divided.resize(seen.light.len(), 0.0);
        let rows = self.divided.chunks_exact_mut(samples).zip(pattern.chunks_exact(samples));
        for (position, (out, pattern)) in rows.enumerate() {
            let known = pattern[0].is_finite();
            if !(known && seen.shape.divide(seen.profile(position), pattern, trust, out)) {
                out[0] = f32::NAN;
            }
        }
    }

    /// Lays the line's own cross-section on each spot whose light was divided, and learns it from them. The flanks of others
    /// show the pattern more than their centroids do.
    fn lay_on(&mut self, seen: &Seen, stripe: &mut Stripe) {
        self.shape.expect(seen.shape.width_px);
        let largest_px = LAID_ON_WIDTHS * seen.shape.width_px;
        // The first frame teaches by its centroids, then by what was learned.
        for _ in 0..if self.shape.is_known() { 1 } else { FIRST_TURNS } {
            for (position, profile) in self.divided.chunks_exact(seen.samples()).enumerate() {
                if !profile[0].is_finite() {
                    continue;
                }
                let first = seen.starts[position] as f32;
                let start = seen.stripe.across_px[position] - first;
                let laid = self.shape.lay_on(profile, start).filter(|spot| (spot.at - start).abs() < largest_px);
                if let Some(spot) = laid {
                    stripe.across_px[position] = first + spot.at;
                    // Light of another form is not the line's alone: beside a highlight it is drawn aside.
                    stripe.sigma_px[position] = DIVIDED_SIGMA * seen.stripe.sigma_px[position] * spot.misfit.max(1.0);
                }
                if self.shape.teaches(position) {
                    let taught = if self.shape.is_known() { laid } else { self.shape.rough(profile, start) };
                    taught.into_iter().for_each(|spot| self.shape.take_in(profile, spot));
                }
            }
            self.shape.learn();
        }
    }
}

impl Seen {
    /// Width of the line at half its height, px, as the spots were looked for.
    pub fn width_px(&self) -> f32 {
        self.shape.width_px
    }

    /// Distance from the line within which another frame's laser must not fall to show the wall, px.
    pub fn reach_px(&self) -> f32 {
        2.0 * self.shape.half as f32
    }

    fn samples(&self) -> usize {
        self.shape.samples()
    }

    fn profile(&self, position: usize) -> &[f32] {
        &self.light[position * self.samples()..][..self.samples()]
    }

    /// Median width of the line at half its height, px; `None` where there is no line.
    fn median_width_px(&self) -> Option<f32> {
        let found = |position: &usize| self.stripe.across_px[*position].is_finite();
        let mut widths: Vec<f32> = (0..self.starts.len())
            .step_by(4)
            .filter(found)
            .filter_map(|position| {
                self.shape
                    .width_px(self.profile(position), self.stripe.across_px[position] - self.starts[position] as f32)
            })
            .collect();
        let middle = widths.len() / 2;
        (!widths.is_empty()).then(|| *widths.select_nth_unstable_by(middle, f32::total_cmp).1)
    }
}

/// Where to look for a spot.
struct Start {
    /// Where the colour, or the line above and below, says it is, px.
    expected_px: f32,
    /// The whole pixel to look around.
    centre: i32,
    /// The colour says so.
    coloured: bool,
}

/// The start with the most light around it, of those that this group, its neighbours and the line above and below give:
/// at an edge of the wall the line jumps inside a group, and under a lamp of its own colour it shows by its light only.
fn strongest_start(
    luma: &Lines<'_>,
    light: &[f32; 256],
    chosen: &[Option<Candidate>],
    line: &[Option<f32>],
    position: usize,
    width_px: f32,
) -> Option<Start> {
    let group = position / GROUP;
    let at = |group: Option<usize>| group.and_then(|g| chosen.get(g)).copied().flatten().map(|c| c.across_px);
    let own = at(Some(group));
    // Neighbours only help where the group itself knows something: a gap's edge is not widened by them.
    let beside = if own.is_some() { [at(group.checked_sub(1)), at(Some(group + 1))] } else { [None; 2] };
    let starts = [own, beside[0], beside[1], line.get(group).copied().flatten()];
    let mut best: Option<(f32, f32)> = None;
    for (i, start) in starts.iter().enumerate() {
        let Some(expected_px) = *start else { continue };
        if starts[..i].iter().flatten().any(|tried| (tried - expected_px).abs() < SAME_START_PX) {
            continue;
        }
        let Some((peak, score)) = luma.brightest(position, expected_px, width_px, light) else { continue };
        if best.is_none_or(|(_, most)| score > most) {
            best = Some((peak, score));
        }
    }
    let (peak, _) = best?;
    // From another start the same peak may be found: what counts is the nearest.
    let away = |start: &Option<f32>| start.map_or(f32::MAX, |px| (px - peak).abs());
    let nearest = (0..starts.len()).min_by(|a, b| away(&starts[*a]).total_cmp(&away(&starts[*b])))?;
    Some(Start { expected_px: starts[nearest]?, centre: peak.round() as i32, coloured: nearest < 3 })
}

/// For each group where the line above and below says it is: between its nearest places where the group has none, else
/// the middle of the places around it. Only where the line is known on both sides.
fn line_around(chosen: &[Option<Candidate>]) -> Vec<Option<f32>> {
    let place = |group: usize| chosen[group].map(|c| c.across_px);
    let mut near = Vec::with_capacity(2 * LINE_REACH + 1);
    (0..chosen.len())
        .map(|group| {
            let (from, to) = (group.saturating_sub(LINE_REACH), (group + LINE_REACH + 1).min(chosen.len()));
            let before = (from..group).rev().find_map(|g| Some((g, place(g)?)))?;
            let after = (group + 1..to).find_map(|g| Some((g, place(g)?)))?;
            if chosen[group].is_none() {
                let share = (group - before.0) as f32 / (after.0 - before.0) as f32;
                return Some(before.1 + share * (after.1 - before.1));
            }
            near.clear();
            near.extend((from..to).step_by(2).filter_map(place));
            let middle = near.len() / 2;
            (near.len() > LINE_REACH / 4).then(|| *near.select_nth_unstable_by(middle, f32::total_cmp).1)
        })
        .collect()
}

/// The luma as lines across the laser line: one per line position.
struct Lines<'a> {
    plane: PlaneView<'a>,
    /// Bytes from one line position to the next.
    along: usize,
    /// Bytes from one sample across the line to the next.
    across: usize,
    positions: usize,
    length: usize,
}

impl<'a> Lines<'a> {
    fn of(image: Yuv<'a>, line: LineDirection) -> Lines<'a> {
        let plane = image.luma();
        let (width, height) = (image.width_px(), image.height_px());
        match line {
            LineDirection::Vertical => {
                Lines { plane, along: plane.stride_bytes, across: 1, positions: height, length: width }
            }
            LineDirection::Horizontal => {
                Lines { plane, along: 1, across: plane.stride_bytes, positions: width, length: height }
            }
        }
    }

    /// Light of `out.len()` samples from `first` on.
    fn read(&self, position: usize, first: usize, light: &[f32; 256], out: &mut [f32]) {
        let from = &self.plane.data[position * self.along + first * self.across..];
        for (out, value) in out.iter_mut().zip(from.iter().step_by(self.across)) {
            *out = light[usize::from(*value)];
        }
    }

    /// Mean value of so many samples from a place on, 0 to 255; 0 where they are not inside the image.
    fn mean(&self, position: usize, first_px: f32, count: usize) -> f32 {
        let first = first_px.max(0.0) as usize;
        if first + count > self.length {
            return 0.0;
        }
        let from = &self.plane.data[position * self.along + first * self.across..];
        from.iter().step_by(self.across).take(count).map(|value| f32::from(*value)).sum::<f32>() / count as f32
    }

    /// The same between pixels; all NaN where it is not inside the image.
    fn read_between(&self, along: f32, first: f32, light: &[f32; 256], out: &mut [f32]) {
        let inside = along >= 0.0 && first >= 0.0;
        let (row, column) = (along as usize, first as usize);
        if !inside || row + 1 >= self.positions || column + out.len() + 1 >= self.length {
            out.fill(f32::NAN);
            return;
        }
        let (share_along, share_across) = (along - row as f32, first - column as f32);
        let at = row * self.along + column * self.across;
        let (near, far) = (&self.plane.data[at..], &self.plane.data[at + self.along..]);
        let value = |i: usize| {
            let (a, b) = (light[usize::from(near[i * self.across])], light[usize::from(far[i * self.across])]);
            a + share_along * (b - a)
        };
        let mut left = value(0);
        for (i, out) in out.iter_mut().enumerate() {
            let right = value(i + 1);
            *out = left + share_across * (right - left);
            left = right;
        }
    }

    /// Where, within a line's width of `at`, most light falls on a line's width; and how much more than around it.
    fn brightest(&self, position: usize, at: f32, width_px: f32, light: &[f32; 256]) -> Option<(f32, f32)> {
        let core = (width_px * 0.5).clamp(1.0, 40.0) as i32;
        let reach = (width_px * 1.2).clamp(4.0, 60.0) as i32;
        let first = at.round() as i32 - reach - core;
        let count = (2 * (reach + core) + 1) as usize;
        if first < 0 || first as usize + count > self.length {
            return None;
        }
        let mut sums = [0.0_f32; 256];
        let from = &self.plane.data[position * self.along + first as usize * self.across..];
        let mut sum = 0.0;
        for (i, value) in from.iter().step_by(self.across).take(count).enumerate() {
            sum += light[usize::from(*value)];
            sums[i + 1] = sum;
        }
        let window = |centre: usize| sums[centre + 2 * core as usize + 1] - sums[centre];
        let best = (0..=2 * reach as usize).max_by(|a, b| window(*a).total_cmp(&window(*b)))?;
        let all = sums[count] / count as f32;
        let score = window(best) / (2 * core + 1) as f32 - all;
        Some(((first + core) as f32 + best as f32, score))
    }
}

#[cfg(test)]
mod tests;

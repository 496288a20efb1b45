//! Smoothing along the line, never across an edge.
//!
//! The wall bends the line slowly, its pattern moves each spot on its own: a smoother that expects a slowly changing
//! slope (Rauch, Tung and Striebel) takes from the neighbours what a spot does not know itself. A spot that knows little,
//! as in a highlight, so leans on many, and one that is sure on few. Where the line jumps, it starts anew.

use crate::recipe::SpotOptions;
use crate::stripe::Stripe;

/// Line positions without a spot that end a piece of the line.
const MAX_GAP: usize = 6;
/// Spots on each side of a suspected edge that are compared.
const EDGE_SPOTS: usize = 5;
/// An edge is at least this high, px, and this many standard deviations.
const EDGE_MIN_PX: f32 = 0.5;
const EDGE_SIGMAS: f32 = 5.0;
/// A spot further from the smooth line than this many of its standard deviations is doubted.
const OUTLIER_SIGMAS: f32 = 3.0;
/// Line positions over which the spots' real scatter is taken.
const SCATTER_REACH: usize = 24;
/// Spots that share one figure of the scatter.
const SCATTER_STEP: usize = 4;
/// The errors of neighbouring spots are alike (the wall's pattern is coarser than a row): averaging helps less than it
/// would with independent errors. Measured on simulated walls and pipes.
const ALIKE: f32 = 3.4;
/// How many times more than on an even wall the line bends where there is a dent.
const SUPPLE: f32 = 15.0;
/// Line positions on each side that tell whether it does, and how much of that is chance.
const TRUE_REACH: usize = 10;
const BY_CHANCE: f32 = 1.0;
/// As [`ALIKE`], for the difference of the two lines: what lies far apart cancels in it.
const ALIKE_APART: f32 = 2.4;
/// Standard deviation of what draws neighbouring spots aside together, as a share of how far it may.
const DRAWN_SHARE: f32 = 0.2;
/// A line that is less sure than this stays stiff.
const UNSURE_PX: f32 = 0.4;
/// A piece shorter than this that stands apart from the line on both sides is believed only where it is sure.
const ISLAND_ROWS: usize = 48;
const ISLAND_SIGMA_PX: f32 = 0.3;

/// Smooths the stripe and says how sure each position is; drops what is less sure than the recipe allows.
///
/// `drawn_px` says how far what lies beside each spot may draw it aside: no neighbours average that away that are as well.
pub(super) fn smooth(stripe: &mut Stripe, drawn_px: &[f32], options: &SpotOptions) {
    let spots: Vec<Spot> = (0..stripe.across_px.len())
        .filter(|i| stripe.across_px[*i].is_finite())
        .map(|i| Spot { position: i, at: stripe.across_px[i], sigma: stripe.sigma_px[i].max(0.01), drawn: drawn_px[i] })
        .collect();
    let bend = options.bend_px as f32;
    for piece in pieces(&spots) {
        let mut piece = piece.to_vec();
        if piece.len() < options.piece_min_rows as usize {
            piece.iter().for_each(|spot| drop_spot(stripe, spot.position));
            continue;
        }
        let first = smoother(&piece, SUPPLE * bend);
        doubt(&mut piece, &first);
        let smooth = as_smooth_as_true(&smoother(&piece, bend), &smoother(&piece, SUPPLE * bend));
        let sigma = |variance: f32| ALIKE * variance.max(0.0).sqrt();
        let middle = sigma(smooth[piece.len() / 2].1);
        if piece.len() < ISLAND_ROWS && middle > ISLAND_SIGMA_PX {
            piece.iter().for_each(|spot| drop_spot(stripe, spot.position));
            continue;
        }
        for ((spot, (at, variance)), drawn) in piece.iter().zip(smooth).zip(shared(&piece)) {
            let sigma = sigma(variance).hypot(DRAWN_SHARE * drawn);
            if sigma > options.sigma_max_px as f32 {
                drop_spot(stripe, spot.position);
            } else {
                stripe.across_px[spot.position] = at;
                stripe.sigma_px[spot.position] = sigma;
                stripe.confidence[spot.position] = confidence(sigma);
            }
        }
    }
}

/// 1 where the position is certain, 0.5 at a fifth of a pixel.
fn confidence(sigma_px: f32) -> f32 {
    1.0 / (1.0 + (sigma_px / 0.2).powi(2))
}

fn drop_spot(stripe: &mut Stripe, position: usize) {
    stripe.across_px[position] = f32::NAN;
    stripe.sigma_px[position] = f32::NAN;
    stripe.confidence[position] = 0.0;
}

#[derive(Clone, Copy)]
struct Spot {
    position: usize,
    at: f32,
    sigma: f32,
    /// How far what lies beside it may draw it aside, px.
    drawn: f32,
}

/// Cuts the line at gaps and edges.
fn pieces(spots: &[Spot]) -> Vec<&[Spot]> {
    let mut cuts = vec![0];
    let scatter = local_scatter(spots);
    let heights: Vec<f32> = (0..spots.len()).map(|i| edge_height(spots, i, scatter[i / SCATTER_STEP])).collect();
    for i in 1..spots.len() {
        let gap = spots[i].position - spots[i - 1].position > MAX_GAP;
        let near = i.saturating_sub(EDGE_SPOTS)..(i + EDGE_SPOTS + 1).min(spots.len());
        let edge = heights[i] > 1.0 && heights[near].iter().all(|h| *h <= heights[i]);
        if gap || edge {
            cuts.push(i);
        }
    }
    cuts.push(spots.len());
    cuts.dedup();
    cuts.windows(2).map(|w| &spots[w[0]..w[1]]).filter(|p| !p.is_empty()).collect()
}

/// How much neighbouring spots really scatter, px, for each [`SCATTER_STEP`] of them: among glints every spot would seem
/// to be an edge.
fn local_scatter(spots: &[Spot]) -> Vec<f32> {
    let bend = |i: usize| (spots[i].at - (spots[i - 1].at + spots[i + 1].at) / 2.0).abs();
    (0..spots.len().div_ceil(SCATTER_STEP))
        .map(|block| {
            let middle = block * SCATTER_STEP + SCATTER_STEP / 2;
            let (from, to) = (middle.saturating_sub(SCATTER_REACH / 2).max(1), middle + SCATTER_REACH / 2);
            let mut bends: Vec<f32> = (from..to.min(spots.len().saturating_sub(1))).map(bend).collect();
            let half = bends.len() / 2;
            // The median of |x₋₁/2 − x + x₊₁/2| is 0.83 σ.
            if bends.is_empty() { 0.0 } else { *bends.select_nth_unstable_by(half, f32::total_cmp).1 / 0.83 }
        })
        .collect()
}

/// How much the line jumps between spot `i - 1` and spot `i`, above 1 where it is an edge; `scatter` is what the spots
/// there scatter by, px.
fn edge_height(spots: &[Spot], i: usize, scatter: f32) -> f32 {
    if i < EDGE_SPOTS || i + EDGE_SPOTS > spots.len() {
        return 0.0;
    }
    let middle = |part: &[Spot]| {
        let mut values: [f32; EDGE_SPOTS] = std::array::from_fn(|k| part[k].at);
        *values.select_nth_unstable_by(EDGE_SPOTS / 2, f32::total_cmp).1
    };
    let (before, after) = (&spots[i - EDGE_SPOTS..i], &spots[i..i + EDGE_SPOTS]);
    let jump = middle(after) - middle(before);
    // What the line's slope on the two sides explains.
    let slope = |part: &[Spot]| (part[EDGE_SPOTS - 1].at - part[0].at) / (EDGE_SPOTS - 1) as f32;
    let explained = EDGE_SPOTS as f32 * (slope(before) + slope(after)) / 2.0;
    let sigma = spots[i - EDGE_SPOTS..i + EDGE_SPOTS].iter().map(|s| s.sigma).sum::<f32>() / (2 * EDGE_SPOTS) as f32;
    let least = EDGE_MIN_PX.max(EDGE_SIGMAS * sigma.max(scatter));
    jump.abs().min((jump - explained).abs()) / least
}

/// Sets each spot's σ to what its surroundings really scatter by, and doubts those that stand alone.
fn doubt(piece: &mut [Spot], smooth: &[(f32, f32)]) {
    let scaled: Vec<f32> = piece.iter().zip(smooth).map(|(s, (at, _))| (s.at - at).abs() / s.sigma).collect();
    let mut sums = vec![0.0; scaled.len() + 1];
    for (i, value) in scaled.iter().enumerate() {
        // One wild spot does not widen all its neighbours.
        sums[i + 1] = sums[i] + value.min(2.0 * OUTLIER_SIGMAS);
    }
    for (i, spot) in piece.iter_mut().enumerate() {
        let (from, to) = (i.saturating_sub(SCATTER_REACH), (i + SCATTER_REACH + 1).min(scaled.len()));
        // Mean |r| of a normal deviation is 0.8 σ; the smooth line follows the spots a little, hence 0.7.
        let scatter = ((sums[to] - sums[from]) / (to - from) as f32 / 0.7).clamp(0.4, 20.0);
        let outlier = (scaled[i] / (OUTLIER_SIGMAS * scatter)).max(1.0);
        spot.sigma *= scatter * outlier * outlier;
    }
}

/// How far each spot and those about it may be drawn aside together, px: one that is sure says where the line is for those
/// that are not.
fn shared(piece: &[Spot]) -> Vec<f32> {
    let mut sums = vec![(0.0, 0.0); piece.len() + 1];
    for (i, spot) in piece.iter().enumerate() {
        let weight = 1.0 / f64::from(spot.sigma * spot.sigma);
        sums[i + 1] = (sums[i].0 + weight, sums[i].1 + weight * f64::from(spot.drawn));
    }
    (0..piece.len())
        .map(|i| {
            let (from, to) = (i.saturating_sub(TRUE_REACH), (i + TRUE_REACH + 1).min(piece.len()));
            ((sums[to].1 - sums[from].1) / (sums[to].0 - sums[from].0)) as f32
        })
        .collect()
}

/// The stiff line, and the supple one where it differs by more than chance: a dent of some dozen rows would lose half of
/// its depth on the stiff one.
fn as_smooth_as_true(stiff: &[(f32, f32)], supple: &[(f32, f32)]) -> Vec<(f32, f32)> {
    // The stiff line's error is part of the supple one's: their difference has the difference of the variances.
    let chance =
        |(a, b): (&(f32, f32), &(f32, f32))| (b.0 - a.0).powi(2) / (ALIKE_APART * ALIKE_APART * (b.1 - a.1).max(1e-8));
    let mut sums = vec![0.0; stiff.len() + 1];
    for (i, pair) in stiff.iter().zip(supple).enumerate() {
        sums[i + 1] = sums[i] + chance(pair).min(100.0);
    }
    (0..stiff.len())
        .map(|i| {
            let (from, to) = (i.saturating_sub(TRUE_REACH), (i + TRUE_REACH + 1).min(stiff.len()));
            let mean = (sums[to] - sums[from]) / (to - from) as f32;
            // A highlight's line would bend anyhow: there a spot knows little.
            let sure = 1.0 / (1.0 + (ALIKE * ALIKE * supple[i].1 / (UNSURE_PX * UNSURE_PX)).powi(2));
            // Where it is hardly chance, nearly all of it is the wall's: what is held back is missing from every dent's depth.
            let share = sure * (1.0 - (BY_CHANCE / mean.max(1e-6)).powi(2)).max(0.0);
            let between = |a: f32, b: f32| a + share * (b - a);
            (between(stiff[i].0, supple[i].0), between(stiff[i].1, supple[i].1))
        })
        .collect()
}

/// Position and slope forwards (Kalman), then backwards: position and its variance for each spot.
fn smoother(piece: &[Spot], bend: f32) -> Vec<(f32, f32)> {
    let q = f64::from(bend * bend);
    let mut filtered: Vec<State> = Vec::with_capacity(piece.len());
    let mut predicted: Vec<State> = Vec::with_capacity(piece.len());
    for (i, spot) in piece.iter().enumerate() {
        let (at, variance) = (f64::from(spot.at), f64::from(spot.sigma * spot.sigma));
        if i == 0 {
            // Nothing is known of the slope: it may be one pixel a row either way.
            let start = State { x: at, v: 0.0, xx: variance, xv: 0.0, vv: 1.0 };
            predicted.push(start);
            filtered.push(start);
            continue;
        }
        let before = filtered[i - 1].ahead((spot.position - piece[i - 1].position) as f64, q);
        predicted.push(before);
        filtered.push(before.updated(at, variance));
    }
    let mut out = vec![(0.0, 0.0); piece.len()];
    let Some(mut after) = filtered.last().copied() else { return out };
    out[piece.len() - 1] = (after.x as f32, after.xx as f32);
    for i in (0..piece.len() - 1).rev() {
        let dt = (piece[i + 1].position - piece[i].position) as f64;
        after = filtered[i].smoothed(&predicted[i + 1], &after, dt);
        out[i] = (after.x as f32, after.xx as f32);
    }
    out
}

/// Position and slope with their covariance.
#[derive(Clone, Copy)]
struct State {
    x: f64,
    v: f64,
    xx: f64,
    xv: f64,
    vv: f64,
}

impl State {
    fn ahead(&self, dt: f64, q: f64) -> State {
        State {
            x: self.x + dt * self.v,
            v: self.v,
            xx: self.xx + dt * (2.0 * self.xv + dt * self.vv) + q * dt * dt * dt / 3.0,
            xv: self.xv + dt * self.vv + q * dt * dt / 2.0,
            vv: self.vv + q * dt,
        }
    }

    fn updated(&self, at: f64, variance: f64) -> State {
        let total = self.xx + variance;
        let (gain_x, gain_v) = (self.xx / total, self.xv / total);
        let miss = at - self.x;
        State {
            x: self.x + gain_x * miss,
            v: self.v + gain_v * miss,
            xx: (1.0 - gain_x) * self.xx,
            xv: (1.0 - gain_x) * self.xv,
            vv: self.vv - gain_v * self.xv,
        }
    }

    fn smoothed(&self, predicted: &State, after: &State, dt: f64) -> State {
        // Gain C = P·Fᵀ·predicted⁻¹.
        let det = (predicted.xx * predicted.vv - predicted.xv * predicted.xv).max(1e-20);
        let (p00, p01) = (self.xx + dt * self.xv, self.xv);
        let (p10, p11) = (self.xv + dt * self.vv, self.vv);
        let (i00, i01, i11) = (predicted.vv / det, -predicted.xv / det, predicted.xx / det);
        let (c00, c01) = (p00 * i00 + p01 * i01, p00 * i01 + p01 * i11);
        let (c10, c11) = (p10 * i00 + p11 * i01, p10 * i01 + p11 * i11);
        let (dx, dv) = (after.x - predicted.x, after.v - predicted.v);
        let (dxx, dxv, dvv) = (after.xx - predicted.xx, after.xv - predicted.xv, after.vv - predicted.vv);
        State {
            x: self.x + c00 * dx + c01 * dv,
            v: self.v + c10 * dx + c11 * dv,
            xx: self.xx + c00 * c00 * dxx + 2.0 * c00 * c01 * dxv + c01 * c01 * dvv,
            xv: self.xv + c00 * c10 * dxx + (c00 * c11 + c01 * c10) * dxv + c01 * c11 * dvv,
            vv: self.vv + c10 * c10 * dxx + 2.0 * c10 * c11 * dxv + c11 * c11 * dvv,
        }
    }
}

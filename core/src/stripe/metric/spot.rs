//! One spot: the centre of the line's light at one line position.

/// Width of the centroid's window, as a share of the line's width at half height.
const WINDOW_SHARE: f32 = 0.38;
/// Samples on each side that show the surroundings.
const SIDE: usize = 4;
/// Rounds of the centroid, at most; it has settled when it moves less than this, px.
const ROUNDS: usize = 8;
const SETTLED_PX: f32 = 0.02;
/// The window ends this many of its standard deviations from its middle.
const WINDOW_REACH: f32 = 2.83;
/// Light in the window of a line of height 1 and width 1: √(2π) times the standard deviation of both bells together.
const LIGHT_OF_HEIGHT: f32 = 0.71;
/// Sums are kept apart for so many samples side by side, for the processor to take them at once.
const LANES: usize = 8;
/// Error of a pixel's light as a share of the line's light there: the wall's pattern and speckle.
const PATTERN_SHARE: f32 = 0.08;
/// Error of a pixel's light that is always there: noise and the encoder.
const NOISE_LIGHT: f32 = 0.004;
/// Error of the centre in widths of the line where the two sides differ by as much light as the line has.
const GLARE: f32 = 0.12;
/// Error of the centre in widths of the line where the light a width away is as bright as the line, and by how much of its
/// height the line's top stands above that light on a plain wall.
const SHOULDER: f32 = 0.085;
const PLAIN_SHOULDER: f32 = 0.85;
/// Rows between those that tell how much of the pattern is noise.
const PROBE_STEP: usize = 8;
/// Noise that the softening leaves, as a share of what it takes away: 0.10 of white noise's power against 0.73.
const NOISE_LEFT: f32 = 0.141;
/// The pattern is not trusted below this light: division would lift noise.
const PATTERN_MIN_LIGHT: f32 = 0.004;

/// A centre within a profile.
pub(super) struct Spot {
    /// Samples from the profile's first.
    pub at: f32,
    /// Standard deviation, px; without what draws it aside.
    pub sigma: f32,
    /// How far light beside it may draw it aside, px.
    pub drawn: f32,
    /// The line's light above the background at its highest.
    pub height: f32,
    /// The background's light.
    pub background: f32,
}

/// How wide the line is and so how much of the profile is looked at.
pub(super) struct SpotShape {
    /// Width at half height, px.
    pub width_px: f32,
    /// Samples on each side of the middle one.
    pub half: usize,
}

impl SpotShape {
    pub(super) fn new(width_px: f32) -> SpotShape {
        SpotShape { width_px, half: (1.6 * width_px).ceil() as usize + SIDE + 2 }
    }

    pub(super) fn samples(&self) -> usize {
        2 * self.half + 1
    }

    /// The centroid under a bell-shaped window that moves with it. `None` where there is no light or it runs away.
    pub(super) fn find(&self, profile: &[f32], start: f32) -> Option<Spot> {
        let (level, slope, left, right) = ground(profile);
        let (mut at, mut light) = (start, 0.0);
        for _ in 0..ROUNDS {
            let moment;
            (light, moment) = self.sums(profile, at, level, slope)?;
            if light <= 1e-5 {
                return None;
            }
            // Under a window as wide as the line the centroid goes half the way.
            let step = (2.0 * moment / light).clamp(-0.5 * self.width_px, 0.5 * self.width_px);
            at += step;
            if step.abs() < SETTLED_PX {
                break;
            }
        }
        let height = light / (LIGHT_OF_HEIGHT * self.width_px);
        let middle = (profile.len() / 2) as f32;
        ((at - middle).abs() < self.half as f32 - SIDE as f32).then(|| Spot {
            at,
            sigma: self.sigma_px(light) + self.glare_px(left, right, height),
            drawn: self.shoulder_px(profile, at, height),
            height,
            background: (left + right) / 2.0,
        })
    }

    /// Standard deviation of the centroid, px, for bell-shaped line and window: what the wall's pattern does, and what
    /// noise does to the window's light.
    fn sigma_px(&self, light: f32) -> f32 {
        let window = WINDOW_SHARE * self.width_px;
        let both = 0.283 * self.width_px;
        let pattern = 2.0 * PATTERN_SHARE * (0.141 * both).sqrt();
        let noise = 2.0 * NOISE_LIGHT * (0.886 * window * window * window).sqrt() / light;
        (pattern * pattern + noise * noise).sqrt()
    }

    /// Light above a slope in the window around a place, and its moment about that place.
    #[inline]
    fn sums(&self, profile: &[f32], at: f32, level: f32, slope: f32) -> Option<(f32, f32)> {
        let reach = WINDOW_REACH * WINDOW_SHARE * self.width_px;
        if !(at > -reach && at < profile.len() as f32 + reach) {
            return None;
        }
        // Whole lanes: beyond the window's end the weight is nothing.
        let lanes = ((2.0 * reach) as usize + 1) / LANES + 1;
        let from = ((at - reach).max(0.0) as usize).min(profile.len().checked_sub(lanes * LANES)?);
        let window = &profile[from..from + lanes * LANES];
        Some(window_sums(window, from as f32 - at, reach, level + slope * at, slope))
    }

    /// What a glint on one side does to the centre, px: the background is not the straight slope that it is taken for.
    fn glare_px(&self, left: f32, right: f32, height: f32) -> f32 {
        let lopsided = (left - right).abs() / height.max(1e-3);
        GLARE * self.width_px * lopsided * lopsided
    }

    /// What a highlight beside the line does to the centre, px. At its edge the two are one bright patch, in the middle of
    /// which the centroid lies: light a line's width away that is as bright as the line gives it away.
    fn shoulder_px(&self, profile: &[f32], at: f32, height: f32) -> f32 {
        let shoulder = light_at(profile, at - self.width_px).max(light_at(profile, at + self.width_px));
        let stands = (light_at(profile, at) - shoulder) / height.max(1e-3);
        SHOULDER * self.width_px * (1.0 - stands / PLAIN_SHOULDER).clamp(0.0, 1.0)
    }

    /// Width at half height around a centre, px.
    pub(super) fn width_px(&self, profile: &[f32], at: f32) -> Option<f32> {
        let (left, right) = (side(&profile[..SIDE]), side(&profile[profile.len() - SIDE..]));
        let background = (left + right) / 2.0;
        let top = light_at(profile, at);
        let half = (top + background) / 2.0;
        let crossing = |mut i: usize, step: isize| -> Option<f32> {
            loop {
                let next = usize::try_from(i as isize + step).ok().filter(|n| *n < profile.len())?;
                if profile[next] < half {
                    let share = (profile[i] - half) / (profile[i] - profile[next]).max(1e-6);
                    return Some(i as f32 + step as f32 * share.clamp(0.0, 1.0));
                }
                i = next;
            }
        };
        let middle = middle_sample(profile, at);
        (top > background).then(|| Some(crossing(middle, 1)? - crossing(middle, -1)?)).flatten()
    }

    /// The light above its sides of a profile divided by the wall's pattern, of which `trust` (0 to 1) is believed: the wall's
    /// own light goes with its pattern as the laser's does. False where the pattern is too dark to tell.
    pub(super) fn divide(&self, profile: &[f32], pattern: &[f32], trust: f32, out: &mut [f32]) -> bool {
        let mean = pattern.iter().sum::<f32>() / pattern.len() as f32;
        if mean < PATTERN_MIN_LIGHT {
            return false;
        }
        for ((out, value), pattern) in out.iter_mut().zip(profile).zip(pattern) {
            *out = value * mean / (mean + trust * (pattern - mean)).max(0.2 * mean);
        }
        lift(out);
        true
    }
}

/// Takes a straight slope between its two sides off a profile.
fn lift(profile: &mut [f32]) {
    let (level, slope, _, _) = ground(profile);
    profile.iter_mut().enumerate().for_each(|(i, value)| *value -= level + slope * i as f32);
}

/// The straight slope between the two sides of a profile: light at its first sample, and more a sample; then the light of
/// both sides.
fn ground(profile: &[f32]) -> (f32, f32, f32, f32) {
    let (left, right) = (side(&profile[..SIDE]), side(&profile[profile.len() - SIDE..]));
    // The sides' middles are `SIDE` samples less apart than the profile is long.
    let slope = (right - left) / (profile.len() - SIDE) as f32;
    (left - slope * (SIDE as f32 - 1.0) / 2.0, slope, left, right)
}

/// Sums over whole lanes of samples, the first `first_d` samples from the place: light above `level_at` (at the place)
/// and a slope, and its moment.
fn window_sums(window: &[f32], first_d: f32, reach: f32, level_at: f32, slope: f32) -> (f32, f32) {
    /// The same with the wider registers of processors since 2013: a third of the stripe's time is spent here.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn wide(window: &[f32], first_d: f32, reach: f32, level_at: f32, slope: f32) -> (f32, f32) {
        lane_sums(window, first_d, reach, level_at, slope)
    }
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has what the function is compiled for; it does nothing else that is unsafe.
        #[allow(unsafe_code)]
        return unsafe { wide(window, first_d, reach, level_at, slope) };
    }
    lane_sums(window, first_d, reach, level_at, slope)
}

#[inline(always)]
fn lane_sums(window: &[f32], first_d: f32, reach: f32, level_at: f32, slope: f32) -> (f32, f32) {
    let scale = 1.0 / (reach * reach);
    let (mut light, mut moment) = ([0.0f32; LANES], [0.0f32; LANES]);
    let mut d: [f32; LANES] = std::array::from_fn(|lane| first_d + lane as f32);
    for chunk in window.chunks_exact(LANES) {
        for lane in 0..LANES {
            // (1 − (d/reach)²)⁴ is nearly the bell exp(−4·(d/reach)²), and needs no exponential.
            let u = 1.0 - d[lane] * d[lane] * scale;
            let u = if u > 0.0 { u } else { 0.0 };
            let weight = u * u * (u * u);
            let weighted = weight * (chunk[lane] - level_at - slope * d[lane]);
            light[lane] += weighted;
            moment[lane] += weighted * d[lane];
            d[lane] += LANES as f32;
        }
    }
    (light.iter().sum(), moment.iter().sum())
}

/// The sample at a place that has one on each side.
fn middle_sample(profile: &[f32], at: f32) -> usize {
    (at.round().max(1.0) as usize).min(profile.len() - 2)
}

/// Light at a place: the mean of three samples.
fn light_at(profile: &[f32], at: f32) -> f32 {
    let middle = middle_sample(profile, at);
    profile[middle - 1..=middle + 1].iter().sum::<f32>() / 3.0
}

/// Light of a side: the mean without the least and the greatest, which may be specks.
fn side(samples: &[f32]) -> f32 {
    let (low, high) = samples.iter().fold((f32::MAX, f32::MIN), |(l, h), v| (l.min(*v), h.max(*v)));
    (samples.iter().sum::<f32>() - low - high) / (samples.len() - 2) as f32
}

/// Softens the wall's pattern, `samples` a line position, over its neighbours in both directions ([1 2 1] twice): what
/// an encoder leaves of the finest pattern is noise. Rows of NaN stay so and count for nothing.
///
/// Returns the share of what is left that is the wall's and not noise, 0 to 1: in the dark a pattern is mostly noise, and
/// dividing by it would do harm (Wiener's weight; the noise is judged by what the softening took away).
pub(super) fn soften(pattern: &mut [f32], samples: usize) -> f32 {
    let probes: Vec<(usize, Vec<f32>)> = pattern
        .chunks_exact(samples)
        .enumerate()
        .step_by(PROBE_STEP)
        .filter(|(_, row)| row[0].is_finite())
        .map(|(row, values)| (row, values.to_vec()))
        .collect();
    for row in pattern.chunks_exact_mut(samples).filter(|row| row[0].is_finite()) {
        for _ in 0..2 {
            let mut before = row[0];
            for i in 1..samples - 1 {
                let here = row[i];
                row[i] = 0.25 * before + 0.5 * here + 0.25 * row[i + 1];
                before = here;
            }
        }
    }
    let rows = pattern.len() / samples;
    let (mut before, mut kept) = (vec![f32::NAN; samples], vec![f32::NAN; samples]);
    for row in 0..rows {
        let (done, rest) = pattern.split_at_mut(row * samples + samples);
        let here = &mut done[row * samples..];
        kept.copy_from_slice(here);
        let after = rest.get(..samples);
        if here[0].is_finite()
            && before[0].is_finite()
            && let Some(after) = after.filter(|a| a[0].is_finite())
        {
            for ((here, before), after) in here.iter_mut().zip(&before).zip(after) {
                *here = 0.25 * before + 0.5 * *here + 0.25 * after;
            }
        }
        std::mem::swap(&mut before, &mut kept);
    }
    let (mut taken, mut left) = (0.0, 0.0);
    for (row, raw) in probes {
        let soft = &pattern[row * samples..][..samples];
        let mean = soft.iter().sum::<f32>() / samples as f32;
        taken += raw.iter().zip(soft).map(|(raw, soft)| (raw - soft) * (raw - soft)).sum::<f32>();
        left += soft.iter().map(|soft| (soft - mean) * (soft - mean)).sum::<f32>();
    }
    if left > 0.0 { (1.0 - NOISE_LEFT * taken / left).clamp(0.0, 1.0) } else { 0.0 }
}

//! One spot: the centre of the line's light at one line position.

/// Width of the centroid's window, as a share of the line's width at half height.
const WINDOW_SHARE: f32 = 0.38;
/// Samples on each side that show the surroundings.
const SIDE: usize = 4;
/// Rounds of the centroid, at most; it settles in four.
const ROUNDS: usize = 8;
/// It has settled when it moves less than this, px.
const SETTLED_PX: f32 = 0.003;
/// Error of a pixel's light as a share of the line's light there: the wall's pattern and speckle.
const PATTERN_SHARE: f32 = 0.08;
/// Error of a pixel's light that is always there: noise and the encoder.
const NOISE_LIGHT: f32 = 0.004;
/// Error of the centre in widths of the line where the two sides differ by as much light as the line has.
const GLARE: f32 = 0.12;
/// The pattern is not trusted below this light: division would lift noise.
const PATTERN_MIN_LIGHT: f32 = 0.004;

/// What lies under the line's light.
pub(super) enum Background {
    /// A straight slope between the two sides of the profile.
    Sides,
    /// Nothing: it was taken off already.
    None,
}

/// A centre within a profile.
pub(super) struct Spot {
    /// Samples from the profile's first.
    pub at: f32,
    /// Standard deviation, px.
    pub sigma: f32,
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

    /// The centroid under a Gaussian window that moves with it. `None` where there is no light or it runs away.
    pub(super) fn find(&self, profile: &[f32], background: Background, start: f32) -> Option<Spot> {
        let (left, right) = match background {
            Background::Sides => (side(&profile[..SIDE]), side(&profile[profile.len() - SIDE..])),
            Background::None => (0.0, 0.0),
        };
        // The sides' middles are `SIDE - 1` samples further apart than the profile is long without them.
        let span = (profile.len() - SIDE) as f32;
        let offset = (SIDE as f32 - 1.0) / 2.0;
        let slope = (right - left) / span;
        let lit = |i: usize, value: f32| value - (left + slope * (i as f32 - offset));
        let s = WINDOW_SHARE * self.width_px;
        let reach = 3.0 * s;
        let mut at = start;
        for _ in 0..ROUNDS {
            let (first, last) = self.window(at, reach)?;
            let mut weights = Window::new(first as f32 - at, s);
            let (mut sum, mut moment) = (0.0, 0.0);
            for (i, value) in profile[first..=last].iter().enumerate() {
                let q = weights.next() * lit(first + i, *value);
                sum += q;
                moment += q * (first as f32 + i as f32 - at);
            }
            if sum <= 1e-5 {
                return None;
            }
            let step = (2.0 * moment / sum).clamp(-0.5 * self.width_px, 0.5 * self.width_px);
            at += step;
            if step.abs() < SETTLED_PX {
                break;
            }
        }
        let (first, last) = self.window(at, reach)?;
        let mut weights = Window::new(first as f32 - at, s);
        let (mut sum, mut variance, mut height) = (0.0, 0.0, 0.0_f32);
        for (i, value) in profile[first..=last].iter().enumerate() {
            let (weight, q) = (weights.next(), lit(first + i, *value));
            let off = first as f32 + i as f32 - at;
            let error = NOISE_LIGHT * NOISE_LIGHT + PATTERN_SHARE * PATTERN_SHARE * q * q;
            sum += weight * q;
            variance += (weight * off) * (weight * off) * error;
            height = height.max(q);
        }
        let middle = (profile.len() / 2) as f32;
        (sum > 1e-5 && (at - middle).abs() < self.half as f32 - SIDE as f32).then(|| Spot {
            at,
            sigma: 2.0 * variance.sqrt() / sum + self.glare_px(left, right, height),
            height,
            background: (left + right) / 2.0,
        })
    }

    /// What a glint on one side does to the centre, px: the background is not the straight slope that it is taken for.
    fn glare_px(&self, left: f32, right: f32, height: f32) -> f32 {
        let lopsided = (left - right).abs() / height.max(1e-3);
        GLARE * self.width_px * lopsided * lopsided
    }

    fn window(&self, at: f32, reach: f32) -> Option<(usize, usize)> {
        let last = self.samples() - 1;
        let first = (at - reach).ceil().max(0.0);
        let end = (at + reach).floor().min(last as f32);
        (at.is_finite() && first < end).then_some((first as usize, end as usize))
    }

    /// Width at half height around a centre, px.
    pub(super) fn width_px(&self, profile: &[f32], at: f32) -> Option<f32> {
        let (left, right) = (side(&profile[..SIDE]), side(&profile[profile.len() - SIDE..]));
        let background = (left + right) / 2.0;
        let middle = (at.round().max(1.0) as usize).min(profile.len() - 2);
        let top = profile[middle - 1..=middle + 1].iter().sum::<f32>() / 3.0;
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
        (top > background).then(|| Some(crossing(middle, 1)? - crossing(middle, -1)?)).flatten()
    }

    /// The profile's light above its sides, divided by the wall's pattern (1 on average). False where the pattern is
    /// too dark to tell.
    pub(super) fn divide(&self, profile: &[f32], pattern: &[f32], out: &mut [f32]) -> bool {
        let mean = pattern.iter().sum::<f32>() / pattern.len() as f32;
        if mean < PATTERN_MIN_LIGHT {
            return false;
        }
        let (left, right) = (side(&profile[..SIDE]), side(&profile[profile.len() - SIDE..]));
        let slope = (right - left) / (profile.len() - SIDE) as f32;
        let offset = (SIDE as f32 - 1.0) / 2.0;
        for (i, ((out, value), pattern)) in out.iter_mut().zip(profile).zip(pattern).enumerate() {
            *out = (value - left - slope * (i as f32 - offset)) * mean / pattern.max(0.2 * mean);
        }
        true
    }
}

/// Light of a side: the mean without the least and the greatest, which may be specks.
fn side(samples: &[f32]) -> f32 {
    let (low, high) = samples.iter().fold((f32::MAX, f32::MIN), |(l, h), v| (l.min(*v), h.max(*v)));
    (samples.iter().sum::<f32>() - low - high) / (samples.len() - 2) as f32
}

/// exp(−d²/2s²) for d, d + 1, …: two multiplications a value.
struct Window {
    value: f32,
    ratio: f32,
    ratio_step: f32,
}

impl Window {
    fn new(d: f32, s: f32) -> Window {
        let k = 1.0 / (2.0 * s * s);
        Window { value: (-d * d * k).exp(), ratio: (-(2.0 * d + 1.0) * k).exp(), ratio_step: (-2.0 * k).exp() }
    }

    #[inline]
    fn next(&mut self) -> f32 {
        let value = self.value;
        self.value *= self.ratio;
        self.ratio *= self.ratio_step;
        value
    }
}

/// Softens the wall's pattern, `samples` a line position, over its neighbours in both directions ([1 2 1] twice): what
/// an encoder leaves of the finest pattern is noise. Rows of NaN stay so and count for nothing.
pub(super) fn soften(pattern: &mut [f32], samples: usize) {
    for row in pattern.chunks_exact_mut(samples) {
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
    let mut before = vec![f32::NAN; samples];
    for row in 0..rows {
        let (done, rest) = pattern.split_at_mut(row * samples + samples);
        let here = &mut done[row * samples..];
        let kept: Vec<f32> = here.to_vec();
        let after = rest.get(..samples);
        if here[0].is_finite()
            && before[0].is_finite()
            && let Some(after) = after.filter(|a| a[0].is_finite())
        {
            for i in 0..samples {
                here[i] = 0.25 * before[i] + 0.5 * here[i] + 0.25 * after[i];
            }
        }
        before = kept;
    }
}

//! The line's own cross-section, learned from the line itself, and how a spot is laid on it.
//!
//! A centroid errs by what moves the light within the line: the wall's pattern where the sensor clips it, the pixels' grid
//! where the line is a few pixels wide. So a cross-section of one form for the whole line, a bell that saturates, is laid
//! through each spot by weighted least squares with its place and its height. The flanks tell the place; the core, where
//! clipped light tells nothing but the pattern upside down, has next to no weight. How wide the bell is and how far it
//! saturates is learned from all spots. (A free form, as astronomers learn a star's image, would also learn the error that
//! the pixels' grid makes in the places it is learned at.) On simulated concrete the spots scatter by 30 to 40 % less than
//! their centroids.

/// Parts of a pixel in which light is gathered.
const FINE: usize = 8;
/// Parts of a pixel at which the cross-section is laid on; between them its slope tells the place.
const PHASES: usize = 16;
/// It reaches this many widths of the line (at half height) from the middle, and this many pixels more.
const REACH_WIDTHS: f32 = 1.2;
const REACH_PX: f32 = 1.5;
/// Share of what was gathered before that is kept from frame to frame.
const MEMORY: f32 = 0.9;
/// One line position of so many teaches.
const TEACH_STEP: usize = 2;
/// The core that gives a spot's height before the cross-section is known, half of it in widths of the line.
const CORE_WIDTHS: f32 = 0.2;
/// The bell before it is known: standard deviation in widths of the line, and saturation; and their limits.
const FIRST: Bell = Bell { sigma: 0.25, saturation: 5.0 };
const SIGMA_LIMITS: (f32, f32) = (0.15, 0.6);
const SATURATION_LIMITS: (f32, f32) = (0.2, 50.0);
/// Gauss and Newton's steps to the bell, from the frame before's.
const STEPS: usize = 6;
/// What holds the bell where the light does not tell width and saturation apart, as a share of the light gathered.
const HOLD: f32 = 1e-4;
/// A sample's error as shares of the height: always; of its own light, for the wall's pattern; and in the core, from the
/// one to the other share of the height.
const ERROR: f32 = 0.02;
const PATTERN_ERROR: f32 = 0.10;
const CORE_ERROR: f32 = 0.5;
const CORE_FROM: (f32, f32) = (0.7, 0.9);
/// Turns in which a spot is laid on; the last one moves it by a hundredth of a pixel.
const TURNS: usize = 2;

/// A bell that saturates: √(1 + A²)·e / √(1 + A²·e²) with e = exp(−x² / 2σ²); 1 in the middle. A is the saturation: 0 gives
/// the bell itself.
#[derive(Clone, Copy, Debug)]
struct Bell {
    sigma: f32,
    saturation: f32,
}

impl Bell {
    /// Height at a distance from the middle; its changes with ln A, with ln σ and with the distance.
    fn at(&self, x: f32) -> (f32, f32, f32, f32) {
        let (square, steep) = (x * x / (self.sigma * self.sigma), self.saturation * self.saturation);
        let e = (-0.5 * square).exp();
        let clipped = 1.0 + steep * e * e;
        let height = (1.0 + steep).sqrt() * e / clipped.sqrt();
        let by_saturation = height * (1.0 / clipped - 1.0 / (1.0 + steep));
        let by_sigma = height * square / clipped;
        let slope = -height * x / (self.sigma * self.sigma * clipped);
        (height, by_saturation, by_sigma, slope)
    }
}

/// The line's cross-section.
#[derive(Default)]
pub(super) struct LineShape {
    width_px: f32,
    /// Samples on each side of the middle one.
    reach: usize,
    /// Light and the spots' heights in each part of a pixel from the middle outwards, both sides together.
    light: Vec<f32>,
    height: Vec<f32>,
    bell: Option<Bell>,
    /// For each phase what a spot is laid on with; empty until something was learned.
    bank: Vec<Phase>,
}

/// The cross-section at whole pixels, its middle a part of a pixel from one.
struct Phase {
    /// Weighted height and slope of each sample, and their squares' and products' sums.
    height: Vec<f32>,
    slope: Vec<f32>,
    weight: Vec<f32>,
    squares: [f32; 3],
}

/// A spot as it was laid on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Laid {
    /// Its middle, samples from the profile's first.
    pub at: f32,
    /// Its height as its flanks tell it.
    pub height: f32,
    /// How far its light is from the cross-section, in what it errs by usually.
    pub misfit: f32,
}

impl LineShape {
    /// Begins anew where the line's width is another than what was learned by much.
    pub(super) fn expect(&mut self, width_px: f32) {
        let reach = (REACH_WIDTHS * width_px + REACH_PX).ceil() as usize;
        if reach.abs_diff(self.reach) > 1 {
            *self = LineShape { reach, ..LineShape::default() };
            self.light = vec![0.0; FINE * (reach + 1) + 1];
            self.height = self.light.clone();
        }
        self.width_px = width_px;
    }

    /// Whether something was learned.
    pub(super) fn is_known(&self) -> bool {
        !self.bank.is_empty()
    }

    /// The line positions that teach.
    pub(super) fn teaches(&self, position: usize) -> bool {
        position.is_multiple_of(TEACH_STEP)
    }

    /// A spot before the cross-section is known: its height is its core's. `None` where the profile does not hold it.
    pub(super) fn rough(&self, profile: &[f32], at: f32) -> Option<Laid> {
        let half = CORE_WIDTHS * self.width_px;
        let from = usize::try_from((at - half).round() as i64).ok()?;
        let core = profile.get(from..=((at + half).round() as usize).max(from))?;
        Some(Laid { at, height: core.iter().sum::<f32>() / core.len() as f32, misfit: 0.0 })
    }

    /// Takes in a spot; `profile` is its light above its surroundings.
    pub(super) fn take_in(&mut self, profile: &[f32], spot: Laid) {
        let Some(light) = self.about(profile, spot.at.round()) else { return };
        if spot.height <= 0.0 {
            return;
        }
        let first = spot.at.round() - self.reach as f32;
        for (k, light) in light.iter().enumerate() {
            let bin = ((first + k as f32 - spot.at).abs() * FINE as f32).round() as usize;
            self.light[bin] += light;
            self.height[bin] += spot.height;
        }
    }

    /// The samples within reach of a whole one.
    fn about<'a>(&self, profile: &'a [f32], middle: f32) -> Option<&'a [f32]> {
        let first = usize::try_from(middle as i64 - self.reach as i64).ok()?;
        profile.get(first..first + 2 * self.reach + 1)
    }

    /// Fits the bell to what was gathered: the next spots are laid on it.
    pub(super) fn learn(&mut self) {
        if self.height.iter().sum::<f32>() <= 0.0 {
            return;
        }
        let start = self.bell.unwrap_or(Bell { sigma: FIRST.sigma * self.width_px, ..FIRST });
        let bell = (0..STEPS).fold(start, |bell, _| self.nearer(bell));
        self.bell = Some(bell);
        self.bank = (0..PHASES).map(|phase| self.phase(&bell, phase_px(phase))).collect();
        self.light.iter_mut().chain(&mut self.height).for_each(|sum| *sum *= MEMORY);
    }

    /// A step of Gauss and Newton from a bell to the light; its size is free.
    fn nearer(&self, bell: Bell) -> Bell {
        let mut normal = nalgebra::Matrix3::<f32>::zeros();
        let mut right = nalgebra::Vector3::<f32>::zeros();
        let total: f32 = self.height.iter().sum();
        for (bin, (light, weight)) in self.light.iter().zip(&self.height).enumerate().filter(|(_, (_, w))| **w > 0.0) {
            let (height, by_saturation, by_sigma, _) = bell.at(bin as f32 / FINE as f32);
            let row = nalgebra::Vector3::new(height, by_saturation, by_sigma);
            normal += *weight / total * row * row.transpose();
            right += (light - weight * height) / total * row;
        }
        (0..3).for_each(|i| normal[(i, i)] += HOLD);
        let Some(step) = normal.try_inverse().map(|inverse| inverse * right) else { return bell };
        let grown =
            |value: f32, step: f32, (least, most): (f32, f32)| (value * step.clamp(-0.5, 0.5).exp()).clamp(least, most);
        let next = Bell {
            sigma: grown(bell.sigma, step[2], (SIGMA_LIMITS.0 * self.width_px, SIGMA_LIMITS.1 * self.width_px)),
            saturation: grown(bell.saturation, step[1], SATURATION_LIMITS),
        };
        if next.sigma.is_finite() && next.saturation.is_finite() { next } else { bell }
    }

    fn phase(&self, bell: &Bell, phase_px: f32) -> Phase {
        let mut phase = Phase { height: Vec::new(), slope: Vec::new(), weight: Vec::new(), squares: [0.0; 3] };
        for k in 0..=2 * self.reach {
            let (height, _, _, slope) = bell.at(k as f32 - self.reach as f32 - phase_px);
            let core = ((height - CORE_FROM.0) / (CORE_FROM.1 - CORE_FROM.0)).clamp(0.0, 1.0);
            let error = [ERROR, PATTERN_ERROR * height, CORE_ERROR * core];
            let weight = 1.0 / error.iter().map(|e| e * e).sum::<f32>();
            phase.height.push(weight * height);
            phase.slope.push(weight * slope);
            phase.weight.push(weight);
            let products = [height * height, height * slope, slope * slope];
            phase.squares.iter_mut().zip(products).for_each(|(sum, product)| *sum += weight * product);
        }
        phase
    }

    /// Lays the cross-section on a spot; `start` is about its middle. `None` where it does not fit, or nothing was learned.
    pub(super) fn lay_on(&self, profile: &[f32], start: f32) -> Option<Laid> {
        let mut spot = Laid { at: start, height: 0.0, misfit: 0.0 };
        for _ in 0..TURNS {
            let middle = spot.at.round();
            let number = ((spot.at - middle + 0.5) * PHASES as f32).clamp(0.0, (PHASES - 1) as f32) as usize;
            let phase = self.bank.get(number)?;
            let light = self.about(profile, middle)?;
            let dot = |values: &[f32]| values.iter().zip(light).map(|(v, l)| v * l).sum::<f32>();
            let (height, slope) = (dot(&phase.height), dot(&phase.slope));
            let [hh, hs, ss] = phase.squares;
            // Light = size·(height − shift·slope).
            let all = hh * ss - hs * hs;
            let (size, moved) = ((ss * height - hs * slope) / all, (hh * slope - hs * height) / all);
            if !(size > 0.0 && moved.is_finite()) {
                return None;
            }
            let square: f32 = phase.weight.iter().zip(light).map(|(w, l)| w * l * l).sum();
            let left = (square - size * height - moved * slope).max(0.0);
            let misfit = (left / light.len() as f32).sqrt() / size;
            spot = Laid { at: middle + phase_px(number) - (moved / size).clamp(-0.5, 0.5), height: size, misfit };
        }
        Some(spot)
    }
}

/// Where a phase's middle lies beside a whole pixel, px.
fn phase_px(phase: usize) -> f32 {
    (phase as f32 + 0.5) / PHASES as f32 - 0.5
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A narrow, clipped line about a place, divided by a pattern that is `tilt` brighter a pixel.
    fn profile(at: f32, tilt: f32) -> Vec<f32> {
        let light = |i: usize| {
            let away = i as f32 - at;
            let pattern = (1.0 + tilt * away).max(0.2);
            let bell = Bell { sigma: 0.85, saturation: 5.0 * pattern }.at(away).0;
            bell / pattern
        };
        (0..31).map(light).collect()
    }

    /// Learned at places where the grid of the pixels has drawn the centroids to its own.
    fn learned() -> LineShape {
        let mut shape = LineShape::default();
        shape.expect(3.3);
        assert!(!shape.is_known());
        for turn in 0..2 {
            for i in 0..40 {
                let at = 15.0 + 0.3 * ((i as f32 * 0.618).fract() - 0.5);
                let profile = profile(at, 0.0);
                let drawn = at + 0.05 * (std::f32::consts::TAU * at).sin();
                let spot = if turn == 0 { shape.rough(&profile, drawn) } else { shape.lay_on(&profile, drawn) };
                shape.take_in(&profile, spot.expect("a spot"));
            }
            shape.learn();
        }
        shape
    }

    #[test]
    fn a_spot_is_found_whatever_its_place_beside_the_pixels() {
        let shape = learned();
        for i in 0..40 {
            let at = 14.3 + i as f32 / 30.0;
            let found = shape.lay_on(&profile(at, 0.0), at + 0.2).expect("a spot");
            assert!((found.at - at).abs() < 0.01 && (found.height - 1.0).abs() < 0.05, "{found:?}, not {at}");
        }
    }

    #[test]
    fn a_clipped_core_that_shows_the_pattern_upside_down_moves_it_little() {
        let shape = learned();
        for i in 0..10 {
            let at = 14.6 + i as f32 / 10.0;
            let found = shape.lay_on(&profile(at, 0.08), at).expect("a spot");
            assert!((found.at - at).abs() < 0.03, "{found:?}, not {at}");
        }
    }

    #[test]
    fn the_bell_s_changes_are_its_derivatives() {
        let bell = Bell { sigma: 1.3, saturation: 3.0 };
        for x in [0.0, 0.7, 1.9, 3.0] {
            let (height, by_saturation, by_sigma, slope) = bell.at(x);
            let step = 1e-2;
            let change = |low: f32, high: f32| (high - low) / (2.0 * step);
            let saturated = |by: f32| Bell { saturation: 3.0 * by, ..bell }.at(x).0;
            let wider = |by: f32| Bell { sigma: 1.3 * by, ..bell }.at(x).0;
            assert!((change(saturated(1.0 - step), saturated(1.0 + step)) - by_saturation).abs() < 1e-2);
            assert!((change(wider(1.0 - step), wider(1.0 + step)) - by_sigma).abs() < 1e-2);
            assert!((change(bell.at(x - step).0, bell.at(x + step).0) - slope).abs() < 1e-2 && height <= 1.0);
        }
    }

    #[test]
    fn what_lies_beyond_the_profile_has_no_place() {
        let shape = learned();
        assert_eq!(shape.lay_on(&profile(1.0, 0.0), 1.0), None);
        assert_eq!(LineShape::default().lay_on(&profile(15.0, 0.0), 15.0), None);
    }
}

//! The line's own cross-section, learned from the line itself, and how a spot is laid on it.
//!
//! A centroid errs by what moves the light within the line: the wall's pattern where the sensor clips it, the pixels' grid
//! where the line is a few pixels wide. So a cross-section of one form for the whole line, a bell that saturates, is laid
//! through each spot by weighted least squares with its place and its height. The flanks tell the place; the core, where
//! clipped light tells nothing but the pattern upside down, has next to no weight. How wide the bell is and how far it
//! saturates is learned from all spots. (A free form, as astronomers learn a star's image, would also learn the error that
//! the pixels' grid makes in the places it is learned at.) On simulated concrete the spots scatter by 30 to 40 % less than
//! their centroids. A bell that clips as a whole fits worse: a camera's colours clip one after the other, and what such a
//! bell does not explain draws a line of a few pixels' width to the pixels' grid, by 0.02 px.

use nalgebra::{Matrix2, Matrix3, Matrix3x2, Vector2, Vector3};

/// Parts of a pixel at which the cross-section is learned and laid on; between them its slope tells the place.
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
/// The bell before it is known (its standard deviation in widths of the line), and its limits.
const FIRST: Bell = Bell { sigma: 0.25, saturation: 5.0, unclipped: 0.1 };
const SIGMA_LIMITS: (f32, f32) = (0.15, 0.6);
const SATURATION_LIMITS: (f32, f32) = (0.2, 50.0);
const MOST_UNCLIPPED: f32 = 0.6;
/// Gauss and Newton's steps to the bell, from the frame before's.
const STEPS: usize = 4;
/// What holds the bell where the light does not tell its figures apart, as a share of all weight.
const HOLD: f32 = 1e-4;
/// A sample's error as shares of the height: always; of its own light, for the wall's pattern; and in the core, from the
/// one to the other share of the height.
const ERROR: f32 = 0.03;
const PATTERN_ERROR: f32 = 0.12;
const CORE_ERROR: f32 = 0.5;
const CORE_FROM: (f32, f32) = (0.7, 0.9);
/// What a spot on a plain wall leaves of these errors: they are wide so that no sample has all the say.
const USUAL_MISFIT: f32 = 0.6;
/// Turns in which a spot is laid on; the last one moves it by a hundredth of a pixel.
const TURNS: usize = 2;

/// A bell of which one colour clips and the others do not: (1 − u)·c(e) + u·e with e = exp(−x² / 2σ²) and
/// c(e) = (1 + A⁴)^¼·e / (1 + A⁴·e⁴)^¼; 1 in the middle. A is the saturation: the clipped part grows no more where e is
/// greater than 1/A. u is the share that goes on growing.
#[derive(Clone, Copy, Debug)]
struct Bell {
    sigma: f32,
    saturation: f32,
    unclipped: f32,
}

/// The bell's height at a distance from its middle, and its changes.
struct BellAt {
    height: f32,
    by_ln_saturation: f32,
    by_ln_sigma: f32,
    by_unclipped: f32,
    slope: f32,
}

impl Bell {
    fn at(&self, x: f32) -> BellAt {
        let variance = self.sigma * self.sigma;
        let square = x * x / variance;
        let steep = self.saturation.powi(4);
        let e = (-0.5 * square).exp();
        let clipping = 1.0 + steep * e.powi(4);
        let clipped = ((1.0 + steep) / clipping).sqrt().sqrt() * e;
        let share = 1.0 - self.unclipped;
        // What a change of ln e does: all of it where nothing is clipped.
        let by_ln_e = share * clipped / clipping + self.unclipped * e;
        BellAt {
            height: share * clipped + self.unclipped * e,
            by_ln_saturation: share * clipped * (1.0 / clipping - 1.0 / (1.0 + steep)),
            by_ln_sigma: by_ln_e * square,
            by_unclipped: e - clipped,
            slope: -by_ln_e * x / variance,
        }
    }
}

/// The line's cross-section.
#[derive(Default)]
pub(super) struct LineShape {
    width_px: f32,
    /// Samples on each side of the middle one.
    reach: usize,
    /// For each phase the light of the spots that taught, sample by sample, and the sum of their heights.
    taught: Vec<Taught>,
    bell: Option<Bell>,
    /// For each phase what a spot is laid on with; empty until something was learned.
    bank: Vec<Phase>,
}

/// Spots whose middles lie at one phase, added up.
#[derive(Clone)]
struct Taught {
    light: Vec<f32>,
    height: f32,
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
            self.taught = vec![Taught { light: vec![0.0; 2 * reach + 1], height: 0.0 }; PHASES];
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
        let middle = spot.at.round();
        let Some(light) = self.about(profile, middle).filter(|_| spot.height > 0.0) else { return };
        let taught = &mut self.taught[phase_number(spot.at - middle)];
        taught.light.iter_mut().zip(light).for_each(|(sum, light)| *sum += light);
        taught.height += spot.height;
    }

    /// The samples within reach of a whole one.
    fn about<'a>(&self, profile: &'a [f32], middle: f32) -> Option<&'a [f32]> {
        let first = usize::try_from(middle as i64 - self.reach as i64).ok()?;
        profile.get(first..first + 2 * self.reach + 1)
    }

    /// Fits the bell to what was gathered: the next spots are laid on it.
    pub(super) fn learn(&mut self) {
        if self.taught.iter().all(|taught| taught.height <= 0.0) {
            return;
        }
        let start = self.bell.unwrap_or(Bell { sigma: FIRST.sigma * self.width_px, ..FIRST });
        let bell = (0..STEPS).fold(start, |bell, _| self.nearer(bell));
        self.bell = Some(bell);
        self.bank = (0..PHASES).map(|phase| self.phase(&bell, phase_px(phase))).collect();
        for taught in &mut self.taught {
            taught.light.iter_mut().for_each(|sum| *sum *= MEMORY);
            taught.height *= MEMORY;
        }
    }

    /// A step of Gauss and Newton from a bell to the light. Place and height of each phase's spots are free: what the bell
    /// does not explain must not be learned as the places that it led to.
    fn nearer(&self, bell: Bell) -> Bell {
        let mut normal = Matrix3::<f32>::zeros();
        let mut right = Vector3::<f32>::zeros();
        let mut all = 0.0;
        for (number, taught) in self.taught.iter().enumerate().filter(|(_, taught)| taught.height > 0.0) {
            let mut free = Matrix2::<f32>::zeros();
            let mut free_right = Vector2::<f32>::zeros();
            let mut shared = Matrix3x2::<f32>::zeros();
            let (mut own, mut own_right) = (Matrix3::<f32>::zeros(), Vector3::<f32>::zeros());
            for (k, light) in taught.light.iter().enumerate() {
                let at = bell.at(k as f32 - self.reach as f32 - phase_px(number));
                let weight = taught.height * weight(at.height);
                let left = light / taught.height - at.height;
                let (row, place) = (
                    Vector3::new(at.by_ln_saturation, at.by_ln_sigma, at.by_unclipped),
                    Vector2::new(at.height, at.slope),
                );
                own += weight * row * row.transpose();
                own_right += weight * left * row;
                free += weight * place * place.transpose();
                free_right += weight * left * place;
                shared += weight * row * place.transpose();
                all += weight;
            }
            let Some(inverse) = free.try_inverse() else { continue };
            normal += own - shared * inverse * shared.transpose();
            right += own_right - shared * (inverse * free_right);
        }
        (0..3).for_each(|i| normal[(i, i)] += HOLD * all);
        let Some(step) = normal.try_inverse().map(|inverse| inverse * right) else { return bell };
        if !step.iter().all(|change| change.is_finite()) {
            return bell;
        }
        let grown =
            |value: f32, step: f32, (least, most): (f32, f32)| (value * step.clamp(-0.5, 0.5).exp()).clamp(least, most);
        Bell {
            sigma: grown(bell.sigma, step[1], (SIGMA_LIMITS.0 * self.width_px, SIGMA_LIMITS.1 * self.width_px)),
            saturation: grown(bell.saturation, step[0], SATURATION_LIMITS),
            unclipped: (bell.unclipped + step[2].clamp(-0.1, 0.1)).clamp(0.0, MOST_UNCLIPPED),
        }
    }

    fn phase(&self, bell: &Bell, phase_px: f32) -> Phase {
        let mut phase = Phase { height: Vec::new(), slope: Vec::new(), weight: Vec::new(), squares: [0.0; 3] };
        for k in 0..=2 * self.reach {
            let BellAt { height, slope, .. } = bell.at(k as f32 - self.reach as f32 - phase_px);
            let weight = weight(height);
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
            let number = phase_number(spot.at - middle);
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
            let misfit = (left / light.len() as f32).sqrt() / (USUAL_MISFIT * size);
            spot = Laid { at: middle + phase_px(number) - (moved / size).clamp(-0.5, 0.5), height: size, misfit };
        }
        Some(spot)
    }
}

/// Weight of a sample where the cross-section is so high.
fn weight(height: f32) -> f32 {
    let core = ((height - CORE_FROM.0) / (CORE_FROM.1 - CORE_FROM.0)).clamp(0.0, 1.0);
    let error = [ERROR, PATTERN_ERROR * height, CORE_ERROR * core];
    1.0 / error.iter().map(|e| e * e).sum::<f32>()
}

/// The phase of a place that lies so far beside a whole pixel, px.
fn phase_number(beside_px: f32) -> usize {
    ((beside_px + 0.5) * PHASES as f32).clamp(0.0, (PHASES - 1) as f32) as usize
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
            Bell { sigma: 0.85, saturation: 5.0 * pattern, unclipped: 0.15 }.at(away).height / pattern
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
            assert!((found.at - at).abs() < 0.04, "{found:?}, not {at}");
        }
    }

    #[test]
    fn the_bell_s_changes_are_its_derivatives() {
        let bell = Bell { sigma: 1.3, saturation: 3.0, unclipped: 0.2 };
        for x in [0.0, 0.7, 1.9, 3.0] {
            let BellAt { height, by_ln_saturation, by_ln_sigma, by_unclipped, slope } = bell.at(x);
            let step = 1e-2;
            let change = |low: Bell, high: Bell| (high.at(x).height - low.at(x).height) / (2.0 * step);
            let saturated = |by: f32| Bell { saturation: 3.0 * by, ..bell };
            let wider = |by: f32| Bell { sigma: 1.3 * by, ..bell };
            let shared = |by: f32| Bell { unclipped: 0.2 + by, ..bell };
            assert!((change(saturated(1.0 - step), saturated(1.0 + step)) - by_ln_saturation).abs() < 1e-2);
            assert!((change(wider(1.0 - step), wider(1.0 + step)) - by_ln_sigma).abs() < 1e-2);
            assert!((change(shared(-step), shared(step)) - by_unclipped).abs() < 1e-2);
            let rise = (bell.at(x + step).height - bell.at(x - step).height) / (2.0 * step);
            assert!((rise - slope).abs() < 1e-2 && height <= 1.0);
        }
    }

    #[test]
    fn what_lies_beyond_the_profile_has_no_place() {
        let shape = learned();
        assert_eq!(shape.lay_on(&profile(1.0, 0.0), 1.0), None);
        assert_eq!(LineShape::default().lay_on(&profile(15.0, 0.0), 15.0), None);
    }
}

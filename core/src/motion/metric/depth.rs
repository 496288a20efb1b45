//! A landmark's depth before the laser has passed over it: what its neighbours have.

use nalgebra::{Matrix3, Vector3};

/// Places along the line count as this much nearer than places along the travel: a pipe and a tunnel keep their section.
const SECTION: f64 = 3.0;
/// Distance (X / Z) at which a neighbour counts half as much as one at the place itself.
const NEAR: f64 = 0.03;
/// Relative standard deviation of the depth beside a neighbour, and its growth with the distance (X / Z).
const SIGMA_NEAR: f64 = 0.01;
const SIGMA_GROWTH: f64 = 0.5;
/// Largest relative standard deviation: nothing near is known.
const SIGMA_FAR: f64 = 0.5;
/// How strongly the surface is taken to be square to the camera along the travel, where nothing says otherwise.
const SQUARE: f64 = 1e-3;

/// A place of known depth: (X / Z, Y / Z) and 1 / Z, 1/mm.
#[derive(Clone, Copy, Debug)]
pub(super) struct Known {
    pub ray: [f64; 2],
    pub inverse_mm: f64,
}

/// A depth with its slopes: 1 / Z = `inverse_mm` + `slopes` · (ray − place).
#[derive(Clone, Copy, Debug)]
pub(super) struct DepthGuess {
    pub inverse_mm: f64,
    pub slopes: [f64; 2],
    /// Standard deviation as a share of the depth.
    pub sigma_share: f64,
}

/// The plane through the neighbours (a plane's inverse depth is linear in the image); `along` is the ray's axis along
/// the laser line. `None` where nothing is known.
pub(super) fn guess(known: &[Known], ray: [f64; 2], along: usize) -> Option<DepthGuess> {
    let mean = known.iter().map(|k| k.inverse_mm).sum::<f64>() / known.len().max(1) as f64;
    let mut normal = Matrix3::zeros();
    let mut right = Vector3::zeros();
    let mut nearest = f64::MAX;
    for k in known {
        let off = [k.ray[0] - ray[0], k.ray[1] - ray[1]];
        let distance = (off[along] * off[along] + (off[1 - along] / SECTION).powi(2)).sqrt();
        nearest = nearest.min(distance);
        let weight = 1.0 / (distance * distance + NEAR * NEAR).powi(2);
        let row = Vector3::new(1.0, off[0], off[1]);
        normal += weight * row * row.transpose();
        right += weight * (k.inverse_mm / mean - 1.0) * row;
    }
    let total = normal[(0, 0)];
    normal[(2 - along, 2 - along)] += SQUARE * total;
    normal[(1 + along, 1 + along)] += 1e-3 * SQUARE * total;
    let solved = normal.try_inverse()? * right;
    let inverse_mm = mean * (1.0 + solved[0]).clamp(0.5, 2.0);
    (inverse_mm.is_finite() && inverse_mm > 0.0).then(|| DepthGuess {
        inverse_mm,
        slopes: [mean * solved[1], mean * solved[2]],
        sigma_share: (SIGMA_NEAR + SIGMA_GROWTH * nearest).min(SIGMA_FAR),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tilted_plane_is_carried_on() {
        let inverse = |x: f64, y: f64| 1.0 / 500.0 * (1.0 + 0.1 * x - 0.2 * y);
        let known: Vec<Known> = (0..40)
            .map(|i| {
                let (x, y) = (-0.2 + 0.1 * f64::from(i % 5), -0.2 + 0.01 * f64::from(i));
                Known { ray: [x, y], inverse_mm: inverse(x, y) }
            })
            .collect();
        let guess = guess(&known, [0.15, 0.0], 1).expect("known neighbours");
        assert!((guess.inverse_mm / inverse(0.15, 0.0) - 1.0).abs() < 3e-3, "{guess:?}");
        assert!(super::guess(&[], [0.0, 0.0], 1).is_none());
    }
}

//! A corner of the board to a few hundredths of a pixel: a model of the light is fitted to the pixels around it.
//!
//! Two edges cross at the corner; the light is white on one pair of opposite sectors and black on the other,
//! blurred by a Gaussian: `a + g·(x, y) + b·E(d₁)·E(d₂)` with `E(d) = erf(d / (√2·σ))` and dᵢ the distance from
//! edge i. In linear light this is what an antialiased, slightly blurred camera sees; no pixel is weighted by hand,
//! and the fit gives its own uncertainty.

use nalgebra::{SMatrix, SVector};

use super::light::Plane;

/// Unknowns: x, y, the directions of both edges, ln σ, a, b, the two gradients.
const UNKNOWNS: usize = 9;
/// Rounds of the fit; it needs five or six.
const MAX_ROUNDS: usize = 25;
/// The farthest that the fit may move from where the detector saw the corner, px.
const MAX_MOVE_PX: f64 = 2.5;
/// The largest remainder of the fit, as a share of the contrast: beyond it, this is no corner of two edges.
const MAX_REMAINDER: f64 = 0.25;
/// Blur of an image that can be used, standard deviation in px.
const BLUR_PX: (f64, f64) = (0.15, 5.0);

/// A corner as fitted.
#[derive(Clone, Copy, Debug)]
pub(super) struct Fitted {
    pub x_px: f64,
    pub y_px: f64,
}

type Unknowns = SVector<f64, UNKNOWNS>;

/// Fits the corner near (x, y); `edges_rad` are the directions of its two edges, `radius_px` the reach of the
/// window. `None` where the pixels do not show a corner.
pub(super) fn refine(light: &Plane, x_px: f64, y_px: f64, edges_rad: [f64; 2], radius_px: f64) -> Option<Fitted> {
    let window = Window::around(light, x_px, y_px, radius_px)?;
    let mut at = window.start(edges_rad)?;
    let (mut cost, mut normal, mut slope) = window.linearise(&at);
    let mut damping = 1e-3;
    for _ in 0..MAX_ROUNDS {
        let mut damped = normal;
        (0..UNKNOWNS).for_each(|i| damped[(i, i)] *= 1.0 + damping);
        let step = damped.cholesky()?.solve(&slope);
        let next = at + step;
        let (next_cost, next_normal, next_slope) = window.linearise(&next);
        if next_cost < cost {
            let still = step[0].hypot(step[1]) < 1e-4 && cost - next_cost < 1e-6 * cost;
            (at, cost, normal, slope) = (next, next_cost, next_normal, next_slope);
            damping *= 0.2;
            if still {
                break;
            }
        } else if step[0].hypot(step[1]) < 1e-5 {
            break;
        } else {
            damping *= 8.0;
        }
    }
    let remainder = (cost / window.pixels.len() as f64).sqrt();
    let good = at[0].hypot(at[1]) < MAX_MOVE_PX
        && remainder < MAX_REMAINDER * at[6].abs()
        && (BLUR_PX.0..BLUR_PX.1).contains(&at[4].exp());
    good.then(|| Fitted { x_px: x_px + at[0], y_px: y_px + at[1] })
}

/// The pixels around a corner: place relative to where the detector saw it, and light.
struct Window {
    pixels: Vec<(f64, f64, f64)>,
}

impl Window {
    fn around(light: &Plane, x_px: f64, y_px: f64, radius_px: f64) -> Option<Window> {
        let mut pixels = Vec::new();
        for row in (y_px - radius_px).ceil() as i64..=(y_px + radius_px).floor() as i64 {
            for column in (x_px - radius_px).ceil() as i64..=(x_px + radius_px).floor() as i64 {
                let (dx, dy) = (column as f64 - x_px, row as f64 - y_px);
                if dx * dx + dy * dy <= radius_px * radius_px {
                    pixels.push((dx, dy, f64::from(light.at(column, row)?)));
                }
            }
        }
        (pixels.len() > 2 * UNKNOWNS).then_some(Window { pixels })
    }

    /// Mean light and contrast by the signs of the sectors.
    fn start(&self, edges_rad: [f64; 2]) -> Option<Unknowns> {
        let count = self.pixels.len() as f64;
        let mean = self.pixels.iter().map(|p| p.2).sum::<f64>() / count;
        let side = |p: &(f64, f64, f64), angle: f64| (p.1 * angle.cos() - p.0 * angle.sin()).signum();
        let contrast =
            self.pixels.iter().map(|p| (p.2 - mean) * side(p, edges_rad[0]) * side(p, edges_rad[1])).sum::<f64>()
                / count;
        let start = [0.0, 0.0, edges_rad[0], edges_rad[1], 0.0, mean, contrast, 0.0, 0.0];
        (contrast != 0.0).then(|| Unknowns::from_row_slice(&start))
    }

    /// Sum of squares, JᵀJ and Jᵀr at a guess.
    fn linearise(&self, at: &Unknowns) -> (f64, SMatrix<f64, UNKNOWNS, UNKNOWNS>, Unknowns) {
        let sigma = at[4].exp();
        let edges = [at[2].sin_cos(), at[3].sin_cos()];
        let (mut cost, mut normal, mut slope) = (0.0, SMatrix::zeros(), Unknowns::zeros());
        for (x, y, value) in &self.pixels {
            let (dx, dy) = (x - at[0], y - at[1]);
            // Signed distance from each edge, how far along it, and E with its derivative.
            let sides = edges.map(|(s, c)| {
                let (across, along) = (dy * c - dx * s, dx * c + dy * s);
                let t = across / sigma;
                (along, t, erf(t * std::f64::consts::FRAC_1_SQRT_2), gauss(t) / sigma)
            });
            let [(along_1, t_1, e_1, d_1), (along_2, t_2, e_2, d_2)] = sides;
            let b = at[6];
            let (g_1, g_2) = (b * d_1 * e_2, b * e_1 * d_2);
            let [(s_1, c_1), (s_2, c_2)] = edges;
            let row = Unknowns::from_row_slice(&[
                g_1 * s_1 + g_2 * s_2,
                -g_1 * c_1 - g_2 * c_2,
                -g_1 * along_1,
                -g_2 * along_2,
                -(g_1 * t_1 + g_2 * t_2) * sigma,
                1.0,
                e_1 * e_2,
                *x,
                *y,
            ]);
            let miss = value - (at[5] + at[7] * x + at[8] * y + b * e_1 * e_2);
            cost += miss * miss;
            normal += row * row.transpose();
            slope += row * miss;
        }
        (cost, normal, slope)
    }
}

/// The derivative of `erf(t/√2)` by t.
fn gauss(t: f64) -> f64 {
    (2.0 / std::f64::consts::PI).sqrt() * (-0.5 * t * t).exp()
}

/// The error function to 1.5e-7 (Abramowitz and Stegun, 7.1.26).
fn erf(x: f64) -> f64 {
    let t = 1.0 / (1.0 + 0.327_591_1 * x.abs());
    let series =
        t * (0.254_829_592 + t * (-0.284_496_736 + t * (1.421_413_741 + t * (-1.453_152_027 + t * 1.061_405_429))));
    (1.0 - series * (-x * x).exp()).copysign(x)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A corner of two straight edges, each pixel the mean of 16 x 16 places.
    fn picture(x: f64, y: f64, edges_rad: [f64; 2]) -> Plane {
        let side = 31;
        let mut data = vec![0.0; side * side];
        for (i, pixel) in data.iter_mut().enumerate() {
            let (column, row) = ((i % side) as f64, (i / side) as f64);
            let white = (0..256).filter(|k| {
                let (dx, dy) = (f64::from(k % 16) / 16.0 - 0.46875, f64::from(k / 16) / 16.0 - 0.46875);
                let side = |a: f64| (row + dy - y) * a.cos() - (column + dx - x) * a.sin();
                side(edges_rad[0]) * side(edges_rad[1]) > 0.0
            });
            *pixel = 0.05 + 0.6 * white.count() as f32 / 256.0;
        }
        Plane { width_px: side, height_px: side, data }
    }

    #[test]
    fn an_unblurred_corner_is_met_to_0_02_px() {
        for (x, y, edges) in [(15.3, 14.8, [0.1, 1.5]), (14.6, 15.45, [0.6, 2.0]), (15.0, 15.5, [0.2, 1.2])] {
            let plane = picture(x, y, edges);
            let found = refine(&plane, x + 0.7, y - 0.9, edges.map(|a| a + 0.1), 7.0).expect("a corner");
            let off = (found.x_px - x).hypot(found.y_px - y);
            assert!(off < 0.02, "{off} px");
        }
    }

    #[test]
    fn an_edge_and_a_blank_are_no_corners() {
        let edge =
            Plane { width_px: 31, height_px: 31, data: (0..961).map(|i| f32::from(u8::from(i % 31 > 15))).collect() };
        assert!(refine(&edge, 15.0, 15.0, [0.0, 1.5], 7.0).is_none());
        let blank = Plane { width_px: 31, height_px: 31, data: vec![0.5; 961] };
        assert!(refine(&blank, 15.0, 15.0, [0.0, 1.5], 7.0).is_none());
        assert!(refine(&blank, 1.0, 15.0, [0.0, 1.5], 7.0).is_none(), "beyond the rim");
    }
}

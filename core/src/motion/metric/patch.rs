//! A small piece of the wall as it looked once, and where it is in another image.
//!
//! Lucas and Kanade's least squares in Baker and Matthews' inverse form: the slopes belong to the patch and are worked
//! out once. Brightness may change by a factor and an offset, as under a lamp that moves with the robot.

use super::image::Gray;

/// Side of the patch, px.
pub(super) const SIDE: usize = 16;
/// The patch reaches this far from its place, px, slopes included.
pub(super) const REACH: usize = SIDE / 2 + 1;
/// Side of the piece of image that a landmark keeps to make its patch from as it is turned.
const KEPT: usize = 2 * (REACH + 3);
const PIXELS: usize = SIDE * SIDE;
/// Rounds, at most.
const ROUNDS: usize = 12;
/// Steps of a wide search, px: a patch of this side is still like itself one step aside.
const SEARCH_STEP_PX: f32 = 2.0;
/// It is found when it moves less than this, px.
const FOUND_PX: f32 = 0.03;
/// A patch whose brightness changes by less than this (standard deviation, levels) cannot be followed.
const LEAST_CONTRAST: f32 = 1.0;

/// How a piece of the image is turned and stretched against how it was kept: image offset = matrix · kept offset.
pub(super) type Stretch = [[f32; 2]; 2];

/// No change.
pub(super) const UPRIGHT: Stretch = [[1.0, 0.0], [0.0, 1.0]];

/// A piece of an image around a whole pixel.
pub(super) struct Kept {
    values: Box<[u8; KEPT * KEPT]>,
}

impl Kept {
    /// `None` where it would reach over the image's edge.
    pub(super) fn cut(image: Gray<'_>, x: usize, y: usize) -> Option<Kept> {
        let half = KEPT / 2;
        if x < half || y < half || x + half > image.width || y + half > image.height {
            return None;
        }
        let mut values = Box::new([0; KEPT * KEPT]);
        for (row, out) in values.chunks_exact_mut(KEPT).enumerate() {
            out.copy_from_slice(&image.row(y - half + row)[x - half..][..KEPT]);
        }
        Some(Kept { values })
    }

    /// The patch as it looks when the piece is stretched. `None` where it would show what was not kept, or nothing.
    pub(super) fn patch(&self, stretch: Stretch) -> Option<Patch> {
        let [[a, b], [c, d]] = stretch;
        let det = a * d - b * c;
        if !(0.5..2.0).contains(&det) {
            return None;
        }
        let back = [[d / det, -b / det], [-c / det, a / det]];
        const WIDE: usize = SIDE + 2;
        let mut wide = [0.0f32; WIDE * WIDE];
        let middle = (KEPT / 2) as f32;
        for row in 0..WIDE {
            for column in 0..WIDE {
                let (x, y) = (column as f32 - REACH as f32, row as f32 - REACH as f32);
                let (kept_x, kept_y) =
                    (back[0][0] * x + back[0][1] * y + middle, back[1][0] * x + back[1][1] * y + middle);
                if !(kept_x >= 0.0 && kept_y >= 0.0 && kept_x < (KEPT - 1) as f32 && kept_y < (KEPT - 1) as f32) {
                    return None;
                }
                let (i, j) = (kept_x as usize, kept_y as usize);
                let (s, t) = (kept_x - i as f32, kept_y - j as f32);
                let at = |i: usize, j: usize| f32::from(self.values[j * KEPT + i]);
                let top = at(i, j) + s * (at((i + 1).min(KEPT - 1), j) - at(i, j));
                let j1 = (j + 1).min(KEPT - 1);
                let low = at(i, j1) + s * (at((i + 1).min(KEPT - 1), j1) - at(i, j1));
                wide[row * WIDE + column] = top + t * (low - top);
            }
        }
        Patch::of(&wide)
    }
}

/// A patch ready to be looked for.
pub(super) struct Patch {
    /// Brightness less its mean, divided by its standard deviation.
    values: Box<[f32; PIXELS]>,
    slope_x: Box<[f32; PIXELS]>,
    slope_y: Box<[f32; PIXELS]>,
    /// Inverse of the slopes' normal matrix: xx, xy, yy.
    inverse: [f32; 3],
    /// The values' moments with the slopes.
    own: (f32, f32),
}

/// Where a patch was found.
#[derive(Clone, Copy, Debug)]
pub(super) struct Found {
    pub x: f32,
    pub y: f32,
    /// Correlation with the patch, −1 to 1.
    pub likeness: f32,
    /// Standard deviation of the place from what does not fit, px.
    pub sigma: f32,
}

impl Patch {
    /// From a square of `SIDE + 2` px.
    fn of(wide: &[f32]) -> Option<Patch> {
        const WIDE: usize = SIDE + 2;
        let inner = |row: usize, column: usize| wide[(row + 1) * WIDE + column + 1];
        let mut values = Box::new([0.0; PIXELS]);
        for row in 0..SIDE {
            (0..SIDE).for_each(|column| values[row * SIDE + column] = inner(row, column));
        }
        let mean = values.iter().sum::<f32>() / PIXELS as f32;
        values.iter_mut().for_each(|v| *v -= mean);
        let deviation = (values.iter().map(|v| v * v).sum::<f32>() / PIXELS as f32).sqrt();
        if deviation < LEAST_CONTRAST {
            return None;
        }
        values.iter_mut().for_each(|v| *v /= deviation);
        let (mut slope_x, mut slope_y) = (Box::new([0.0; PIXELS]), Box::new([0.0; PIXELS]));
        let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
        for row in 0..SIDE {
            for column in 0..SIDE {
                let at = (row + 1) * WIDE + column + 1;
                let x = (wide[at + 1] - wide[at - 1]) / (2.0 * deviation);
                let y = (wide[at + WIDE] - wide[at - WIDE]) / (2.0 * deviation);
                (slope_x[row * SIDE + column], slope_y[row * SIDE + column]) = (x, y);
                (xx, xy, yy) = (xx + x * x, xy + x * y, yy + y * y);
            }
        }
        let det = xx * yy - xy * xy;
        let moment = |slope: &[f32; PIXELS]| values.iter().zip(slope).map(|(v, s)| v * s).sum::<f32>();
        let own = (moment(&slope_x), moment(&slope_y));
        (det > 1e-6 * (xx + yy) * (xx + yy)).then(|| Patch {
            values,
            slope_x,
            slope_y,
            inverse: [yy / det, -xy / det, xx / det],
            own,
        })
    }

    /// From a piece of an image around a whole pixel, as it is.
    pub(super) fn cut(image: Gray<'_>, x: usize, y: usize) -> Option<Patch> {
        const WIDE: usize = SIDE + 2;
        if x < REACH || y < REACH || x + REACH > image.width || y + REACH > image.height {
            return None;
        }
        let mut wide = [0.0f32; WIDE * WIDE];
        for (row, out) in wide.chunks_exact_mut(WIDE).enumerate() {
            let from = &image.row(y + row - REACH)[x - REACH..][..WIDE];
            out.iter_mut().zip(from).for_each(|(out, value)| *out = f32::from(*value));
        }
        Patch::of(&wide)
    }

    /// Looks for the patch from a place on; gives up beyond `largest_px` from there or at the image's edge.
    pub(super) fn find(&self, image: Gray<'_>, start: (f32, f32), largest_px: f32) -> Option<Found> {
        let (mut x, mut y) = start;
        let mut seen = [0.0f32; PIXELS];
        let mut last = f32::MAX;
        for _ in 0..ROUNDS {
            let (like, (dx, dy)) = self.step(image, x, y, &mut seen)?;
            x -= dx;
            y -= dy;
            if (x - start.0).abs().max((y - start.1).abs()) > largest_px {
                return None;
            }
            let step = (dx * dx + dy * dy).sqrt();
            if step < FOUND_PX || (step < 0.1 && step > 0.7 * last) {
                let rest = (1.0 - like).max(0.0) * 2.0;
                let [xx, _, yy] = self.inverse;
                // What does not fit is alike over some pixels: fewer of them count.
                let sigma = (rest * (xx + yy) * 0.5 * 4.0).sqrt();
                return Some(Found { x, y, likeness: like, sigma });
            }
            last = step;
        }
        None
    }

    /// Where within `reach` px of a place, in steps of [`SEARCH_STEP_PX`], the image is most like the patch; and how like.
    /// For shifts too large for [`Patch::find`].
    pub(super) fn search(&self, image: Gray<'_>, start: (f32, f32), reach: f32) -> Option<Found> {
        let mut seen = [0.0f32; PIXELS];
        let steps = (reach / SEARCH_STEP_PX) as i32;
        let mut best: Option<Found> = None;
        for (row, column) in (-steps..=steps).flat_map(|row| (-steps..=steps).map(move |column| (row, column))) {
            let (x, y) = (start.0 + column as f32 * SEARCH_STEP_PX, start.1 + row as f32 * SEARCH_STEP_PX);
            let Some((likeness, _)) = self.step(image, x, y, &mut seen) else { continue };
            if best.is_none_or(|best| likeness > best.likeness) {
                best = Some(Found { x, y, likeness, sigma: SEARCH_STEP_PX });
            }
        }
        best
    }

    /// One round: how alike the image is to the patch there, and how far the patch seems to be off.
    fn step(&self, image: Gray<'_>, x: f32, y: f32, seen: &mut [f32; PIXELS]) -> Option<(f32, (f32, f32))> {
        /// The same with the wider registers of processors since 2013: half of the motion's time is spent here.
        #[cfg(target_arch = "x86_64")]
        #[target_feature(enable = "avx2")]
        fn wide(patch: &Patch, image: Gray<'_>, x: f32, y: f32, seen: &mut [f32; PIXELS]) -> Option<(f32, (f32, f32))> {
            patch.step_anywhere(image, x, y, seen)
        }
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") {
            // SAFETY: the processor has what the function is compiled for; it does nothing else that is unsafe.
            #[allow(unsafe_code)]
            return unsafe { wide(self, image, x, y, seen) };
        }
        self.step_anywhere(image, x, y, seen)
    }

    #[inline(always)]
    fn step_anywhere(&self, image: Gray<'_>, x: f32, y: f32, seen: &mut [f32; PIXELS]) -> Option<(f32, (f32, f32))> {
        if !image.holds(x, y, REACH as f32) {
            return None;
        }
        // Inside the image, so above 0: cutting off is rounding down.
        let (left, top) = (x as usize, y as usize);
        let (s, t) = (x - left as f32, y - top as f32);
        let (left, top) = (left - SIDE / 2, top - SIDE / 2);
        let weights = [(1.0 - s) * (1.0 - t), s * (1.0 - t), (1.0 - s) * t, s * t];
        let mut sum = 0.0;
        for (row, out) in seen.chunks_exact_mut(SIDE).enumerate() {
            let upper = &image.data[(top + row) * image.stride + left..][..SIDE + 1];
            let lower = &image.data[(top + row + 1) * image.stride + left..][..SIDE + 1];
            for i in 0..SIDE {
                out[i] = weights[0] * f32::from(upper[i])
                    + weights[1] * f32::from(upper[i + 1])
                    + weights[2] * f32::from(lower[i])
                    + weights[3] * f32::from(lower[i + 1]);
            }
            sum += out.iter().sum::<f32>();
        }
        let mean = sum / PIXELS as f32;
        let (mut square, mut product) = ([0.0f32; 8], [0.0f32; 8]);
        let (mut moment_x, mut moment_y) = ([0.0f32; 8], [0.0f32; 8]);
        for (((seen, values), slope_x), slope_y) in seen
            .chunks_exact(8)
            .zip(self.values.chunks_exact(8))
            .zip(self.slope_x.chunks_exact(8))
            .zip(self.slope_y.chunks_exact(8))
        {
            for i in 0..8 {
                let value = seen[i] - mean;
                square[i] += value * value;
                product[i] += value * values[i];
                moment_x[i] += value * slope_x[i];
                moment_y[i] += value * slope_y[i];
            }
        }
        let total = |parts: [f32; 8]| parts.iter().sum::<f32>();
        let deviation = (total(square) / PIXELS as f32).sqrt();
        if deviation < LEAST_CONTRAST {
            return None;
        }
        // The error is (seen − mean)/deviation − values; the values' own part of the moment is known beforehand.
        let (own_x, own_y) = self.own;
        let (moment_x, moment_y) = (total(moment_x) / deviation - own_x, total(moment_y) / deviation - own_y);
        let [xx, xy, yy] = self.inverse;
        let like = total(product) / (deviation * PIXELS as f32);
        Some((like, (xx * moment_x + xy * moment_y, xy * moment_x + yy * moment_y)))
    }
}

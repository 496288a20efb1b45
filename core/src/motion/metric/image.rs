//! Brightness at two sizes: the image itself and one sixteenth of its pixels, for motions too large to follow at once.

use crate::source::{PlaneView, Yuv};

/// Pixels a side that make one of the small image.
pub(super) const SHRINK: usize = 4;

/// Brightness, 8 bits a pixel.
#[derive(Clone, Copy)]
pub(super) struct Gray<'a> {
    pub data: &'a [u8],
    pub stride: usize,
    pub width: usize,
    pub height: usize,
}

impl<'a> Gray<'a> {
    pub(super) fn of(image: Yuv<'a>) -> Gray<'a> {
        let PlaneView { data, stride_bytes } = image.luma();
        Gray { data, stride: stride_bytes, width: image.width_px(), height: image.height_px() }
    }

    pub(super) fn row(&self, row: usize) -> &'a [u8] {
        &self.data[row * self.stride..][..self.width]
    }

    /// Whether a square of `reach` px around a place lies inside.
    pub(super) fn holds(&self, x: f32, y: f32, reach: f32) -> bool {
        x - reach >= 0.0 && y - reach >= 0.0 && x + reach < self.width as f32 && y + reach < self.height as f32
    }
}

/// A shrunk image.
pub(super) struct Small {
    data: Vec<u8>,
    width: usize,
    height: usize,
}

impl Small {
    /// The mean of each [`SHRINK`] by [`SHRINK`] pixels.
    pub(super) fn of(image: Gray<'_>) -> Small {
        let (width, height) = (image.width / SHRINK, image.height / SHRINK);
        let mut data = Vec::with_capacity(width * height);
        let mut sums = vec![0u16; width * SHRINK];
        for row in 0..height {
            sums.fill(0);
            for k in 0..SHRINK {
                for (sum, value) in sums.iter_mut().zip(image.row(row * SHRINK + k)) {
                    *sum += u16::from(*value);
                }
            }
            let all = (SHRINK * SHRINK) as u16;
            data.extend(sums.chunks_exact(SHRINK).map(|part| ((part.iter().sum::<u16>() + all / 2) / all) as u8));
        }
        Small { data, width, height }
    }

    pub(super) fn gray(&self) -> Gray<'_> {
        Gray { data: &self.data, stride: self.width, width: self.width, height: self.height }
    }
}

/// Where a place of the image lies in the shrunk one.
pub(super) fn shrunk(x: f32) -> f32 {
    (x + 0.5) / SHRINK as f32 - 0.5
}

//! The pixels of a frame, in the colours that the camera's encoder meant.

/// The pixels of a frame: 8 bits a channel, blue, green, red, row by row without padding.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Image {
    width_px: u32,
    height_px: u32,
    bgr: Vec<u8>,
}

impl Image {
    /// From `3 * width_px * height_px` bytes.
    ///
    /// # Panics
    /// With any other number of bytes.
    pub fn from_bgr(width_px: u32, height_px: u32, bgr: Vec<u8>) -> Image {
        assert_eq!(bgr.len(), 3 * width_px as usize * height_px as usize, "three bytes a pixel");
        Image { width_px, height_px, bgr }
    }

    /// Columns.
    pub fn width_px(&self) -> u32 {
        self.width_px
    }

    /// Rows.
    pub fn height_px(&self) -> u32 {
        self.height_px
    }

    /// The bytes: blue, green, red of each pixel.
    pub fn bgr(&self) -> &[u8] {
        &self.bgr
    }

    /// The bytes, given away.
    pub fn into_bgr(self) -> Vec<u8> {
        self.bgr
    }
}

/// Which weights of red and blue make the luma: ITU-R BT.601, BT.709 or BT.2020.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Matrix {
    Bt601,
    Bt709,
    Bt2020,
}

/// How a frame's luma and chroma become colours.
#[derive(Clone, Copy, Debug)]
pub(super) struct YuvFormat {
    pub width_px: usize,
    pub height_px: usize,
    /// Chroma samples per luma sample, as a shift: 1 for half.
    pub chroma_shift_x: u32,
    pub chroma_shift_y: u32,
    /// Chroma samples lie on the even luma columns (MPEG); else between two columns (JPEG).
    pub chroma_left: bool,
    pub matrix: Matrix,
    /// Luma from 0 to 255 (JPEG); else 16 to 235.
    pub full_range: bool,
}

/// A plane of 8-bit samples.
#[derive(Clone, Copy)]
pub(super) struct PlaneView<'a> {
    pub data: &'a [u8],
    pub stride_bytes: usize,
}

/// Fixed-point coefficients (16 fractional bits) of the conversion to R'G'B'.
struct Coefficients {
    y_offset: i32,
    y: i32,
    r_v: i32,
    g_u: i32,
    g_v: i32,
    b_u: i32,
}

impl Coefficients {
    fn of(format: &YuvFormat) -> Coefficients {
        let (kr, kb) = match format.matrix {
            Matrix::Bt601 => (0.299, 0.114),
            Matrix::Bt709 => (0.2126, 0.0722),
            Matrix::Bt2020 => (0.2627, 0.0593),
        };
        let kg = 1.0 - kr - kb;
        let (luma, chroma) = if format.full_range { (1.0, 1.0) } else { (255.0 / 219.0, 255.0 / 224.0) };
        let fixed = |v: f64| (v * 65536.0).round() as i32;
        Coefficients {
            y_offset: if format.full_range { 0 } else { 16 },
            y: fixed(luma),
            r_v: fixed(2.0 * (1.0 - kr) * chroma),
            g_u: fixed(2.0 * (1.0 - kb) * kb / kg * chroma),
            g_v: fixed(2.0 * (1.0 - kr) * kr / kg * chroma),
            b_u: fixed(2.0 * (1.0 - kb) * chroma),
        }
    }
}

/// Converts a planar frame. Chroma is interpolated along the rows at its true place, since half a
/// pixel of colour shift would move the spot; between rows too where it is subsampled there.
pub(super) fn image_from_yuv(format: &YuvFormat, y: PlaneView, u: PlaneView, v: PlaneView) -> Image {
    let (width, height) = (format.width_px, format.height_px);
    let c = Coefficients::of(format);
    let mut bgr = vec![0u8; 3 * width * height];
    let (mut u_row, mut v_row) = (vec![0u8; width], vec![0u8; width]);
    for (row, out) in bgr.chunks_exact_mut(3 * width).enumerate() {
        chroma_row(format, u, row, &mut u_row);
        chroma_row(format, v, row, &mut v_row);
        let y_row = &y.data[row * y.stride_bytes..][..width];
        for (((bgr, y), u), v) in out.chunks_exact_mut(3).zip(y_row).zip(&u_row).zip(&v_row) {
            let luma = (i32::from(*y) - c.y_offset) * c.y + 32768;
            let (u, v) = (i32::from(*u) - 128, i32::from(*v) - 128);
            bgr[0] = ((luma + c.b_u * u) >> 16).clamp(0, 255) as u8;
            bgr[1] = ((luma - c.g_u * u - c.g_v * v) >> 16).clamp(0, 255) as u8;
            bgr[2] = ((luma + c.r_v * v) >> 16).clamp(0, 255) as u8;
        }
    }
    Image::from_bgr(width as u32, height as u32, bgr)
}

/// One row of chroma at full width.
fn chroma_row(format: &YuvFormat, plane: PlaneView, row: usize, out: &mut [u8]) {
    let chroma_width = format.width_px.div_ceil(1 << format.chroma_shift_x);
    let chroma_height = format.height_px.div_ceil(1 << format.chroma_shift_y);
    let line = |r: usize| &plane.data[r.min(chroma_height - 1) * plane.stride_bytes..][..chroma_width];
    let near = line(row >> format.chroma_shift_y);
    // Vertically, samples lie between two rows: three quarters of the near one, one of the next.
    let far = match format.chroma_shift_y {
        1 if row % 2 == 1 => line(row / 2 + 1),
        1 => line((row / 2).saturating_sub(1)),
        _ => near,
    };
    let mix = |i: usize| (3 * u32::from(near[i]) + u32::from(far[i])) as i32; // 4 times the value
    let last = chroma_width - 1;
    match (format.chroma_shift_x, format.chroma_left) {
        (0, _) => (0..out.len()).for_each(|x| out[x] = ((mix(x) + 2) >> 2) as u8),
        (1, true) => {
            for i in 0..chroma_width {
                let (here, next) = (mix(i), mix((i + 1).min(last)));
                out[2 * i] = ((here + 2) >> 2) as u8;
                if let Some(odd) = out.get_mut(2 * i + 1) {
                    *odd = ((here + next + 4) >> 3) as u8;
                }
            }
        }
        (1, false) => {
            for i in 0..chroma_width {
                let (before, here, next) = (mix(i.saturating_sub(1)), mix(i), mix((i + 1).min(last)));
                out[2 * i] = ((before + 3 * here + 8) >> 4) as u8;
                if let Some(odd) = out.get_mut(2 * i + 1) {
                    *odd = ((next + 3 * here + 8) >> 4) as u8;
                }
            }
        }
        (shift, _) => (0..out.len()).for_each(|x| out[x] = ((mix(x >> shift) + 2) >> 2) as u8),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn one_colour(format: &YuvFormat, y: u8, u: u8, v: u8) -> [u8; 3] {
        let plane = |value: u8| vec![value; format.width_px * format.height_px];
        let (y, u, v) = (plane(y), plane(u), plane(v));
        let view = |p| PlaneView { data: p, stride_bytes: format.width_px };
        let image = image_from_yuv(format, view(&y), view(&u), view(&v));
        [image.bgr()[0], image.bgr()[1], image.bgr()[2]]
    }

    fn format(matrix: Matrix, full_range: bool) -> YuvFormat {
        YuvFormat {
            width_px: 8,
            height_px: 4,
            chroma_shift_x: 1,
            chroma_shift_y: 1,
            chroma_left: true,
            matrix,
            full_range,
        }
    }

    #[test]
    fn standard_colours_come_out() {
        // BT.709 and BT.601 green as the standards' tables give them (limited range).
        for (matrix, y, u, v) in [(Matrix::Bt709, 173, 42, 26), (Matrix::Bt601, 145, 54, 34)] {
            let [b, g, r] = one_colour(&format(matrix, false), y, u, v);
            assert!(g > 252 && b < 3 && r < 3, "{matrix:?}: {b} {g} {r}");
        }
        assert_eq!(one_colour(&format(Matrix::Bt601, true), 128, 128, 128), [128, 128, 128]);
        assert_eq!(one_colour(&format(Matrix::Bt709, false), 235, 128, 128), [255, 255, 255]);
    }

    #[test]
    fn chroma_is_interpolated_at_its_place() {
        // A ramp sampled on every second column comes back as the ramp.
        let format = YuvFormat { chroma_shift_y: 0, ..format(Matrix::Bt601, true) };
        let u: Vec<u8> = (0..4).flat_map(|_| [100u8, 104, 108, 112]).collect();
        let mut row = vec![0; 8];
        chroma_row(&format, PlaneView { data: &u, stride_bytes: 4 }, 0, &mut row);
        assert_eq!(row, [100, 102, 104, 106, 108, 110, 112, 112]);
    }
}

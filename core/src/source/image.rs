//! The pixels of a frame: as the decoder gave them, and in the colours that the camera's encoder meant.

use std::sync::OnceLock;

/// The pixels of a frame, 8 bits a channel: kept as the source gave them, converted once and only where asked for.
///
/// A decoder's luma and chroma stay in the decoder's own buffers, since converting a full HD frame to colours costs
/// more than decoding it.
pub struct Image {
    width_px: u32,
    height_px: u32,
    given: Given,
    bgr: OnceLock<Vec<u8>>,
    yuv: OnceLock<OwnPlanes>,
}

/// What the source gave.
enum Given {
    /// Colours: they are in `Image::bgr`.
    Bgr,
    /// A decoder's frame with three planes.
    Yuv(YuvFormat, ffmpeg_the_third::frame::Video),
}

/// Luma and chroma that were made from colours.
struct OwnPlanes {
    format: YuvFormat,
    y: Vec<u8>,
    u: Vec<u8>,
    v: Vec<u8>,
}

impl Image {
    /// From `3 * width_px * height_px` bytes: blue, green, red, row by row without padding.
    ///
    /// # Panics
    /// With any other number of bytes.
    pub fn from_bgr(width_px: u32, height_px: u32, bgr: Vec<u8>) -> Image {
        assert_eq!(bgr.len(), 3 * width_px as usize * height_px as usize, "three bytes a pixel");
        Image { width_px, height_px, given: Given::Bgr, bgr: OnceLock::from(bgr), yuv: OnceLock::new() }
    }

    /// From a decoder's frame of three planes of 8 bits.
    pub(super) fn from_frame(format: YuvFormat, frame: ffmpeg_the_third::frame::Video) -> Image {
        Image {
            width_px: format.width_px as u32,
            height_px: format.height_px as u32,
            given: Given::Yuv(format, frame),
            bgr: OnceLock::new(),
            yuv: OnceLock::new(),
        }
    }

    /// Columns.
    pub fn width_px(&self) -> u32 {
        self.width_px
    }

    /// Rows.
    pub fn height_px(&self) -> u32 {
        self.height_px
    }

    /// Blue, green, red of each pixel, row by row without padding.
    pub fn bgr(&self) -> &[u8] {
        self.bgr.get_or_init(|| {
            let planes = self.yuv();
            bgr_from_yuv(&planes.format, planes.y, planes.u, planes.v)
        })
    }

    /// Blue, green, red of one pixel: from the colours where they are there already, else from its luma and the nearest
    /// chroma. `None` outside the image.
    pub fn bgr_at(&self, column: usize, row: usize) -> Option<[u8; 3]> {
        if column >= self.width_px as usize || row >= self.height_px as usize {
            return None;
        }
        if let Some(bgr) = self.bgr.get() {
            let at = 3 * (row * self.width_px as usize + column);
            return Some([bgr[at], bgr[at + 1], bgr[at + 2]]);
        }
        let [red, green, blue] = self.yuv().rgb(column, row);
        Some([blue, green, red])
    }

    /// The image with each `factor` by `factor` pixels as one, blue, green, red: for people to look at. What does not
    /// fill a whole pixel at the right and below is left out. Full-size colours are not made for it.
    pub fn shrunk_bgr(&self, factor: usize) -> Vec<u8> {
        let factor = factor.max(1);
        if let Some(bgr) = self.bgr.get() {
            return shrunk::<3>(bgr, self.width_px as usize, factor);
        }
        let yuv = self.yuv();
        let (width, height) = (yuv.width_px() / factor, yuv.height_px() / factor);
        let (shift_x, shift_y) = yuv.chroma_shifts();
        let mut bgr = Vec::with_capacity(3 * width * height);
        let mut sums = vec![0u32; width * factor];
        let area = (factor * factor) as u32;
        for row in 0..height {
            sums.fill(0);
            for k in 0..factor {
                let luma = &yuv.y.data[(row * factor + k) * yuv.y.stride_bytes..][..width * factor];
                sums.iter_mut().zip(luma).for_each(|(sum, value)| *sum += u32::from(*value));
            }
            let chroma_row = (row * factor + factor / 2) >> shift_y;
            for (column, block) in sums.chunks_exact(factor).enumerate() {
                let luma = (block.iter().sum::<u32>() + area / 2) / area;
                let at = (column * factor + factor / 2) >> shift_x;
                let (u, v) = (
                    yuv.u.data[chroma_row * yuv.u.stride_bytes + at],
                    yuv.v.data[chroma_row * yuv.v.stride_bytes + at],
                );
                bgr.extend(yuv.colours.bgr(luma as u8, u, v));
            }
        }
        bgr
    }

    /// As [`Image::shrunk_bgr`], as an image of its own.
    pub fn shrunk(&self, factor: usize) -> Image {
        let factor = factor.max(1);
        Image::from_bgr(self.width_px / factor as u32, self.height_px / factor as u32, self.shrunk_bgr(factor))
    }

    /// Luma and chroma as the decoder gave them; made from the colours where the source gave those.
    pub fn yuv(&self) -> Yuv<'_> {
        match &self.given {
            Given::Yuv(format, frame) => {
                let plane = |i| PlaneView { data: frame.data(i), stride_bytes: frame.stride(i) };
                Yuv { format: *format, colours: Coefficients::of(format), y: plane(0), u: plane(1), v: plane(2) }
            }
            Given::Bgr => {
                let own =
                    self.yuv.get_or_init(|| own_planes(self.width_px as usize, self.height_px as usize, self.bgr()));
                let width = own.format.width_px;
                let plane = |data, stride_bytes| PlaneView { data, stride_bytes };
                let chroma_width = width.div_ceil(2);
                Yuv {
                    format: own.format,
                    colours: Coefficients::of(&own.format),
                    y: plane(&own.y, width),
                    u: plane(&own.u, chroma_width),
                    v: plane(&own.v, chroma_width),
                }
            }
        }
    }
}

impl PartialEq for Image {
    /// The same size and colours, whatever the source gave them as.
    fn eq(&self, other: &Image) -> bool {
        (self.width_px, self.height_px) == (other.width_px, other.height_px) && self.bgr() == other.bgr()
    }
}

impl std::fmt::Debug for Image {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Image({}x{} px)", self.width_px, self.height_px)
    }
}

/// Luma and chroma of an image, 8 bits a sample.
#[derive(Clone, Copy)]
pub struct Yuv<'a> {
    format: YuvFormat,
    colours: Coefficients,
    y: PlaneView<'a>,
    u: PlaneView<'a>,
    v: PlaneView<'a>,
}

impl<'a> Yuv<'a> {
    /// Columns of the luma.
    pub fn width_px(&self) -> usize {
        self.format.width_px
    }

    /// Rows of the luma.
    pub fn height_px(&self) -> usize {
        self.format.height_px
    }

    /// The luma: gamma-encoded brightness.
    pub fn luma(&self) -> PlaneView<'a> {
        self.y
    }

    /// Blue and red difference, 128 where there is no colour; `height >> shifts.1` rows of `width >> shifts.0` samples
    /// (rounded up).
    pub fn chroma(&self) -> (PlaneView<'a>, PlaneView<'a>) {
        (self.u, self.v)
    }

    /// Luma samples per chroma sample along the columns and the rows, as shifts.
    pub fn chroma_shifts(&self) -> (u32, u32) {
        (self.format.chroma_shift_x, self.format.chroma_shift_y)
    }

    /// Light, 0 (black) to 1 (white), of each luma value: the camera's gamma undone (sRGB's curve). For a coloured
    /// pixel that is no exact light, but it rises with it and does not depend on the chroma's place.
    pub fn light(&self) -> &'static [f32; 256] {
        static FULL: OnceLock<[f32; 256]> = OnceLock::new();
        static LIMITED: OnceLock<[f32; 256]> = OnceLock::new();
        let table = |black: f32, white: f32| {
            std::array::from_fn(|i| {
                let value = ((i as f32 - black) / (white - black)).max(0.0);
                if value <= 0.04045 { value / 12.92 } else { ((value + 0.055) / 1.055).powf(2.4) }
            })
        };
        if self.format.full_range {
            FULL.get_or_init(|| table(0.0, 255.0))
        } else {
            LIMITED.get_or_init(|| table(16.0, 235.0))
        }
    }

    /// Red, green, blue of a pixel, with the chroma of the nearest sample.
    ///
    /// # Panics
    /// Outside the image.
    pub fn rgb(&self, column: usize, row: usize) -> [u8; 3] {
        let luma = self.y.data[row * self.y.stride_bytes + column];
        let at = |plane: &PlaneView| {
            plane.data
                [(row >> self.format.chroma_shift_y) * plane.stride_bytes + (column >> self.format.chroma_shift_x)]
        };
        let [blue, green, red] = self.colours.bgr(luma, at(&self.u), at(&self.v));
        [red, green, blue]
    }
}

/// Full-range BT.601 luma, and chroma of two by two pixels (as in a JPEG file), from colours.
fn own_planes(width: usize, height: usize, bgr: &[u8]) -> OwnPlanes {
    let format = YuvFormat {
        width_px: width,
        height_px: height,
        chroma_shift_x: 1,
        chroma_shift_y: 1,
        chroma_left: false,
        matrix: Matrix::Bt601,
        full_range: true,
    };
    let y = bgr
        .chunks_exact(3)
        .map(|p| ((7471 * u32::from(p[0]) + 38470 * u32::from(p[1]) + 19595 * u32::from(p[2]) + 32768) >> 16) as u8);
    let y: Vec<u8> = y.collect();
    let (chroma_width, chroma_height) = (width.div_ceil(2), height.div_ceil(2));
    let (mut u, mut v) = (Vec::with_capacity(chroma_width * chroma_height), Vec::new());
    for row in 0..chroma_height {
        for column in 0..chroma_width {
            let mut sum = [0.0_f32; 3];
            for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
                let (x, y) = ((2 * column + dx).min(width - 1), (2 * row + dy).min(height - 1));
                let at = 3 * (y * width + x);
                (0..3).for_each(|i| sum[i] += f32::from(bgr[at + i]) / 4.0);
            }
            let luma = 0.114 * sum[0] + 0.587 * sum[1] + 0.299 * sum[2];
            u.push((128.0 + (sum[0] - luma) / 1.772).round().clamp(0.0, 255.0) as u8);
            v.push((128.0 + (sum[2] - luma) / 1.402).round().clamp(0.0, 255.0) as u8);
        }
    }
    OwnPlanes { format, y, u, v }
}

/// Each pixel of the result is the mean of `factor` x `factor` pixels of `CHANNELS` bytes; what is left over at the
/// right and the bottom is cut off.
pub(crate) fn shrunk<const CHANNELS: usize>(pixels: &[u8], width: usize, factor: usize) -> Vec<u8> {
    if factor == 1 {
        return pixels.to_vec();
    }
    let columns = width / factor;
    let mut out = Vec::with_capacity(columns * CHANNELS * (pixels.len() / (width * CHANNELS) / factor));
    // Columns of `factor` pixels first, many at once; then their sums side by side. The division by the area is a
    // multiplication: it is exact for all sums that can occur, and several times faster.
    let area = (factor * factor) as u64;
    let reciprocal = (1u64 << 40).div_ceil(area);
    let mut sums = vec![0u16; width * CHANNELS];
    for rows in pixels.chunks_exact(width * CHANNELS * factor) {
        sums.fill(0);
        for row in rows.chunks_exact(width * CHANNELS) {
            sums.iter_mut().zip(row).for_each(|(sum, value)| *sum += u16::from(*value));
        }
        for block in sums.chunks_exact(CHANNELS * factor).take(columns) {
            let mut total = [area / 2; CHANNELS];
            for pixel in block.chunks_exact(CHANNELS) {
                total.iter_mut().zip(pixel).for_each(|(total, sum)| *total += u64::from(*sum));
            }
            out.extend(total.map(|total| ((total * reciprocal) >> 40) as u8));
        }
    }
    out
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
pub struct PlaneView<'a> {
    /// The samples, row by row.
    pub data: &'a [u8],
    /// Bytes from one row to the next.
    pub stride_bytes: usize,
}

/// Fixed-point coefficients (16 fractional bits) of the conversion to R'G'B'.
#[derive(Clone, Copy)]
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

    #[inline]
    fn bgr(&self, y: u8, u: u8, v: u8) -> [u8; 3] {
        let luma = (i32::from(y) - self.y_offset) * self.y + 32768;
        let (u, v) = (i32::from(u) - 128, i32::from(v) - 128);
        [
            ((luma + self.b_u * u) >> 16).clamp(0, 255) as u8,
            ((luma - self.g_u * u - self.g_v * v) >> 16).clamp(0, 255) as u8,
            ((luma + self.r_v * v) >> 16).clamp(0, 255) as u8,
        ]
    }
}

/// Converts a planar frame. Chroma is interpolated along the rows at its true place, since half a
/// pixel of colour shift would move the spot; between rows too where it is subsampled there.
fn bgr_from_yuv(format: &YuvFormat, y: PlaneView, u: PlaneView, v: PlaneView) -> Vec<u8> {
    let (width, height) = (format.width_px, format.height_px);
    let c = Coefficients::of(format);
    let mut bgr = vec![0u8; 3 * width * height];
    let (mut u_row, mut v_row) = (vec![0u8; width], vec![0u8; width]);
    for (row, out) in bgr.chunks_exact_mut(3 * width).enumerate() {
        chroma_row(format, u, row, &mut u_row);
        chroma_row(format, v, row, &mut v_row);
        let y_row = &y.data[row * y.stride_bytes..][..width];
        for (((bgr, y), u), v) in out.chunks_exact_mut(3).zip(y_row).zip(&u_row).zip(&v_row) {
            bgr.copy_from_slice(&c.bgr(*y, *u, *v));
        }
    }
    bgr
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
        let bgr = bgr_from_yuv(format, view(&y), view(&u), view(&v));
        [bgr[0], bgr[1], bgr[2]]
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

//! `depth.png`: the depth map as a 16-bit gray image, the form of the publication.
//!
//! 0 = not measured; 1..65535 = the run's smallest to largest depth, linearly. What the values mean and where
//! the image lies stands in its own text chunks: `min_mm`, `max_mm`, `x0_mm`, `y0_mm` (centre of the image's
//! first pixel), `mm_per_px`. Maps wider than [`MAX_PART_WIDTH_PX`](crate::export::parts::MAX_PART_WIDTH_PX)
//! become numbered parts with one common scale of depth.

use std::io::Write;
use std::path::Path;

use png::{BitDepth, ColorType, Compression, Encoder, PixelDimensions, Unit};

use crate::depth_map::{BAND_ROWS, MapGeometry, MapReader, TILE_SIDE_PX, band, rectangles};
use crate::error::{Error, Result};
use crate::export::manifest::GrayScale;
use crate::export::new_file::NewFile;
use crate::export::parts::{Part, parts};

/// Rows that are looked through at once.
const PIECE_ROWS: usize = 4096;

/// Writes `depth.png`, or `depth-0001.png` and so on, into `folder`.
///
/// Returns the depths that the gray values stand for; `None` where nothing was measured (the image is all 0).
///
/// # Errors
/// An empty map; what the reading of the map or the disk says.
pub fn write(map: &mut dyn MapReader, folder: &Path) -> Result<Option<GrayScale>> {
    let geometry = map.geometry();
    if geometry.width_px == 0 || geometry.height_px == 0 {
        return Err(Error::internal("depth.png", "an empty map"));
    }
    let scale = smallest_and_largest(map)?;
    for part in parts("depth", "png", geometry.width_px) {
        write_part(map, &folder.join(&part.name), &part, scale)?;
    }
    Ok(scale)
}

fn smallest_and_largest(map: &mut dyn MapReader) -> Result<Option<GrayScale>> {
    let geometry = map.geometry();
    let size_px = [geometry.width_px, geometry.height_px];
    let (mut min_mm, mut max_mm) = (f64::INFINITY, f64::NEG_INFINITY);
    for [column, row, width_px, height_px] in rectangles(size_px, [TILE_SIDE_PX, PIECE_ROWS]) {
        let window = map.window(column, row, width_px, height_px)?;
        for z_mm in window.depth_mm.into_iter().filter(|z| z.is_finite()) {
            (min_mm, max_mm) = (min_mm.min(f64::from(z_mm)), max_mm.max(f64::from(z_mm)));
        }
    }
    Ok((min_mm <= max_mm).then_some(GrayScale { min_mm, max_mm }))
}

fn write_part(map: &mut dyn MapReader, path: &Path, part: &Part, scale: Option<GrayScale>) -> Result<()> {
    let geometry = map.geometry();
    let refused = |e: png::EncodingError| Error::io(path, e.into());
    let mut file = NewFile::create(path)?;
    let mut encoder = Encoder::new(&mut file, part.width_px as u32, geometry.height_px as u32);
    encoder.set_color(ColorType::Grayscale);
    encoder.set_depth(BitDepth::Sixteen);
    encoder.set_compression(Compression::Fast);
    encoder.set_pixel_dims(pixels_per_metre(geometry.mm_per_px));
    for (key, value) in texts(&geometry, part, scale) {
        encoder.add_text_chunk(key.into(), value).map_err(refused)?;
    }
    let mut writer = encoder.write_header().map_err(refused)?;
    let mut stream = writer.stream_writer().map_err(refused)?;
    for row in (0..geometry.height_px).step_by(BAND_ROWS) {
        let pixels = band(map, part.columns(), row, [0; 2], |z_mm, _| gray(z_mm, scale).to_be_bytes())?;
        stream.write_all(pixels.as_flattened()).map_err(|e| Error::io(path, e))?;
    }
    stream.finish().map_err(refused)?;
    writer.finish().map_err(refused)?;
    file.commit()
}

/// The gray value of a depth.
fn gray(z_mm: f32, scale: Option<GrayScale>) -> u16 {
    match scale {
        Some(scale) if z_mm.is_finite() => {
            let span_mm = scale.max_mm - scale.min_mm;
            let share = if span_mm > 0.0 { (f64::from(z_mm) - scale.min_mm) / span_mm } else { 0.0 };
            1 + (share * 65_534.0).round() as u16
        }
        _ => 0,
    }
}

fn texts(geometry: &MapGeometry, part: &Part, scale: Option<GrayScale>) -> Vec<(&'static str, String)> {
    let x0_mm = geometry.x0_mm + part.first_column_px as f64 * geometry.mm_per_px;
    let mut texts = vec![
        ("Software", concat!("stria ", env!("CARGO_PKG_VERSION")).into()),
        ("Description", "Depth map. 0 = not measured; z_mm = min_mm + (value - 1) * (max_mm - min_mm) / 65534".into()),
        ("x0_mm", x0_mm.to_string()),
        ("y0_mm", geometry.y0_mm.to_string()),
        ("mm_per_px", geometry.mm_per_px.to_string()),
    ];
    if let Some(scale) = scale {
        texts.push(("min_mm", scale.min_mm.to_string()));
        texts.push(("max_mm", scale.max_mm.to_string()));
    }
    texts
}

/// PNG's own size of a pixel, where its whole numbers hold it.
fn pixels_per_metre(mm_per_px: f64) -> Option<PixelDimensions> {
    let per_metre = (1000.0 / mm_per_px).round();
    (1.0..=f64::from(u32::MAX)).contains(&per_metre).then_some(PixelDimensions {
        xppu: per_metre as u32,
        yppu: per_metre as u32,
        unit: Unit::Meter,
    })
}

#[cfg(test)]
mod tests {
    use std::collections::HashMap;
    use std::fs::File;
    use std::io::BufReader;

    use super::*;
    use crate::depth_map::GridMap;

    struct Read {
        width_px: u32,
        values: Vec<u16>,
        texts: HashMap<String, String>,
    }

    fn read(path: &Path) -> Read {
        let file = BufReader::new(File::open(path).expect("open"));
        let mut reader = png::Decoder::new(file).read_info().expect("a PNG");
        let mut bytes = vec![0; reader.output_buffer_size().expect("size")];
        reader.next_frame(&mut bytes).expect("pixels");
        let info = reader.info();
        assert_eq!((info.color_type, info.bit_depth), (ColorType::Grayscale, BitDepth::Sixteen));
        let texts =
            info.uncompressed_latin1_text.iter().map(|chunk| (chunk.keyword.clone(), chunk.text.clone())).collect();
        let values = bytes.chunks_exact(2).map(|b| u16::from_be_bytes([b[0], b[1]])).collect();
        Read { width_px: info.width, values, texts }
    }

    fn geometry(width_px: usize, height_px: usize) -> MapGeometry {
        MapGeometry { x0_mm: -12.5, y0_mm: 3.0, mm_per_px: 0.5, width_px, height_px }
    }

    #[test]
    fn depths_come_back_to_half_a_gray_step() {
        let folder = tempfile::tempdir().expect("temporary folder");
        let z =
            |c: usize, r: usize| if (c + r).is_multiple_of(7) { f32::NAN } else { 800.0 + (c * 3 + r) as f32 * 0.37 };
        let mut map = GridMap::from_fn(geometry(300, 280), |c, r| (z(c, r), None));
        let scale = write(&mut map, folder.path()).expect("write").expect("measured");
        let image = read(&folder.path().join("depth.png"));
        let step_mm = (scale.max_mm - scale.min_mm) / 65_534.0;
        for (i, value) in image.values.iter().enumerate() {
            let truth = z(i % 300, i / 300);
            if truth.is_nan() {
                assert_eq!(*value, 0);
            } else {
                let z_mm = scale.min_mm + f64::from(value - 1) * step_mm;
                assert!((z_mm - f64::from(truth)).abs() <= 0.51 * step_mm);
            }
        }
        assert_eq!((image.values.iter().max(), image.texts["x0_mm"].as_str()), (Some(&65_535), "-12.5"));
        assert_eq!(image.texts["min_mm"].parse::<f64>().expect("number"), scale.min_mm);
    }

    #[test]
    fn a_wide_map_becomes_parts_with_one_scale() {
        let folder = tempfile::tempdir().expect("temporary folder");
        let mut map = GridMap::from_fn(geometry(40_000, 3), |c, _| (c as f32, None));
        write(&mut map, folder.path()).expect("write");
        let (left, right) = (read(&folder.path().join("depth-0001.png")), read(&folder.path().join("depth-0002.png")));
        assert_eq!((left.width_px, right.width_px), (32_768, 40_000 - 32_768));
        assert!(left.values[32_767] < right.values[0]);
        assert_eq!(right.texts["x0_mm"], (-12.5 + 32_768.0 * 0.5).to_string());
        assert_eq!(left.texts["max_mm"], right.texts["max_mm"]);
    }

    #[test]
    fn nothing_measured_and_one_depth_only() {
        let folder = tempfile::tempdir().expect("temporary folder");
        let mut nothing = GridMap::from_fn(geometry(4, 4), |_, _| (f32::NAN, None));
        assert_eq!(write(&mut nothing, folder.path()).expect("write"), None);
        assert!(read(&folder.path().join("depth.png")).values.iter().all(|v| *v == 0));
        let mut flat = GridMap::from_fn(geometry(4, 4), |_, _| (850.0, None));
        write(&mut flat, folder.path()).expect("write");
        assert!(read(&folder.path().join("depth.png")).values.iter().all(|v| *v == 1));
    }
}

use std::fs::File;
use std::io::BufReader;

use super::*;
use crate::depth_map::{GridMap, MapGeometry};

fn read(path: &Path) -> (usize, usize, Vec<[u8; 3]>) {
    let mut reader = png::Decoder::new(BufReader::new(File::open(path).expect("open"))).read_info().expect("a PNG");
    let mut bytes = vec![0; reader.output_buffer_size().expect("size")];
    reader.next_frame(&mut bytes).expect("pixels");
    let (width, height) = (reader.info().width as usize, reader.info().height as usize);
    (width, height, bytes.chunks_exact(3).map(|c| [c[0], c[1], c[2]]).collect())
}

fn geometry(width_px: usize, height_px: usize) -> MapGeometry {
    MapGeometry { x0_mm: 0.0, y0_mm: 0.0, mm_per_px: 1.0, width_px, height_px }
}

fn luma(c: [u8; 3]) -> f64 {
    0.2126 * f64::from(c[0]) + 0.7152 * f64::from(c[1]) + 0.0722 * f64::from(c[2])
}

#[test]
fn near_is_light_far_is_dark_and_holes_are_hatched() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let path = folder.path().join("preview.png");
    let mut map = GridMap::from_fn(geometry(900, 400), |c, _| match c {
        0..300 => (800.0, None),
        300..600 => (f32::NAN, None),
        _ => (850.0, None),
    });
    picture(&mut map, &PreviewText::default()).expect("picture").save(&path).expect("write");
    let (width, height, pixels) = read(&path);
    assert!(width <= 2000 && height <= 2000, "{width} x {height}");
    let layout = Layout::of(&map.geometry());
    let row = layout.strip_top_px(0) + layout.strip_height_px / 2;
    let at =
        |share: f64| pixels[row * width + layout.strip_left_px() + (layout.strip_width_px as f64 * share) as usize];
    let hole = at(0.5);
    assert!(luma(at(0.15)) > luma(at(0.85)) + 80.0);
    assert!(hole.iter().max().expect("three") - hole.iter().min().expect("three") < 12, "gray, not {hole:?}");
}

#[test]
fn a_dent_is_dark_on_the_side_of_the_light() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let path = folder.path().join("preview.png");
    let mut map = GridMap::from_fn(geometry(900, 600), |c, r| {
        let squared = (c as f32 - 450.0).powi(2) + (r as f32 - 300.0).powi(2);
        (850.0 + 3.0 * (-squared / (2.0 * 40.0_f32.powi(2))).exp(), None)
    });
    picture(&mut map, &PreviewText::default()).expect("picture").save(&path).expect("write");
    let (width, _, pixels) = read(&path);
    let layout = Layout::of(&map.geometry());
    let at = |c: f64, r: f64| {
        let (x, y) = (c / layout.mm_per_px, r / layout.mm_per_px);
        luma(pixels[(layout.strip_top_px(0) + y as usize) * width + layout.strip_left_px() + x as usize])
    };
    assert!(at(450.0 - 30.0, 300.0 - 30.0) + 25.0 < at(450.0 + 30.0, 300.0 + 30.0));
}

#[test]
fn any_size_and_an_unmeasured_map_give_a_picture() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let path = folder.path().join("preview.png");
    for (width, height) in [(1, 1), (2, 900), (60_000, 300), (700, 500)] {
        let mut map = GridMap::from_fn(geometry(width, height), |_, _| (f32::NAN, None));
        let text = PreviewText { title: "х".repeat(300), ..PreviewText::default() };
        picture(&mut map, &text).expect("picture").save(&path).expect("write");
        assert!(read(&path).0 <= 2000);
    }
}

//! The wall as a textured mesh in binary glTF 2.0, for browsers, office programs and model viewers.
//!
//! Metres, glTF's axes: x along the travel, y up, z out of the wall towards the camera. Every pixel of the map's size
//! that fits is a vertex; where nothing was measured there is a hole. The texture comes from the tiles and is a JPEG
//! inside the file.

use std::ops::RangeInclusive;
use std::path::Path;

use jpeg_encoder::{ColorType, Encoder};
use serde_json::json;

use crate::depth_map::MapGeometry;
use crate::error::{Error, Result};
use crate::export::depth_tif::{LevelDepths, level_of_at_most};
use crate::export::new_file::NewFile;
use crate::export::tiles::{TileLevel, TilesIndex};

/// Vertices when nothing is said: about 40 MB.
pub const DEFAULT_VERTICES: usize = 600_000;
/// More than these no viewer is asked to take.
pub const MAX_VERTICES: usize = 20_000_000;
/// Longest side of the texture, px: what every browser shows.
const TEXTURE_SIDE_PX: usize = 4096;
const JPEG_QUALITY: u8 = 88;
/// A vertex before its first triangle has no number.
const NONE: u32 = u32::MAX;

/// What was written.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MeshFacts {
    /// Vertices.
    pub vertices: usize,
    /// Triangles.
    pub triangles: usize,
    /// Distance of two neighbours, mm.
    pub mm_per_vertex: f64,
    /// Whether it has the wall's picture.
    pub textured: bool,
}

/// All of the way.
pub const ALL_MM: RangeInclusive<f64> = f64::NEG_INFINITY..=f64::INFINITY;

/// Writes the mesh of a stretch of a product folder's map, world x in mm, with at most about so many vertices.
///
/// # Errors
/// A folder without a map, a damaged one, a stretch without a surface; a full disk.
pub fn write(path: &Path, product_folder: &Path, vertices: usize, x_mm: &RangeInclusive<f64>) -> Result<MeshFacts> {
    let map_path = product_folder.join("depth.tif");
    let level = level_of_at_most(&map_path, vertices, x_mm)?;
    let mesh = Mesh::of(&level);
    if mesh.indices.is_empty() {
        return Err(Error::input(map_path.display().to_string(), "no surface in it", "a map with measured neighbours"));
    }
    let texture = Texture::read(product_folder, x_mm)?;
    let facts = MeshFacts {
        vertices: mesh.pixels.len(),
        triangles: mesh.indices.len() / 3,
        mm_per_vertex: level.geometry.mm_per_px,
        textured: texture.is_some(),
    };
    let bytes = glb(&level, &mesh, texture.as_ref())?;
    let mut file = NewFile::create(path)?;
    file.put(&bytes)?;
    file.commit()?;
    Ok(facts)
}

/// Which pixels are vertices, and how they hang together.
struct Mesh {
    /// Place of each vertex' pixel.
    pixels: Vec<u32>,
    indices: Vec<u32>,
}

impl Mesh {
    fn of(level: &LevelDepths) -> Mesh {
        let (width, height) = (level.geometry.width_px, level.geometry.height_px);
        let mut mesh = Mesh { pixels: Vec::new(), indices: Vec::new() };
        let mut numbers = vec![NONE; width * height];
        for row in 0..height.saturating_sub(1) {
            for column in 0..width.saturating_sub(1) {
                let a = row * width + column;
                // Around the square as seen from the camera: right, down, left.
                let corners = [a, a + 1, a + width + 1, a + width];
                let there: Vec<usize> = corners.into_iter().filter(|i| level.depth_mm[*i].is_finite()).collect();
                // Counter-clockwise from the front, where y is up.
                match there[..] {
                    [a, b, c, d] => {
                        mesh.triangle(&mut numbers, [a, c, b]);
                        mesh.triangle(&mut numbers, [a, d, c]);
                    }
                    [a, b, c] => mesh.triangle(&mut numbers, [a, c, b]),
                    _ => {}
                }
            }
        }
        mesh
    }

    fn triangle(&mut self, numbers: &mut [u32], corners: [usize; 3]) {
        for corner in corners {
            if numbers[corner] == NONE {
                numbers[corner] = self.pixels.len() as u32;
                self.pixels.push(corner as u32);
            }
            self.indices.push(numbers[corner]);
        }
    }
}

/// The wall's picture over whole tiles.
struct Texture {
    jpeg: Vec<u8>,
    geometry: MapGeometry,
}

impl Texture {
    /// The largest level of the tiles that is small enough, as far as it shows a stretch; `None` in a folder without tiles.
    fn read(product_folder: &Path, x_mm: &RangeInclusive<f64>) -> Result<Option<Texture>> {
        if !product_folder.join("tiles/tiles.json").exists() {
            return Ok(None);
        }
        let index = TilesIndex::load(product_folder)?;
        let side = index.tile_side_px;
        let across = |first: i64, last: i64| (last - first + 1).max(0) as usize * side;
        // The tiles of a level that a stretch touches, and one more where it ends just between two.
        let within = |level: &TileLevel| {
            let column = |x_mm: f64| (x_mm - index.grid.x0_mm) / (level.mm_per_px * side as f64);
            TileLevel {
                first_column: level.first_column.max((column(*x_mm.start()) - 0.01).floor() as i64),
                last_column: level.last_column.min((column(*x_mm.end()) + 0.01).floor() as i64),
                ..*level
            }
        };
        let size = |level: &TileLevel| {
            (across(level.first_column, level.last_column), across(level.first_row, level.last_row))
        };
        let fits = |level: &TileLevel| {
            let (width, height) = size(level);
            (1..=TEXTURE_SIDE_PX).contains(&width) && (1..=TEXTURE_SIDE_PX).contains(&height)
        };
        let Some(level) = index.levels.iter().map(within).find(fits) else { return Ok(None) };
        let (width_px, height_px) = size(&level);
        let mut rgb = vec![128; 3 * width_px * height_px];
        for row in level.first_row..=level.last_row {
            for column in level.first_column..=level.last_column {
                let path = product_folder.join(format!("tiles/texture/{}/{column}_{row}.jpg", level.level));
                let left = (column - level.first_column) as usize * side;
                let top = (row - level.first_row) as usize * side;
                let tile = decoded_jpeg(&path, side)?;
                for (y, from) in tile.chunks_exact(3 * side).enumerate() {
                    rgb[3 * ((top + y) * width_px + left)..][..3 * side].copy_from_slice(from);
                }
            }
        }
        let mut jpeg = Vec::new();
        Encoder::new(&mut jpeg, JPEG_QUALITY)
            .encode(&rgb, width_px as u16, height_px as u16, ColorType::Rgb)
            .map_err(|e| Error::internal("texture", e))?;
        // A pixel of a level is the middle of the pixels that it is made of.
        let shift = (level.mm_per_px / index.grid.mm_per_px - 1.0) / 2.0 * index.grid.mm_per_px;
        let geometry = MapGeometry {
            x0_mm: index.grid.x0_mm + (level.first_column * side as i64) as f64 * level.mm_per_px + shift,
            y0_mm: index.grid.y0_mm + (level.first_row * side as i64) as f64 * level.mm_per_px + shift,
            mm_per_px: level.mm_per_px,
            width_px,
            height_px,
        };
        Ok(Some(Texture { jpeg, geometry }))
    }
}

fn decoded_jpeg(path: &Path, side: usize) -> Result<Vec<u8>> {
    let bytes = std::fs::read(path).map_err(|e| Error::io(path, e))?;
    let bad = |what: String| Error::input(path.display().to_string(), what, format!("a tile of {side} px"));
    let mut decoder = zune_jpeg::JpegDecoder::new(std::io::Cursor::new(bytes));
    let pixels = decoder.decode().map_err(|e| bad(e.to_string()))?;
    if pixels.len() != 3 * side * side {
        return Err(bad(format!("{} values", pixels.len())));
    }
    Ok(pixels)
}

/// Where the parts of the binary chunk lie.
#[derive(Default)]
struct Binary {
    bytes: Vec<u8>,
    views: Vec<serde_json::Value>,
}

impl Binary {
    /// Adds a part; `target` 34962 are vertices, 34963 indices. Says which part it is.
    fn add(&mut self, bytes: impl IntoIterator<Item = u8>, target: Option<u32>) -> usize {
        let start = self.bytes.len();
        self.bytes.extend(bytes);
        let mut view = json!({"buffer": 0, "byteOffset": start, "byteLength": self.bytes.len() - start});
        if let Some(target) = target {
            view["target"] = target.into();
        }
        self.bytes.resize(self.bytes.len().next_multiple_of(4), 0);
        self.views.push(view);
        self.views.len() - 1
    }
}

const VERTICES: Option<u32> = Some(34_962);
const INDICES: Option<u32> = Some(34_963);
const FLOAT: u32 = 5126;
const UNSIGNED_INT: u32 = 5125;

fn glb(level: &LevelDepths, mesh: &Mesh, texture: Option<&Texture>) -> Result<Vec<u8>> {
    let shape = Shape { level, middle_mm: middle(level, mesh) };
    let mut binary = Binary::default();
    let positions: Vec<[f32; 3]> = mesh.pixels.iter().map(|pixel| shape.position_m(*pixel as usize)).collect();
    let (low, high) = bounds(&positions);
    let position = binary.add(positions.iter().flatten().flat_map(|v| v.to_le_bytes()), VERTICES);
    let normals = mesh.pixels.iter().flat_map(|pixel| shape.normal(*pixel as usize));
    let normal = binary.add(normals.flat_map(|v| v.to_le_bytes()), VERTICES);
    let count = mesh.pixels.len();
    let mut accessors = vec![
        json!({"bufferView": position, "componentType": FLOAT, "count": count, "type": "VEC3", "min": low, "max": high}),
        json!({"bufferView": normal, "componentType": FLOAT, "count": count, "type": "VEC3"}),
    ];
    let mut attributes = json!({"POSITION": 0, "NORMAL": 1});
    if let Some(texture) = texture {
        let places = mesh.pixels.iter().flat_map(|pixel| shape.texture_place(*pixel as usize, &texture.geometry));
        let place = binary.add(places.flat_map(|v| v.to_le_bytes()), VERTICES);
        attributes["TEXCOORD_0"] = accessors.len().into();
        accessors.push(json!({"bufferView": place, "componentType": FLOAT, "count": count, "type": "VEC2"}));
    }
    let indices = binary.add(mesh.indices.iter().flat_map(|i| i.to_le_bytes()), INDICES);
    let (numbers, indices_at) = (mesh.indices.len(), accessors.len());
    accessors.push(json!({"bufferView": indices, "componentType": UNSIGNED_INT, "count": numbers, "type": "SCALAR"}));
    let mut surface = json!({"metallicFactor": 0.0, "roughnessFactor": 0.9});
    let mut document = json!({
        "asset": {"version": "2.0", "generator": concat!("stria ", env!("CARGO_PKG_VERSION"))},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "wall", "translation": shape.middle_m()}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": indices_at, "material": 0}]}],
        "accessors": accessors,
    });
    if let Some(texture) = texture {
        let image = binary.add(texture.jpeg.iter().copied(), None);
        surface["baseColorTexture"] = json!({"index": 0});
        document["images"] = json!([{"bufferView": image, "mimeType": "image/jpeg"}]);
        document["samplers"] = json!([{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}]);
        document["textures"] = json!([{"source": 0, "sampler": 0}]);
    }
    document["materials"] = json!([{"name": "wall", "doubleSided": true, "pbrMetallicRoughness": surface}]);
    document["bufferViews"] = binary.views.into();
    document["buffers"] = json!([{"byteLength": binary.bytes.len()}]);
    chunks(&document, &binary.bytes)
}

/// The container: a head, the JSON, the binary part.
fn chunks(document: &serde_json::Value, binary: &[u8]) -> Result<Vec<u8>> {
    let mut text = serde_json::to_vec(document).map_err(|e| Error::internal("glTF", e))?;
    text.resize(text.len().next_multiple_of(4), b' ');
    let total = 12 + 8 + text.len() + 8 + binary.len();
    let size = |bytes: usize| {
        u32::try_from(bytes).map(u32::to_le_bytes).map_err(|_| {
            Error::input("the mesh", format!("{bytes} bytes"), "at most 4 GB: fewer vertices with --max-vertices")
        })
    };
    let mut all = Vec::with_capacity(total);
    all.extend(b"glTF");
    all.extend(2_u32.to_le_bytes());
    all.extend(size(total)?);
    all.extend(size(text.len())?);
    all.extend(b"JSON");
    all.extend(text);
    all.extend(size(binary.len())?);
    all.extend(b"BIN\0");
    all.extend(binary);
    Ok(all)
}

/// The surface with its middle, from which the vertices count so that their float32 stays exact.
struct Shape<'a> {
    level: &'a LevelDepths,
    middle_mm: [f64; 3],
}

impl Shape<'_> {
    fn world_mm(&self, pixel: usize) -> [f64; 3] {
        let map = &self.level.geometry;
        let (column, row) = (pixel % map.width_px, pixel / map.width_px);
        let z_mm = f64::from(self.level.depth_mm[pixel]);
        [map.x0_mm + column as f64 * map.mm_per_px, map.y0_mm + row as f64 * map.mm_per_px, z_mm]
    }

    fn position_m(&self, pixel: usize) -> [f32; 3] {
        let world_mm = self.world_mm(pixel);
        gltf_axes([0, 1, 2].map(|axis| (world_mm[axis] - self.middle_mm[axis]) / 1000.0)).map(|v| v as f32)
    }

    fn middle_m(&self) -> [f64; 3] {
        gltf_axes(self.middle_mm.map(|v| v / 1000.0))
    }

    /// Out of the wall, from the slopes between the neighbours that were measured.
    fn normal(&self, pixel: usize) -> [f32; 3] {
        let map = &self.level.geometry;
        let (column, row) = (pixel % map.width_px, pixel / map.width_px);
        let z =
            |there: bool, at: usize| there.then(|| f64::from(self.level.depth_mm[at])).filter(|z_mm| z_mm.is_finite());
        let here = f64::from(self.level.depth_mm[pixel]);
        let slope = |before: Option<f64>, after: Option<f64>| {
            let steps = f64::from(u8::from(before.is_some()) + u8::from(after.is_some())).max(1.0);
            (after.unwrap_or(here) - before.unwrap_or(here)) / (steps * map.mm_per_px)
        };
        let along = slope(z(column > 0, pixel.wrapping_sub(1)), z(column + 1 < map.width_px, pixel + 1));
        let down =
            slope(z(row > 0, pixel.wrapping_sub(map.width_px)), z(row + 1 < map.height_px, pixel + map.width_px));
        let length = (along * along + down * down + 1.0).sqrt();
        gltf_axes([along / length, down / length, -1.0 / length]).map(|v| v as f32)
    }

    /// Where the texture shows a vertex: 0 to 1 from the left and from the top.
    fn texture_place(&self, pixel: usize, texture: &MapGeometry) -> [f32; 2] {
        let [x_mm, y_mm, _] = self.world_mm(pixel);
        let column = (x_mm - texture.x0_mm) / texture.mm_per_px + 0.5;
        let row = (y_mm - texture.y0_mm) / texture.mm_per_px + 0.5;
        [(column / texture.width_px as f64) as f32, (row / texture.height_px as f64) as f32]
    }
}

/// World axes (y down, z into the wall) → glTF's (y up, z towards who looks).
fn gltf_axes([x, y, z]: [f64; 3]) -> [f64; 3] {
    [x, -y, -z]
}

fn middle(level: &LevelDepths, mesh: &Mesh) -> [f64; 3] {
    let map = &level.geometry;
    let depths = mesh.pixels.iter().map(|pixel| f64::from(level.depth_mm[*pixel as usize]));
    let z_mm = depths.sum::<f64>() / mesh.pixels.len() as f64;
    let half = |size: usize| (size / 2) as f64 * map.mm_per_px;
    // Whole millimetres: people read them.
    [map.x0_mm + half(map.width_px), map.y0_mm + half(map.height_px), z_mm].map(f64::round)
}

fn bounds(positions: &[[f32; 3]]) -> ([f32; 3], [f32; 3]) {
    positions.iter().fold(([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]), |(low, high), position| {
        ([0, 1, 2].map(|i| low[i].min(position[i])), [0, 1, 2].map(|i| high[i].max(position[i])))
    })
}

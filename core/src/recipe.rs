//! Every tunable of the processing in one table: unit, default, range and reason.
//!
//! A recipe is read from TOML (or a built-in name), changed with `--set key=value`, checked, and kept
//! with every result. Unknown keys are refused.

mod codes;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::error::{Error, Result};
use crate::motion::track::TrackUse;
use crate::stripe::SpotChoice;

pub use codes::Codes;

/// The severities of defects, the mildest first.
pub const SEVERITIES: [&str; 3] = ["minor", "moderate", "severe"];

/// The built-in recipes, the default first.
pub const BUILT_IN: [&str; 3] = ["metric", "paper", "paper-literal"];

/// What values an option takes.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum Range {
    /// A number between two limits, both included.
    Number {
        /// Smallest value.
        min: f64,
        /// Largest value.
        max: f64,
        /// True where only whole numbers make sense.
        whole: bool,
    },
    /// True or false.
    Flag,
    /// One of a few words.
    Choice {
        /// The words.
        of: Vec<&'static str>,
    },
    /// Words.
    Text {
        /// Most characters.
        max_chars: usize,
    },
}

/// One tunable, as `/api/options` and `--help` show it.
#[derive(Clone, Debug, Serialize)]
pub struct OptionInfo {
    /// Dotted key, as in TOML and `--set`.
    pub key: &'static str,
    /// Unit of the value; empty where it has none.
    pub unit: &'static str,
    /// Value when nothing is said.
    pub default: Value,
    /// What values it takes.
    pub range: Range,
    /// What it does and why one would change it.
    pub doc: String,
}

/// The way a run is measured.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Method {
    /// Everything in millimetres: calibrated light, full 3D poses, a metric grid.
    #[default]
    Metric,
    /// The publication, step by step (METHOD.md).
    Paper,
}

fn number(min: f64, max: f64) -> Range {
    Range::Number { min, max, whole: false }
}

fn whole(min: u32, max: u32) -> Range {
    Range::Number { min: f64::from(min), max: f64::from(max), whole: true }
}

fn choice(of: &[&'static str]) -> Range {
    Range::Choice { of: of.to_vec() }
}

fn text(max_chars: usize) -> Range {
    Range::Text { max_chars }
}

fn flag() -> Range {
    Range::Flag
}

macro_rules! recipe {
    ($($(#[doc = $group_doc:literal])* $group:ident: $Group:ident {
        $($(#[doc = $doc:literal])* $key:ident: $type:ty = $default:expr, $unit:literal, $range:expr;)*
    })*) => {
        $(
            $(#[doc = $group_doc])*
            #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
            #[serde(default, deny_unknown_fields)]
            pub struct $Group { $($(#[doc = $doc])* pub $key: $type,)* }

            impl Default for $Group {
                fn default() -> Self {
                    $Group { $($key: $default,)* }
                }
            }
        )*

        /// Every tunable of one processing.
        #[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
        #[serde(default, deny_unknown_fields)]
        pub struct Recipe {
            /// The way the run is measured.
            pub method: Method,
            $($(#[doc = $group_doc])* pub $group: $Group,)*
        }

        /// All options, in the order of the stages.
        pub fn options() -> Vec<OptionInfo> {
            let defaults = Recipe::default();
            vec![$($(OptionInfo {
                key: concat!(stringify!($group), ".", stringify!($key)),
                unit: $unit,
                default: serde_json::to_value(&defaults.$group.$key).unwrap_or(Value::Null),
                range: $range,
                doc: [$($doc.trim()),*].join(" "),
            },)*)*]
        }

        impl Recipe {
            fn value_of(&self, key: &str) -> Option<Value> {
                match key {
                    $($(concat!(stringify!($group), ".", stringify!($key)) =>
                        serde_json::to_value(&self.$group.$key).ok(),)*)*
                    _ => None,
                }
            }

            fn put(&mut self, key: &str, value: Value) -> std::result::Result<(), serde_json::Error> {
                match key {
                    $($(concat!(stringify!($group), ".", stringify!($key)) => {
                        self.$group.$key = serde_json::from_value(value)?;
                    })*)*
                    _ => {}
                }
                Ok(())
            }
        }
    };
}

recipe! {
    /// How the laser line is found in a frame (method `metric`).
    spot: SpotOptions {
        /// Which of several spots in a row is the line: the one that continues the line (default), the strongest, or
        /// the first or last across the image.
        choice: SpotChoice = SpotChoice::Continuous, "", choice(&["continuous", "strongest", "first", "last"]);
        /// Least difference between the line's colour and its surroundings, chroma levels. Lower finds fainter lines,
        /// and more of other lights.
        evidence_min: f64 = 2.5, "of 255", number(0.1, 128.0);
        /// Least brightness of a spot above its surroundings, as a share of full light on a dark wall; more on a bright one.
        contrast_min: f64 = 6.0, "of 255", number(0.0, 255.0);
        /// Shortest continuous piece of the line that is believed.
        piece_min_rows: u32 = 12, "rows", whole(1, 1000);
        /// Divide the line's light by the same strip of wall as another frame saw it without the laser.
        wall_reference: bool = true, "", flag();
        /// Change of the line's slope from one row to the next that the smoothing along the line expects. Smaller is
        /// smoother; a very rough wall wants more.
        bend_px: f64 = 0.004, "px a row", number(0.00001, 1.0);
        /// Rows that are less sure than this are left out.
        sigma_max_px: f64 = 1.0, "px", number(0.01, 100.0);
    }
    /// How the camera's pose is found (method `metric`).
    pose: PoseOptions {
        /// Places on the wall that are followed, about; one per cell of a grid over the image.
        landmarks: u32 = 100, "", whole(12, 2000);
        /// Least texture of such a place: the weaker direction's mean squared slope of the luma.
        texture_min: f64 = 0.15, "levels² a px²", number(0.0, 10000.0);
        /// Travel of the image from one key frame to the next, as a share of its width.
        keyframe_share: f64 = 0.1, "of the width", number(0.01, 0.5);
        /// Key frames whose poses are still adjusted together; each frame waits until its key frames are settled.
        window: u32 = 5, "key frames", whole(2, 30);
        /// Most frames that wait for that: a robot that stands still must not fill the memory.
        waiting_max: u32 = 600, "frames", whole(2, 10000);
        /// Frames without motion found, one after the other, after which the way is taken to be broken.
        lost_max: u32 = 15, "frames", whole(1, 1000);
        /// What poses given with the source (`--poses`) are for: they are the camera's poses instead of the image's
        /// motion, or only the prior that says where to look for it and carries the pose on where it is lost.
        track: TrackUse = TrackUse::Instead, "", choice(&["instead", "prior"]);
    }
    /// How the laser line is found in a frame (method `paper`; METHOD.md, "Spot centroid").
    stripe: StripeOptions {
        /// Moves the laser colour's hue range (green 50 to 100, red 170 to 10, blue 100 to 130; OpenCV's half
        /// degrees). Change it for a laser of unusual wavelength or a camera with a strong tint.
        hue_shift: f64 = 0.0, "OpenCV hue", number(-90.0, 90.0);
        /// Widens the hue range about its middle. Wider finds the line on tinted walls, and more of other lights.
        hue_widening: f64 = 1.0, "times", number(0.1, 6.0);
        /// Least saturation of a pixel of the laser's colour.
        saturation_min: f64 = 70.0, "of 255", number(0.0, 255.0);
        /// Least brightness (HSV value) of a pixel of the laser's colour.
        value_min: f64 = 60.0, "of 255", number(0.0, 255.0);
        /// Width of the dilation that joins the two coloured fringes over a clipped white core.
        dilate_width_px: u32 = 30, "px", whole(1, 400);
        /// Height of that dilation.
        dilate_height_px: u32 = 1, "px", whole(1, 400);
        /// Width of the erosion that shrinks the area. Wider than the dilation plus the line, it removes the line.
        erode_width_px: u32 = 20, "px", whole(1, 400);
        /// Height of that erosion: coloured areas shorter than this along the line are dropped.
        erode_height_px: u32 = 50, "px", whole(1, 400);
        /// Give the surviving area the height back that the erosion took from its ends (an opening along the
        /// line), so that a line keeps its rows next to a gap.
        restore_height: bool = true, "", flag();
        /// K of equation (9): the row's threshold between its average (0) and its maximum (1).
        k: f64 = 0.9, "", number(0.5, 0.99);
        /// Least height of the row's maximum above its average: below it there is no spot.
        contrast_min: f64 = 8.0, "of 255", number(0.0, 255.0);
        /// Shortest continuous piece of the line that is believed: shorter ones are other lights or noise.
        piece_min_rows: u32 = 12, "rows", whole(1, 1000);
        /// Write the stripes of every frame to `stripes.npy`.
        keep: bool = false, "", flag();
    }
    /// How the image's motion is found (method `paper`; METHOD.md, "Image motion").
    motion: MotionOptions {
        /// Number of Harris corners that are followed from each frame to the next.
        corners: u32 = 100, "", whole(8, 2000);
        /// Least corner measure, as a share of the best corner's.
        corner_quality: f64 = 0.001, "", number(0.00001, 0.5);
        /// Least distance between two corners.
        corner_distance_px: f64 = 12.0, "px", number(1.0, 200.0);
        /// Half the width of the band around the line in which no corner is taken.
        band_half_width_px: f64 = 40.0, "px", number(2.0, 1000.0);
        /// Side of the Lucas-Kanade window.
        window_px: u32 = 21, "px", whole(5, 101);
        /// Levels of the image pyramid above the full image: each doubles the largest motion that is followed.
        pyramid_levels: u32 = 4, "", whole(0, 8);
        /// Window of the median filter over the corners' shifts before their mean.
        median_window: u32 = 3, "", whole(1, 99);
        /// The scale product's slow part is what a window of this length averages; it is removed.
        scale_window_s: f64 = 2.0, "s", number(0.1, 60.0);
        /// Correct each frame's depths by the carried scale (METHOD.md, "Jitter and the depth image").
        scale_correction: bool = true, "", flag();
    }
    /// The maps.
    map: MapOptions {
        /// Map tiles held in memory; older ones wait on disk.
        tiles_in_memory: u32 = 48, "", whole(16, 100000);
        /// Size of a map pixel (method `metric`); 0 takes what the geometry supports: the distance of two image rows on
        /// the wall, rounded up to 1, 2 or 5 times a power of ten.
        mm_per_px: f64 = 0.0, "mm", number(0.0, 1000.0);
        /// Widest gap between two profiles that the map fills (method `metric`); what is wider stays a hole.
        bridge_mm: f64 = 25.0, "mm", number(0.0, 10000.0);
        /// Frames after which changed tiles are written while the run goes on.
        tile_frames: u32 = 60, "frames", whole(1, 100000);
    }
    /// What is listed as a defect.
    defects: DefectOptions {
        /// Least depth or height that is listed, whatever the noise.
        depth_min_mm: f64 = 0.5, "mm", number(0.01, 10000.0);
        /// Least depth as a multiple of the surface's own scatter beside the defects. Less finds fainter defects, and more
        /// that are none.
        noise_factor: f64 = 6.0, "σ", number(2.0, 100.0);
        /// Regions that cover less than half of a disc of this radius are not listed.
        radius_min_mm: f64 = 4.0, "mm", number(0.0, 10000.0);
        /// Waves longer than this belong to the undamaged surface; 0 takes a quarter of the map's height, 60 to 400 mm.
        wave_mm: f64 = 0.0, "mm", number(0.0, 100000.0);
        /// Size of the cells that are searched; 0 takes 1 mm at 425 mm of distance, and in proportion.
        cell_mm: f64 = 0.0, "mm", number(0.0, 1000.0);
        /// A flat-bottomed place with steep sides is a hole from this depth on, and missing material above it.
        hole_depth_mm: f64 = 15.0, "mm", number(0.1, 10000.0);
        /// Depth or height from which a defect's severity is moderate.
        moderate_mm: f64 = 3.0, "mm", number(0.0, 10000.0);
        /// Depth or height from which a defect's severity is severe.
        severe_mm: f64 = 10.0, "mm", number(0.0, 10000.0);
        /// Clock position that the camera looks at on a pipe, seen along the rising chainage; 0 takes the camera to look
        /// level: at 9 o'clock from inside, at 3 o'clock from outside.
        view_clock_h: f64 = 0.0, "h", number(0.0, 12.0);
        /// A pipe's radius as built; 0 where it is not known. With it, the ovality is told from the arc that is seen to a few
        /// hundredths of a per cent; without it, only from how the arc departs from a circle.
        nominal_radius_mm: f64 = 0.0, "mm", number(0.0, 1000000.0);
        /// Length of the stretch that one row of sections.csv measures.
        section_step_mm: f64 = 100.0, "mm", number(10.0, 100000.0);
        /// The operator's own codes, written into every list and report: kind=code or kind.severity=code, separated by
        /// semicolons, such as dent=BAA; step=BAJ; dent.severe=BAA B; the more specific one counts.
        codes: String = String::new(), "", text(2000);
        /// Most defects that are listed, the deepest first; what is left out is counted.
        list_max: u32 = 2000, "", whole(1, 100000);
    }
    /// The rerun recording.
    recording: RecordingOptions {
        /// Largest size of the recording: past it, images and points become sparser, never the plots.
        budget_mb: f64 = 200.0, "MB", number(5.0, 2000.0);
        /// Largest width of the recorded images: frames are shrunk to it or below by a whole number.
        image_width_px: u32 = 640, "px", whole(64, 4096);
        /// Images a second of the run.
        images_per_s: f64 = 5.0, "1/s", number(0.1, 240.0);
        /// Surface points recorded of each profile, at most.
        points_per_profile: u32 = 240, "", whole(8, 8192);
        /// Of a run whose recording becomes sparse, each stretch of this length gets a dense recording of its own, within
        /// the same budget; 0: none.
        stretch_m: f64 = 50.0, "m", number(0.0, 100000.0);
        /// Longest time between two live segments.
        segment_s: f64 = 1.0, "s", number(0.1, 60.0);
    }
    /// Limits of what a source may ask for, and of what is made of it.
    limits: LimitOptions {
        /// Most frames of one run: five hours at 60 frames a second.
        max_frames: u32 = 1_080_000, "frames", whole(1, 100_000_000);
        /// Most rows of a map: 16 m of a wall half a metre away. What the motion lays further apart is left out of the maps
        /// with a warning, and stays in the cloud.
        map_rows: u32 = 32_768, "px", whole(256, 65_535);
        /// Most pixels of a map, the empty ones between its parts included: 5 km of a wall 1 m high in pixels of 0.5 mm.
        /// What lies beyond is left out of the maps with a warning, and stays in the cloud.
        map_megapixels: u32 = 20_000, "million", whole(1, 1_000_000);
    }
}

impl Recipe {
    /// A built-in recipe by name.
    pub fn built_in(name: &str) -> Option<Recipe> {
        match name {
            "metric" => Some(Recipe::default()),
            "paper" => Some(Recipe { method: Method::Paper, ..Recipe::default() }),
            "paper-literal" => {
                let mut recipe = Recipe { method: Method::Paper, ..Recipe::default() };
                recipe.stripe.erode_width_px = 50;
                recipe.stripe.restore_height = false;
                Some(recipe)
            }
            _ => None,
        }
    }

    /// A built-in recipe by name, or a TOML file by path.
    pub fn load(name_or_path: &str) -> Result<Recipe> {
        if let Some(recipe) = Recipe::built_in(name_or_path) {
            return Ok(recipe);
        }
        let path = std::path::Path::new(name_or_path);
        if !path.exists() {
            return Err(Error::input(
                format!("recipe '{name_or_path}'"),
                "neither a built-in recipe nor a file",
                format!("one of {}, or the path of a TOML file", BUILT_IN.join(", ")),
            ));
        }
        let text = std::fs::read_to_string(path).map_err(|e| Error::io(path, e))?;
        Recipe::from_toml(name_or_path, &text)
    }

    /// Reads and checks a recipe from TOML text; `subject` names it in errors.
    pub fn from_toml(subject: &str, text: &str) -> Result<Recipe> {
        let recipe: Recipe = toml::from_str(text)
            .map_err(|e| Error::input(subject, e.to_string(), "recipe keys as `stria process --help` lists them"))?;
        recipe.check(subject)?;
        Ok(recipe)
    }

    /// The whole recipe as TOML that [`Recipe::from_toml`] reads back.
    pub fn to_toml(&self) -> String {
        toml::to_string(self).unwrap_or_else(|e| unreachable!("a recipe is plain tables and numbers: {e}"))
    }

    /// Changes one value given as `key=value`.
    pub fn set_pair(&mut self, pair: &str) -> Result<()> {
        let Some((key, value)) = pair.split_once('=') else {
            return Err(Error::input(format!("--set {pair}"), "no '='", "key=value, such as stripe.k=0.8"));
        };
        self.set(key.trim(), value.trim())
    }

    /// Changes one value, as `--set key=value` does.
    pub fn set(&mut self, key: &str, text: &str) -> Result<()> {
        if key == "method" {
            self.method = serde_json::from_value(Value::from(text))
                .map_err(|_| Error::field("--set", key, format!("'{text}'"), "metric or paper"))?;
            return Ok(());
        }
        let Some(option) = options().into_iter().find(|o| o.key == key) else {
            return Err(Error::input(format!("--set {key}={text}"), format!("no option '{key}'"), nearest_keys(key)));
        };
        let expected = option.expected();
        let value =
            option.parse(text).ok_or_else(|| Error::field("--set", key, format!("'{text}'"), expected.clone()))?;
        option.check("--set", &value)?;
        self.put(key, value).map_err(|_| Error::field("--set", key, format!("'{text}'"), expected))
    }

    /// Every value within its range, or the first that is not.
    pub fn check(&self, subject: &str) -> Result<()> {
        for option in options() {
            option.check(subject, &self.value_of(option.key).unwrap_or(Value::Null))?;
        }
        Ok(())
    }
}

impl OptionInfo {
    fn expected(&self) -> String {
        match &self.range {
            Range::Number { min, max, whole } => {
                let kind = if *whole { "a whole number" } else { "a number" };
                format!("{kind} from {min} to {max} {}", self.unit).trim_end().to_string()
            }
            Range::Flag => "true or false".into(),
            Range::Choice { of } => format!("one of {}", of.join(", ")),
            Range::Text { max_chars } => format!("at most {max_chars} characters"),
        }
    }

    fn parse(&self, text: &str) -> Option<Value> {
        match &self.range {
            Range::Number { whole: true, .. } => text.parse::<u64>().ok().map(Value::from),
            Range::Number { .. } => text.parse::<f64>().ok().map(Value::from),
            Range::Flag => text.parse::<bool>().ok().map(Value::from),
            Range::Choice { .. } | Range::Text { .. } => Some(Value::from(text)),
        }
    }

    fn check(&self, subject: &str, value: &Value) -> Result<()> {
        let fits = match &self.range {
            Range::Number { min, max, .. } => value.as_f64().is_some_and(|v| v >= *min && v <= *max),
            Range::Flag => value.is_boolean(),
            Range::Choice { of } => value.as_str().is_some_and(|v| of.contains(&v)),
            Range::Text { max_chars } => value.as_str().is_some_and(|v| v.chars().count() <= *max_chars),
        };
        if fits {
            return self.check_words(subject, value);
        }
        Err(Error::field(subject, self.key, format!("{value} {}", self.unit).trim_end(), self.expected()))
    }
}

impl OptionInfo {
    /// What a text must be besides short.
    fn check_words(&self, subject: &str, value: &Value) -> Result<()> {
        if self.key != "defects.codes" {
            return Ok(());
        }
        let codes = Codes::parse(value.as_str().unwrap_or_default());
        codes.map(|_| ()).map_err(|(found, expected)| Error::field(subject, self.key, found, expected))
    }
}

fn nearest_keys(key: &str) -> String {
    let group = key.split('.').next().unwrap_or_default();
    let options = options();
    let near: Vec<_> = options.iter().map(|o| o.key).filter(|k| k.split('.').next() == Some(group)).collect();
    if near.is_empty() {
        let groups: std::collections::BTreeSet<_> = options.iter().filter_map(|o| o.key.split('.').next()).collect();
        return format!("a key of one of the groups {}", groups.into_iter().collect::<Vec<_>>().join(", "));
    }
    format!("one of {}", near.join(", "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn built_in_recipes_are_sound_and_survive_toml() {
        for name in BUILT_IN {
            let recipe = Recipe::load(name).expect("built in");
            recipe.check(name).expect("in range");
            assert_eq!(Recipe::from_toml(name, &recipe.to_toml()).expect("toml"), recipe);
        }
    }

    #[test]
    fn every_option_has_words_and_a_default_in_range() {
        for option in options() {
            assert!(option.doc.len() > 20, "{} needs a reason", option.key);
            option.check("default", &option.default).expect("default in range");
        }
    }

    #[test]
    fn values_out_of_range_and_unknown_keys_are_named() {
        let mut recipe = Recipe::default();
        recipe.set("stripe.k", "0.8").expect("in range");
        assert_eq!(recipe.stripe.k, 0.8);
        for (key, value, part) in [
            ("stripe.k", "7", "0.5 to 0.99"),
            ("stripe.k", "much", "a number"),
            ("stripe.kk", "1", "stripe.hue_shift"),
            ("nothing", "1", "groups"),
            ("stripe.keep", "yes", "true or false"),
            ("motion.corners", "10.5", "whole"),
            ("defects.codes", "crack=BAB", "missing_material"),
        ] {
            let message = recipe.set(key, value).expect_err(key).to_string();
            assert!(message.contains(part), "{message}");
        }
        assert!(Recipe::from_toml("r.toml", "[stripe]\nkk = 1").is_err());
        assert!(Recipe::from_toml("r.toml", "[stripe]\nk = 2.0").is_err());
    }
}

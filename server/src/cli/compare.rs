//! `stria compare`: two product folders of one asset → what has changed between them.

use std::path::PathBuf;

use clap::Args;
use stria_core::export::change_list::{compare_folders, state_name};
use stria_core::recipe::{self, Recipe};

use super::{Failed, Outcome, Success};

/// Compare two runs along the same asset: what is new, deeper, shallower or gone
#[derive(Args)]
#[command(
    after_help = "Example: stria compare products-2024 products-2025 --out change\nDIR gets change.json, change.csv and difference.tif. Both folders need defects.json and residual.tif."
)]
pub(super) struct Compare {
    /// The product folder of the earlier run
    before: PathBuf,
    /// The product folder of the later run
    after: PathBuf,
    /// The folder for the result; it is made where it is missing
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Whose `defects` options to use: a built-in recipe's name, or a TOML file
    #[arg(long, value_name = "NAME|FILE", default_value = recipe::BUILT_IN[0])]
    recipe: String,
    /// Change one value of the recipe, such as defects.noise_factor=6; may be given several times
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
}

impl Compare {
    pub(super) fn run(self) -> Outcome {
        let mut recipe = Recipe::load(&self.recipe)?;
        for change in &self.set {
            recipe.set_pair(change)?;
        }
        std::fs::create_dir_all(&self.out).map_err(|e| Failed::Input(format!("--out {}: {e}", self.out.display())))?;
        let list = compare_folders(&self.before, &self.after, &recipe.defects, &self.out)?;
        let registration = &list.registration;
        println!(
            "Registered in {} of {} windows: {:.1} mm along, {:.1} mm across, standard deviation {:.2} mm",
            registration.windows_agreeing,
            registration.windows,
            registration.offset_x_mm,
            registration.offset_y_mm,
            registration.sd_x_mm.hypot(registration.sd_y_mm)
        );
        println!(
            "  compared  {:.2} m², level of detection {:.2} mm, changes claimed from {:.2} mm",
            list.compared_area_mm2 / 1e6,
            list.level_of_detection_mm,
            list.claimed_from_mm
        );
        for change in &list.changes {
            println!(
                "  {:<9} {:+.2} mm at chainage {:.0} mm, y {:.0} mm, {:.0} mm²",
                state_name(change.state),
                change.delta_depth_mm,
                change.chainage_mm,
                change.y_mm,
                change.area_mm2
            );
        }
        println!("  unchanged {} defects", list.unchanged.len());
        Ok(Success::Done)
    }
}

//! Rigs and recipes: as text in a request, as stored rows, as built-in names.

use sea_orm::sea_query::OnConflict;
use sea_orm::{ActiveValue::Set, ColumnTrait, ConnectionTrait, EntityTrait, QueryFilter, QueryOrder, QuerySelect};
use serde::{Deserialize, Serialize};
use stria_core::recipe::{self, Recipe};
use stria_core::rig::Rig;

use super::{Page, Runs, check_name, shorten};
use crate::db::tables::rig;
use crate::db::{ANSWER_PATIENCE, retried};
use crate::error::{Error, Result};
use crate::store::sha256_of;
use crate::wire::time::{now_ms, to_text};
use crate::wire::{self, OptionRange};

/// The name of a recipe that came as text.
const CUSTOM: &str = "custom";

/// A rig that was checked, as a job keeps it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RigText {
    /// Its name.
    pub name: String,
    /// The rig file.
    pub toml: String,
}

impl RigText {
    /// Reads and checks a rig file, TOML or JSON.
    pub fn read(text: &str) -> Result<RigText> {
        let json = text.trim_start().starts_with('{');
        let rig = if json { Rig::from_json("rig", text) } else { Rig::from_toml("rig", text) };
        let rig = rig.map_err(|e| Error::from_core("rig", e))?;
        check_name("rig.name", &rig.name)?;
        Ok(RigText { toml: rig.to_toml(), name: rig.name })
    }
}

/// A recipe that was checked, as a job keeps it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RecipeText {
    /// A built-in recipe's name, or `custom`.
    pub name: String,
    /// All its values.
    pub toml: String,
}

impl RecipeText {
    /// A built-in recipe by name, or TOML text; the default where there is neither.
    pub fn read(text: Option<&str>) -> Result<RecipeText> {
        let text = text.unwrap_or(recipe::BUILT_IN[0]).trim();
        if let Some(recipe) = Recipe::built_in(text) {
            return Ok(RecipeText { name: text.into(), toml: recipe.to_toml() });
        }
        if !is_file_text(text) && !text.is_empty() {
            let found = format!("there is no built-in recipe {:?}", shorten(text));
            return Err(Error::field("recipe", found, format!("one of {}, or TOML", recipe::BUILT_IN.join(", "))));
        }
        let recipe = Recipe::from_toml("recipe", text).map_err(|e| Error::from_core("recipe", e))?;
        Ok(RecipeText { name: CUSTOM.into(), toml: recipe.to_toml() })
    }
}

/// A whole file rather than a name: names have neither `=` nor line breaks, files have both.
fn is_file_text(text: &str) -> bool {
    text.contains(['\n', '=', '{'])
}

/// The built-in recipes.
pub fn built_in_recipes() -> Vec<wire::Recipe> {
    let of = |name: &&str| {
        let toml = Recipe::built_in(name)?.to_toml();
        Some(wire::Recipe { name: (*name).into(), default: *name == recipe::BUILT_IN[0], toml })
    };
    recipe::BUILT_IN.iter().filter_map(of).collect()
}

/// Every tunable of a recipe.
pub fn options() -> Vec<wire::RecipeOption> {
    let of = |o: recipe::OptionInfo| wire::RecipeOption {
        key: o.key.into(),
        unit: o.unit.into(),
        default: o.default,
        range: match o.range {
            recipe::Range::Number { min, max, whole } => OptionRange::Number { min, max, whole },
            recipe::Range::Flag => OptionRange::Flag,
            recipe::Range::Text { max_chars } => OptionRange::Text { max_chars },
            recipe::Range::Choice { of } => OptionRange::Choice { of: of.into_iter().map(Into::into).collect() },
        },
        doc: o.doc,
    };
    recipe::options().into_iter().map(of).collect()
}

impl Runs {
    /// A rig as a request names it: a stored one by name, or a whole rig file.
    pub async fn rig(&self, text: &str) -> Result<RigText> {
        if is_file_text(text) {
            return RigText::read(text);
        }
        let name = text.trim();
        match rig::Entity::find_by_id(name).one(self.db.read()).await? {
            Some(row) => Ok(RigText { name: row.name, toml: row.toml }),
            None => Err(Error::field(
                "rig",
                format!("there is no stored rig {:?}", shorten(name)),
                "the name of a stored rig, or a rig file in TOML or JSON",
            )),
        }
    }

    /// Stores a rig. A stored rig never changes: a new calibration has a new name.
    pub async fn store_rig(&self, new: &RigText) -> Result<(wire::Rig, bool)> {
        let made = retried(ANSWER_PATIENCE, || self.keep_rig(new)).await?;
        let row = rig::Entity::find_by_id(&new.name).one(self.db.read()).await?;
        let row = row.ok_or_else(|| Error::NotFound { what: "rig", id: new.name.clone() })?;
        if row.toml != new.toml {
            return Err(Error::Conflict(format!(
                "there is another rig '{}' with other values; stored rigs do not change: give the new calibration a name of its own",
                new.name
            )));
        }
        Ok((rig_of(row)?, made))
    }

    /// True where there was none of that name.
    async fn keep_rig(&self, new: &RigText) -> Result<bool> {
        let t = self.db.write().await?;
        let there = rig::Entity::find_by_id(&new.name).one(&*t).await?;
        keep_if_new(&*t, new).await?;
        t.commit().await?;
        Ok(there.is_none())
    }

    /// A stored rig.
    pub async fn stored_rig(&self, name: &str) -> Result<wire::Rig> {
        let row = rig::Entity::find_by_id(name).one(self.db.read()).await?;
        rig_of(row.ok_or_else(|| Error::NotFound { what: "rig", id: name.into() })?)
    }

    /// Stored rigs by name.
    pub async fn rigs(&self, page: &Page) -> Result<wire::RigPage> {
        let mut query = rig::Entity::find().order_by_asc(rig::Column::Name).limit(page.limit + 1);
        if let Some(cursor) = &page.cursor {
            query = query.filter(rig::Column::Name.gt(cursor.as_str()));
        }
        let mut rows = query.all(self.db.read()).await?;
        let next_cursor = page.next(&mut rows, |r| r.name.clone());
        Ok(wire::RigPage { items: rows.into_iter().map(rig_of).collect::<Result<_>>()?, next_cursor })
    }
}

/// A rig that came with a run is kept under its name, so that the next run can use the name; one that is there stays.
pub(super) async fn keep_if_new(records: &impl ConnectionTrait, new: &RigText) -> Result<()> {
    let row = rig::ActiveModel {
        name: Set(new.name.clone()),
        created_ms: Set(now_ms()),
        toml: Set(new.toml.clone()),
        sha256: Set(sha256_of(&new.toml)),
    };
    let keep = OnConflict::column(rig::Column::Name).do_nothing().to_owned();
    rig::Entity::insert(row).on_conflict(keep).try_insert().exec_without_returning(records).await?;
    Ok(())
}

fn rig_of(row: rig::Model) -> Result<wire::Rig> {
    let rig = Rig::from_toml("stored rig", &row.toml).map_err(|e| Error::Internal(e.to_string()))?;
    Ok(wire::Rig {
        name: row.name,
        created_at: to_text(row.created_ms),
        sha256: row.sha256,
        rig: rig.to_json(),
        toml: row.toml,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn recipes_are_read_by_name_and_by_text() {
        assert_eq!(RecipeText::read(None).expect("default").name, recipe::BUILT_IN[0]);
        assert_eq!(RecipeText::read(Some("paper-literal")).expect("built in").name, "paper-literal");
        let custom = RecipeText::read(Some("[stripe]\nk = 0.8\n")).expect("text");
        assert!(custom.name == CUSTOM && custom.toml.contains("k = 0.8"));
        for bad in ["../../etc/passwd", "[stripe]\nk = 8.0", "[stripe]\nnothing = 1", "metric!"] {
            let error = RecipeText::read(Some(bad)).expect_err(bad);
            assert!(matches!(error, Error::Input { field: Some(f), .. } if f.starts_with("recipe")));
        }
    }

    #[test]
    fn a_bad_rig_names_its_field() {
        let text = "name = 'x'\n[camera]\nwidth_px = 0\nheight_px = 10\nfov_deg = 60.0\n[laser]\nbaseline_mm = 100.0\n";
        let error = RigText::read(text).expect_err("no width");
        assert!(matches!(error, Error::Input { field: Some(f), .. } if f == "rig.camera.width_px"));
    }
}

//! Defects over all runs: written with a job's result, listed, judged by people, followed from run to run.
//!
//! What was measured never changes; what people say about a defect goes with it to the next job of the same run, where
//! that job finds a defect of the same kind at the same place.

mod history;
mod identity;
mod listing;
mod publishing;

use sea_orm::{ActiveModelTrait, EntityTrait, QuerySelect, Set};

pub use listing::{DefectFilter, DefectSort};
pub use publishing::{publish, run_changed};

use crate::db::tables::defect;
use crate::db::{ANSWER_PATIENCE, Db, retried};
use crate::error::{Error, Result};
use crate::runs::MAX_NOTE_CHARS;
use crate::wire::time::{now_ms, to_text};
use crate::wire::{self, DefectChange, DefectState};

/// The records of defects.
#[derive(Clone)]
pub struct Defects {
    db: Db,
}

impl Defects {
    /// On a database.
    pub fn new(db: Db) -> Defects {
        Defects { db }
    }

    /// One defect.
    pub async fn get(&self, id: &str) -> Result<wire::Defect> {
        defect_of(self.row(id).await?)
    }

    async fn row(&self, id: &str) -> Result<defect::Model> {
        let found = defect::Entity::find_by_id(id).one(self.db.read()).await?;
        found.ok_or_else(|| missing(id))
    }

    /// Changes what people say about a defect, where it still has one of these versions; any will do where nothing is
    /// said. `who` is written down with it.
    pub async fn change(
        &self,
        id: &str,
        change: DefectChange,
        versions: Option<&[String]>,
        who: &str,
    ) -> Result<wire::Defect> {
        retried(ANSWER_PATIENCE, || self.try_change(id, &change, versions, who)).await
    }

    async fn try_change(
        &self,
        id: &str,
        change: &DefectChange,
        versions: Option<&[String]>,
        who: &str,
    ) -> Result<wire::Defect> {
        let t = self.db.write().await?;
        let row = defect::Entity::find_by_id(id).lock_exclusive().one(&*t).await?.ok_or_else(|| missing(id))?;
        if versions.is_some_and(|versions| !versions.contains(&row.version.to_string())) {
            let found =
                format!("somebody else has changed the defect since it was read: it has version {}", row.version);
            return Err(Error::Changed(found));
        }
        let mut set = defect::ActiveModel {
            id: Set(row.id),
            version: Set(row.version + 1),
            changed_ms: Set(Some(now_ms())),
            changed_by: Set(Some(who.into())),
            ..Default::default()
        };
        if let Some(state) = change.state {
            set.state = Set(state.as_str().into());
        }
        if let Some(comment) = &change.comment {
            let length = comment.chars().count();
            if length > MAX_NOTE_CHARS {
                let found = format!("the comment has {length} characters");
                return Err(Error::field("comment", found, format!("at most {MAX_NOTE_CHARS} characters")));
            }
            set.comment = Set(comment.clone());
        }
        let changed = set.update(&*t).await?;
        t.commit().await?;
        defect_of(changed)
    }
}

fn missing(id: &str) -> Error {
    Error::NotFound { what: "defect", id: id.into() }
}

/// A defect as the wire shows it.
fn defect_of(row: defect::Model) -> Result<wire::Defect> {
    let state = DefectState::parse(&row.state)
        .ok_or_else(|| Error::Internal(format!("defect {} has the state {:?}", row.id, row.state)))?;
    Ok(wire::Defect {
        id: row.id,
        asset: row.asset,
        run: row.run_id,
        job: row.job_id,
        current: row.is_current != 0,
        number: row.number,
        kind: row.kind,
        severity: row.severity,
        code: row.code,
        chainage_mm: row.chainage_mm,
        clock_h: row.clock_h,
        height_mm: row.height_mm,
        x_mm: row.x_mm,
        y_mm: row.y_mm,
        z_mm: row.z_mm,
        depth_mm: row.depth_mm,
        length_mm: row.length_mm,
        width_mm: row.width_mm,
        area_mm2: row.area_mm2,
        volume_mm3: row.volume_mm3,
        steepest_slope_deg: row.steepest_slope_deg,
        confidence: row.confidence,
        at_edge: row.at_edge != 0,
        state,
        comment: row.comment,
        version: row.version.to_string(),
        changed_at: row.changed_ms.map(to_text),
        changed_by: row.changed_by,
        carried_from: row.carried_from,
    })
}

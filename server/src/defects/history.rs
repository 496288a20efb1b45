//! One defect over all runs of its asset.

use sea_orm::{ColumnTrait, EntityTrait, Order, QueryFilter, QueryOrder, QuerySelect};

use super::identity::{Place, partners};
use super::{Defects, defect_of};
use crate::db::tables::{defect, inspection, job, run};
use crate::error::Result;
use crate::wire::time::to_text;
use crate::wire::{self, Direction, JobState};

/// Most runs of a history, the newest.
const MOST_RUNS: u64 = 200;
/// Defects within this way along the asset say how two runs lie to each other, mm.
const NEIGHBOURS_MM: f64 = 2000.0;
/// Most of them.
const MOST_NEIGHBOURS: u64 = 200;

impl Defects {
    /// What every run of the same asset that passed its place, either way, says of it, the latest first. Where runs lie
    /// shifted to each other by up to `slack_mm`, the defects around it tell by how much.
    pub async fn history(&self, id: &str, slack_mm: f64) -> Result<wire::DefectHistory> {
        let own = self.row(id).await?;
        let runs = run::Entity::find()
            .filter(run::Column::Asset.eq(&own.asset))
            .order_by(run::Column::RecordedMs, Order::Desc);
        let runs = runs.limit(MOST_RUNS).all(self.db.read()).await?;
        let direction = runs.iter().find(|r| r.id == own.run_id).map(|r| r.direction.clone());
        let around = self.around(&own.run_id, Some(&own.job_id), own.chainage_mm, NEIGHBOURS_MM).await?;
        let mut items = Vec::new();
        for run in runs {
            let job = if run.id == own.run_id { Some(own.job_id.as_str()) } else { None };
            let there = self.around(&run.id, job, own.chainage_mm, NEIGHBOURS_MM + slack_mm).await?;
            let shown = match job {
                Some(job) => job.to_string(),
                None => match self.latest_done(&run.id).await? {
                    Some(job) => job,
                    None => continue,
                },
            };
            let Some(seen) = inspection::Entity::find_by_id(&shown).one(self.db.read()).await? else { continue };
            let (x_mm, slack) = (x_of(&run, own.chainage_mm), if job.is_some() { 0.0 } else { slack_mm });
            if x_mm < seen.x_min_mm - slack || x_mm > seen.x_max_mm + slack {
                continue;
            }
            // A camera that sees the same surface on the way back is turned half about its axis.
            let turned = direction.as_ref().is_some_and(|own| *own != run.direction);
            let same = partners(&places(&around, false), &places(&there, turned), slack);
            let at = around.iter().position(|d| d.id == own.id).and_then(|i| same[i]);
            items.push(wire::DefectSighting {
                run: run.id,
                job: shown,
                recorded_at: to_text(run.recorded_ms),
                detection_limit_mm: seen.detection_limit_mm,
                defect: at.map(|j| defect_of(there[j].clone())).transpose()?,
            });
        }
        Ok(wire::DefectHistory { defect: defect_of(own)?, items })
    }

    async fn latest_done(&self, run: &str) -> Result<Option<String>> {
        let jobs = job::Entity::find().filter(job::Column::RunId.eq(run)).order_by(job::Column::Id, Order::Desc);
        let done = jobs.filter(job::Column::State.eq(JobState::Done.as_str())).one(self.db.read()).await?;
        Ok(done.map(|job| job.id))
    }

    /// A run's defects near a chainage, the nearest to it first; of its latest job where none is named.
    async fn around(
        &self,
        run: &str,
        job: Option<&str>,
        chainage_mm: f64,
        within_mm: f64,
    ) -> Result<Vec<defect::Model>> {
        let query = defect::Entity::find().filter(defect::Column::RunId.eq(run));
        let query = match job {
            Some(job) => query.filter(defect::Column::JobId.eq(job)),
            None => query.filter(defect::Column::IsCurrent.eq(1)),
        };
        let (from_mm, to_mm) = (chainage_mm - within_mm, chainage_mm + within_mm);
        let near = || query.clone().limit(MOST_NEIGHBOURS);
        let above = near().filter(defect::Column::ChainageMm.between(chainage_mm, to_mm));
        let below =
            near().filter(defect::Column::ChainageMm.gte(from_mm)).filter(defect::Column::ChainageMm.lt(chainage_mm));
        let mut found = above.order_by(defect::Column::ChainageMm, Order::Asc).all(self.db.read()).await?;
        found.extend(below.order_by(defect::Column::ChainageMm, Order::Desc).all(self.db.read()).await?);
        let far = |d: &defect::Model| (d.chainage_mm - chainage_mm).abs();
        found.sort_by(|a, b| far(a).total_cmp(&far(b)));
        Ok(found)
    }
}

fn x_of(run: &run::Model, chainage_mm: f64) -> f64 {
    let way_mm = chainage_mm - run.chainage_mm;
    if run.direction == Direction::Backward.as_str() { -way_mm } else { way_mm }
}

/// Places along and across the asset; of a run that went the other way `turned`.
fn places(rows: &[defect::Model], turned: bool) -> Vec<Place<'_>> {
    let of = |d: &defect::Model| 0.5 * (d.length_mm + d.width_mm);
    // A dent may have become a hole since.
    let side = |d: &defect::Model| if d.depth_mm > 0.0 { "away" } else { "towards" };
    let across_mm = |d: &defect::Model| if turned { -d.y_mm } else { d.y_mm };
    rows.iter().map(|d| Place { kind: side(d), x_mm: d.chainage_mm, y_mm: across_mm(d), extent_mm: of(d) }).collect()
}

//! A job's defects → the records, inside the transaction that publishes its result.

use sea_orm::sea_query::{CaseStatement, Expr};
use sea_orm::{
    ActiveValue::Set, ColumnTrait, ConnectionTrait, EntityTrait, ExprTrait, PaginatorTrait, QueryFilter, QuerySelect,
};
use stria_core::defects::DefectList;

use super::identity::{Place, partners};
use crate::db::tables::{defect, inspection, job, run};
use crate::error::{Error, Result};
use crate::wire::{DefectState, Direction, JobState};

/// Rows of one INSERT; SQLite takes 32,766 values.
const ROWS_AT_ONCE: usize = 500;

/// Writes what a job found. What people said about the run's defects goes over to those of the same kind at the same
/// place; the answer says in words how many, where there were any.
pub async fn publish(
    records: &impl ConnectionTrait,
    run_id: &str,
    job_id: &str,
    list: Option<&DefectList>,
) -> Result<Option<String>> {
    // Two jobs of one run that end at the same time must see each other.
    let Some(run) = run::Entity::find_by_id(run_id).lock_exclusive().one(records).await? else {
        return Err(Error::LeaseLost);
    };
    let done = job::Column::State.eq(JobState::Done.as_str());
    let newer = job::Entity::find().filter(job::Column::RunId.eq(run_id)).filter(job::Column::Id.gt(job_id));
    let is_current = newer.filter(done).count(records).await? == 0;
    let Some(list) = list else { return Ok(None) };
    let mut rows: Vec<defect::ActiveModel> =
        list.defects.iter().map(|found| row_of(&run, job_id, list, found, is_current)).collect();
    let mut words = None;
    if is_current {
        let before = defect::Entity::find().filter(defect::Column::RunId.eq(run_id));
        let before = before.filter(defect::Column::IsCurrent.eq(1)).filter(defect::Column::Version.gt(0));
        let before = before.all(records).await?;
        if !before.is_empty() {
            let carried = carry(&before, list, &mut rows);
            words = Some(format!(
                "what people said about {} defects: {carried} carried over to the same place, {} where nothing of that \
                 kind was found",
                before.len(),
                before.len() - carried
            ));
        }
        let old = defect::ActiveModel { is_current: Set(0), ..Default::default() };
        defect::Entity::update_many().set(old).filter(defect::Column::RunId.eq(run_id)).exec(records).await?;
    }
    for part in rows.chunks(ROWS_AT_ONCE) {
        defect::Entity::insert_many(part.iter().cloned()).exec_without_returning(records).await?;
    }
    let seen = inspection::ActiveModel {
        job_id: Set(job_id.into()),
        x_min_mm: Set(list.inspected.x_min_mm),
        x_max_mm: Set(list.inspected.x_min_mm + list.inspected.length_mm),
        detection_limit_mm: Set(list.detection_limit_mm),
        doubtful: Set(list.doubtful as i64),
        omitted: Set(list.omitted as i64),
    };
    inspection::Entity::insert(seen).exec_without_returning(records).await?;
    Ok(words)
}

fn row_of(
    run: &run::Model,
    job_id: &str,
    list: &DefectList,
    found: &stria_core::defects::Defect,
    is_current: bool,
) -> defect::ActiveModel {
    // The run may have been moved or turned since the job began.
    let falls = run.direction == Direction::Backward.as_str();
    let turned = falls != list.chainage_falls;
    defect::ActiveModel {
        id: Set(format!("{job_id}-{:06}", found.id)),
        job_id: Set(job_id.into()),
        run_id: Set(run.id.clone()),
        asset: Set(run.asset.clone()),
        is_current: Set(i32::from(is_current)),
        number: Set(found.id.into()),
        kind: Set(found.kind.name().into()),
        severity: Set(found.severity.clone()),
        code: Set(found.code.clone()),
        chainage_mm: Set(run.chainage_mm + if falls { -found.x_mm } else { found.x_mm }),
        clock_h: Set(found.clock_h.map(|h| if turned && h < 12.0 { 12.0 - h } else { h })),
        height_mm: Set(found.height_mm),
        x_mm: Set(found.x_mm),
        y_mm: Set(found.y_mm),
        z_mm: Set(found.z_mm),
        depth_mm: Set(found.depth_mm),
        size_mm: Set(found.depth_mm.abs()),
        length_mm: Set(found.length_mm),
        width_mm: Set(found.width_mm),
        area_mm2: Set(found.area_mm2),
        volume_mm3: Set(found.volume_mm3),
        steepest_slope_deg: Set(found.steepest_slope_deg),
        confidence: Set(found.confidence),
        at_edge: Set(i32::from(found.at_edge)),
        state: Set(DefectState::Open.as_str().into()),
        comment: Set(String::new()),
        version: Set(0),
        changed_ms: Set(None),
        changed_by: Set(None),
        carried_from: Set(None),
    }
}

/// Gives the new rows what was said about the old ones; answers how many found their place.
fn carry(before: &[defect::Model], list: &DefectList, rows: &mut [defect::ActiveModel]) -> usize {
    let extent = |length_mm: f64, width_mm: f64| 0.5 * (length_mm + width_mm);
    let earlier: Vec<Place> = before
        .iter()
        .map(|d| Place { kind: &d.kind, x_mm: d.x_mm, y_mm: d.y_mm, extent_mm: extent(d.length_mm, d.width_mm) })
        .collect();
    let later: Vec<Place> = list
        .defects
        .iter()
        .map(|d| Place { kind: d.kind.name(), x_mm: d.x_mm, y_mm: d.y_mm, extent_mm: extent(d.length_mm, d.width_mm) })
        .collect();
    let found = partners(&earlier, &later, 0.0);
    for (old, j) in before.iter().zip(&found) {
        let Some(row) = j.and_then(|j| rows.get_mut(j)) else { continue };
        row.state = Set(old.state.clone());
        row.comment = Set(old.comment.clone());
        row.version = Set(old.version);
        row.changed_ms = Set(old.changed_ms);
        row.changed_by = Set(old.changed_by.clone());
        row.carried_from = Set(Some(old.id.clone()));
    }
    found.iter().flatten().count()
}

/// Brings a run's defects to what the run says now: its asset, where it begins, which way it goes.
pub async fn run_changed(records: &impl ConnectionTrait, before: &run::Model) -> Result<()> {
    let Some(run) = run::Entity::find_by_id(&before.id).one(records).await? else { return Ok(()) };
    let moved = run.asset != before.asset || run.chainage_mm != before.chainage_mm || run.direction != before.direction;
    if !moved {
        return Ok(());
    }
    let sign = if run.direction == Direction::Backward.as_str() { -1.0 } else { 1.0 };
    let chainage = Expr::col(defect::Column::XMm).mul(sign).add(run.chainage_mm);
    let mut update = defect::Entity::update_many()
        .col_expr(defect::Column::Asset, Expr::value(run.asset.as_str()))
        .col_expr(defect::Column::ChainageMm, chainage);
    if run.direction != before.direction {
        // Seen from the other end of the pipe, left and right change places; NULL stays NULL.
        let hour = || Expr::col(defect::Column::ClockH);
        let turned = CaseStatement::new().case(hour().lt(12.0), Expr::value(12.0).sub(hour())).finally(hour());
        update = update.col_expr(defect::Column::ClockH, turned.into());
    }
    update.filter(defect::Column::RunId.eq(&run.id)).exec(records).await?;
    Ok(())
}

//! Pages and filters of defects, each order on an index.

use sea_orm::{ColumnTrait, Condition, EntityTrait, Order, QueryFilter, QueryOrder, QuerySelect};
use stria_core::defects::DefectKind;
use stria_core::recipe::SEVERITIES;

use super::{Defects, defect_of};
use crate::db::tables::defect;
use crate::error::{Error, Result};
use crate::runs::{Page, with_words};
use crate::wire::{self, DefectState};

/// Which defects to list.
#[derive(Clone, Debug, Default)]
pub struct DefectFilter {
    /// On this asset.
    pub asset: Option<String>,
    /// Of this run.
    pub run: Option<String>,
    /// Of this job; where nothing is said, of every run's latest job that is done.
    pub job: Option<String>,
    /// Of this kind.
    pub kind: Option<String>,
    /// Of this severity.
    pub severity: Option<String>,
    /// In this state.
    pub state: Option<String>,
    /// At this chainage or behind it, mm.
    pub from_mm: Option<f64>,
    /// Before this chainage, mm.
    pub to_mm: Option<f64>,
    /// At least so deep or high, mm.
    pub depth_min_mm: Option<f64>,
    /// With this text in the asset's name, the comment, the kind or the code.
    pub q: Option<String>,
    /// In which order.
    pub sort: DefectSort,
}

/// The order of a list of defects.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DefectSort {
    by: Key,
    rising: bool,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Key {
    #[default]
    Created,
    Chainage,
    Depth,
}

impl DefectSort {
    /// Reads a request's word: `created`, `chainage` or `depth`, with a minus for the other way round.
    pub fn parse(text: Option<&str>) -> Result<DefectSort> {
        let Some(text) = text else { return Ok(DefectSort::default()) };
        let (rising, name) = text.strip_prefix('-').map_or((true, text), |name| (false, name));
        let by = match name {
            "created" => Key::Created,
            "chainage" => Key::Chainage,
            "depth" => Key::Depth,
            _ => {
                let expected = "created, -created, chainage, -chainage, depth or -depth";
                return Err(Error::field("sort", format!("sort is {text:?}"), expected));
            }
        };
        Ok(DefectSort { by, rising })
    }

    /// The column that sorts; a defect's name is ordered by its job's creation.
    fn column(self) -> Option<defect::Column> {
        match self.by {
            Key::Created => None,
            Key::Chainage => Some(defect::Column::ChainageMm),
            Key::Depth => Some(defect::Column::SizeMm),
        }
    }

    /// What a cursor names: the defect, behind the very bits of the value that sorts it.
    fn cursor(self, row: &defect::Model) -> String {
        let value = match self.by {
            Key::Created => return row.id.clone(),
            Key::Chainage => row.chainage_mm,
            Key::Depth => row.size_mm,
        };
        format!("{:016x}|{}", value.to_bits(), row.id)
    }

    /// The defects behind a cursor.
    fn after(self, cursor: &str) -> Result<Condition> {
        let bad = || Error::field("cursor", format!("cursor is {cursor:?}"), "the `next_cursor` of the page before");
        let beyond = |column: defect::Column, value: sea_orm::Value| match self.rising {
            true => column.gt(value),
            false => column.lt(value),
        };
        let Some(column) = self.column() else {
            return Ok(Condition::all().add(beyond(defect::Column::Id, cursor.into())));
        };
        let (bits, id) = cursor.split_once('|').ok_or_else(bad)?;
        let value = f64::from_bits(u64::from_str_radix(bits, 16).map_err(|_| bad())?);
        if !value.is_finite() {
            return Err(bad());
        }
        let same = Condition::all().add(column.eq(value)).add(beyond(defect::Column::Id, id.into()));
        Ok(Condition::any().add(beyond(column, value.into())).add(same))
    }
}

impl DefectFilter {
    fn condition(&self) -> Result<Condition> {
        let mut all = Condition::all();
        all = match &self.job {
            Some(job) => all.add(defect::Column::JobId.eq(job.as_str())),
            None => all.add(defect::Column::IsCurrent.eq(1)),
        };
        let kinds = DefectKind::ALL.map(DefectKind::name);
        let states = DefectState::ALL.map(DefectState::as_str);
        for (field, value, words) in [
            ("kind", &self.kind, &kinds[..]),
            ("severity", &self.severity, &SEVERITIES),
            ("state", &self.state, &states),
        ] {
            if let Some(value) = value
                && !words.contains(&value.as_str())
            {
                let expected = format!("one of {}", words.join(", "));
                return Err(Error::field(field, format!("{field} is {value:?}"), expected));
            }
        }
        for (column, value) in [
            (defect::Column::Asset, &self.asset),
            (defect::Column::RunId, &self.run),
            (defect::Column::Kind, &self.kind),
            (defect::Column::Severity, &self.severity),
            (defect::Column::State, &self.state),
        ] {
            if let Some(value) = value {
                all = all.add(column.eq(value.as_str()));
            }
        }
        if let Some(from_mm) = self.from_mm {
            all = all.add(defect::Column::ChainageMm.gte(from_mm));
        }
        if let Some(to_mm) = self.to_mm {
            all = all.add(defect::Column::ChainageMm.lt(to_mm));
        }
        if let Some(depth_mm) = self.depth_min_mm {
            all = all.add(defect::Column::SizeMm.gte(depth_mm));
        }
        if let Some(q) = self.q.as_ref().filter(|q| !q.is_empty()) {
            let columns = [defect::Column::Asset, defect::Column::Comment, defect::Column::Kind, defect::Column::Code];
            all = all.add(with_words(q, &columns));
        }
        Ok(all)
    }
}

impl Defects {
    /// Defects in the filter's order.
    pub async fn list(&self, filter: &DefectFilter, page: &Page) -> Result<wire::DefectPage> {
        let (sort, mut query) = (filter.sort, defect::Entity::find().filter(filter.condition()?));
        let order = if sort.rising { Order::Asc } else { Order::Desc };
        if let Some(column) = sort.column() {
            query = query.order_by(column, order.clone());
        }
        query = query.order_by(defect::Column::Id, order);
        if let Some(cursor) = &page.cursor {
            query = query.filter(sort.after(cursor)?);
        }
        let mut rows = query.limit(page.limit + 1).all(self.db.read()).await?;
        let next_cursor = page.next(&mut rows, |r| sort.cursor(r));
        Ok(wire::DefectPage { items: rows.into_iter().map(defect_of).collect::<Result<_>>()?, next_cursor })
    }
}

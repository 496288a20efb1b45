//! Which rules of keeping hold: those that people stored in the records, for every server alike; else each server's own flags.

use sea_orm::sea_query::OnConflict;
use sea_orm::{ActiveValue::Set, EntityTrait, QuerySelect, TryInsertResult};

use super::Policy;
use crate::db::tables::retention_rules;
use crate::db::{ANSWER_PATIENCE, Db, retried};
use crate::error::{Error, Result};
use crate::wire::time::{now_ms, to_text};
use crate::wire::{RetentionRules, RulesOrigin};

/// The one row's key.
const ROW: i32 = 1;
/// Longest time to keep runs for, days.
pub const MOST_DAYS: f64 = 1e6;
/// Largest quota, GB.
pub const MOST_GB: f64 = 1e9;

/// The rules that hold now.
#[derive(Clone, Debug, PartialEq)]
pub struct Holding {
    /// What they say.
    pub policy: Policy,
    /// Grows with every change by people; 0 before the first.
    pub version: i64,
    /// People stored them; else they are this server's flags.
    pub stored: bool,
    /// When, in ms since 1970, and by whom they were stored, or the flags made to hold again.
    pub changed: Option<(i64, String)>,
}

impl Holding {
    /// What holds on a server with these flags.
    pub async fn now(db: &Db, own: Policy) -> Result<Holding> {
        let row = retention_rules::Entity::find_by_id(ROW).one(db.read()).await?;
        Ok(match row {
            Some(row) => Holding {
                policy: match row.stored {
                    0 => own,
                    _ => Policy { keep_days: row.keep_days, quota_gb: row.quota_gb },
                },
                version: row.version,
                stored: row.stored != 0,
                changed: Some((row.changed_ms, row.changed_by)),
            },
            None => Holding { policy: own, version: 0, stored: false, changed: None },
        })
    }

    /// As people see them, beside this server's flags.
    pub fn wire(&self, own: Policy) -> RetentionRules {
        RetentionRules {
            keep_days: self.policy.keep_days,
            quota_gb: self.policy.quota_gb,
            origin: if self.stored { RulesOrigin::Stored } else { RulesOrigin::Server },
            version: self.version.to_string(),
            changed_at: self.changed.as_ref().map(|(at_ms, _)| to_text(*at_ms)),
            changed_by: self.changed.as_ref().map(|(_, who)| who.clone()),
            own_keep_days: own.keep_days,
            own_quota_gb: own.quota_gb,
        }
    }
}

/// Refuses rules that would keep nothing, and numbers that are none.
fn check(policy: &Policy) -> Result<()> {
    for (name, value, most, unit) in
        [("keep_days", policy.keep_days, MOST_DAYS, "days"), ("quota_gb", policy.quota_gb, MOST_GB, "GB")]
    {
        if let Some(value) = value.filter(|v| !(*v > 0.0 && *v <= most)) {
            let expected = format!("above 0 and up to {most} {unit}, or null where it does not matter");
            return Err(Error::field(name, format!("{name} is {value}"), expected));
        }
    }
    Ok(())
}

/// Stores rules for every server (`None`: each server's flags hold again), where the rules still have one of these
/// versions; any version will do where nothing is said. `who` is written down with it.
pub async fn store(db: &Db, policy: Option<Policy>, versions: Option<&[String]>, who: &str) -> Result<()> {
    if let Some(policy) = &policy {
        check(policy)?;
    }
    retried(ANSWER_PATIENCE, || try_store(db, policy, versions, who)).await
}

async fn try_store(db: &Db, policy: Option<Policy>, versions: Option<&[String]>, who: &str) -> Result<()> {
    let t = db.write().await?;
    let before = retention_rules::Entity::find_by_id(ROW).lock_exclusive().one(&*t).await?;
    let version = before.as_ref().map_or(0, |row| row.version);
    if versions.is_some_and(|versions| !versions.contains(&version.to_string())) {
        let found = format!("the rules of keeping have changed since they were read: they have version {version}");
        return Err(Error::Changed(found));
    }
    let row = retention_rules::ActiveModel {
        id: Set(ROW),
        keep_days: Set(policy.and_then(|p| p.keep_days)),
        quota_gb: Set(policy.and_then(|p| p.quota_gb)),
        stored: Set(i32::from(policy.is_some())),
        version: Set(version + 1),
        changed_ms: Set(now_ms()),
        changed_by: Set(who.into()),
    };
    match before {
        Some(_) => {
            retention_rules::Entity::update(row).exec(&*t).await?;
        }
        None => {
            let keep = OnConflict::column(retention_rules::Column::Id).do_nothing().to_owned();
            let made =
                retention_rules::Entity::insert(row).on_conflict(keep).try_insert().exec_without_returning(&*t).await?;
            if !matches!(made, TryInsertResult::Inserted(_)) {
                return Err(Error::Changed("the rules of keeping were stored by somebody else just now".into()));
            }
        }
    }
    t.commit().await
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::db::DatabasePlace;

    const OWN: Policy = Policy { keep_days: Some(30.0), quota_gb: None };

    #[tokio::test]
    async fn stored_rules_hold_until_they_are_given_up_and_never_over_what_was_not_seen() {
        let folder = tempfile::tempdir().expect("folder");
        let db = Db::open(&DatabasePlace::Sqlite(folder.path().join("stria.db"))).await.expect("opens");
        let first = Holding::now(&db, OWN).await.expect("reads");
        assert_eq!(first, Holding { policy: OWN, version: 0, stored: false, changed: None });

        let wanted = Policy { keep_days: None, quota_gb: Some(2.5) };
        store(&db, Some(wanted), Some(&["0".into()]), "Ann").await.expect("stores");
        let held = Holding::now(&db, OWN).await.expect("reads");
        assert_eq!((held.policy, held.version, held.stored), (wanted, 1, true));
        assert_eq!(held.changed.expect("changed").1, "Ann");

        let late = store(&db, None, Some(&["0".into()]), "Bob").await;
        assert!(matches!(late, Err(Error::Changed(_))), "{late:?}");
        store(&db, None, None, "Bob").await.expect("gives them up");
        let own = Holding::now(&db, OWN).await.expect("reads");
        assert_eq!((own.policy, own.version, own.stored), (OWN, 2, false));
    }

    #[test]
    fn rules_that_keep_nothing_are_refused() {
        for value in [0.0, -1.0, f64::NAN, f64::INFINITY, 1e10] {
            assert!(check(&Policy { keep_days: Some(value), quota_gb: None }).is_err(), "{value}");
            assert!(check(&Policy { keep_days: None, quota_gb: Some(value) }).is_err(), "{value}");
        }
        check(&Policy { keep_days: Some(0.5), quota_gb: Some(1e9) }).expect("fits");
        check(&Policy::default()).expect("keeps all");
    }
}

//! Who may come in: tokens of programs, sessions of browsers, one-time login codes, and the log of every write.
//!
//! A server and `stria token` write the same tables, so what is revoked in one place is shut everywhere at once.

mod scope;
mod secret;

use std::time::Duration;

use sea_orm::{
    ActiveValue::Set, ColumnTrait, Condition, EntityTrait, Order, PaginatorTrait, QueryFilter, QueryOrder, QuerySelect,
};

pub use scope::{Scope, Scopes};
use secret::Secret;

use crate::db::tables::{audit, login_code, session, token};
use crate::db::{ANSWER_PATIENCE, Db, retried};
use crate::error::{Error, Result};
use crate::queue::Queue;
use crate::runs::Page;
use crate::store::sha256_of;
use crate::wire::time::{now_ms, to_text};
use crate::wire::{self, AuditLine, AuditPage};

/// How long a browser stays logged in.
pub const SESSION_TIME: Duration = Duration::from_secs(14 * 24 * 3600);
/// How long a login address can be used.
pub const LOGIN_TIME: Duration = Duration::from_secs(3600);
/// A token's last use is written at most this often, ms.
const USED_EVERY_MS: i64 = 60_000;
/// Longest name of a token, characters.
const MAX_NAME_CHARS: usize = 100;
/// How long lines of the audit log are kept, ms.
const AUDIT_KEPT_MS: i64 = 400 * 24 * 3_600_000;

/// Someone who came in.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Visitor {
    /// The token's or session's name, for logs.
    pub name: String,
    /// What identifies them among others: a token's id, or a session's hash.
    pub key: String,
    /// What they may do.
    pub scopes: Scopes,
    /// When the door shuts, ms since 1970.
    pub expires_ms: Option<i64>,
}

impl Visitor {
    /// Whoever reaches a server that was told to ask nobody.
    pub fn anyone() -> Visitor {
        Visitor { name: "anyone".into(), key: "anyone".into(), scopes: Scopes::all(), expires_ms: None }
    }
}

/// A token that was just made, with its secret.
pub struct NewToken {
    /// What is kept of it.
    pub token: wire::Token,
    /// What is shown once.
    pub secret: String,
}

/// One line for the audit log.
#[derive(Clone, Debug)]
pub struct Deed {
    /// Who.
    pub who: String,
    /// From where.
    pub address: String,
    /// The request's method.
    pub method: String,
    /// The request's path.
    pub path: String,
    /// The answer.
    pub status: u16,
    /// The request's id.
    pub request: String,
}

/// The doors.
#[derive(Clone)]
pub struct Auth {
    db: Db,
}

impl Auth {
    /// On the records.
    pub fn new(db: Db) -> Auth {
        Auth { db }
    }

    /// True where nobody could come in yet: no token, no session, no login code that still holds.
    pub async fn is_new(&self) -> Result<bool> {
        let codes = login_code::Entity::find().filter(login_code::Column::ExpiresMs.gt(now_ms()));
        Ok(token::Entity::find().count(self.db.read()).await? == 0
            && session::Entity::find().count(self.db.read()).await? == 0
            && codes.count(self.db.read()).await? == 0)
    }

    /// Whose token this is; `None` where it is nobody's any more.
    pub async fn by_token(&self, secret: &str) -> Result<Option<Visitor>> {
        let found = token::Entity::find().filter(token::Column::SecretSha256.eq(sha256_of(secret)));
        let Some(row) = found.one(self.db.read()).await? else { return Ok(None) };
        let now = now_ms();
        if !holds(&row, now) {
            return Ok(None);
        }
        if row.used_ms.is_none_or(|used| (now - used).abs() >= USED_EVERY_MS) {
            let t = self.db.write().await?;
            let change = token::ActiveModel { used_ms: Set(Some(now)), ..Default::default() };
            token::Entity::update_many().set(change).filter(token::Column::Id.eq(&row.id)).exec(&*t).await?;
            t.commit().await?;
        }
        let scopes = Scopes::parse(&row.scopes)?;
        Ok(Some(Visitor { name: row.name, key: row.id, scopes, expires_ms: row.expires_ms }))
    }

    /// Whose session this is; `None` where it is nobody's any more.
    pub async fn by_session(&self, secret: &str) -> Result<Option<Visitor>> {
        let hash = sha256_of(secret);
        let Some(row) = session::Entity::find_by_id(&hash).one(self.db.read()).await? else { return Ok(None) };
        let now = now_ms();
        let token_holds = match &row.token_id {
            None => true,
            Some(id) => token::Entity::find_by_id(id).one(self.db.read()).await?.is_some_and(|t| holds(&t, now)),
        };
        if row.expires_ms <= now || !token_holds {
            return Ok(None);
        }
        let scopes = Scopes::parse(&row.scopes)?;
        Ok(Some(Visitor { name: row.name, key: hash, scopes, expires_ms: Some(row.expires_ms) }))
    }

    /// Makes a token.
    pub async fn create_token(&self, name: &str, scopes: &Scopes, expires_ms: Option<i64>) -> Result<NewToken> {
        let name = name.trim();
        if name.is_empty() || name.chars().count() > MAX_NAME_CHARS || name.chars().any(char::is_control) {
            let expected = format!("1 to {MAX_NAME_CHARS} characters without control characters");
            return Err(Error::field("name", format!("the token's name is {name:?}"), expected));
        }
        if let Some(ms) = expires_ms
            && ms <= now_ms()
        {
            return Err(Error::field("expires_at", format!("{} is over", to_text(ms)), "a time to come"));
        }
        let secret = Secret::for_token()?;
        let row = token::Model {
            id: Queue::new_id(),
            name: name.into(),
            secret_sha256: secret.hash(),
            scopes: scopes.to_text(),
            created_ms: now_ms(),
            expires_ms,
            used_ms: None,
            revoked_ms: None,
        };
        retried(ANSWER_PATIENCE, || self.insert_token(&row)).await?;
        Ok(NewToken { token: token_of(row)?, secret: secret.into_text() })
    }

    async fn insert_token(&self, row: &token::Model) -> Result<()> {
        let t = self.db.write().await?;
        token::Entity::insert(token::ActiveModel::from(row.clone())).exec_without_returning(&*t).await?;
        t.commit().await
    }

    /// A successor for a token, with the same name and scopes; the old one goes on for the overlap.
    pub async fn rotate_token(&self, id: &str, overlap: Duration) -> Result<NewToken> {
        let row = self.token_row(id).await?;
        if !holds(&row, now_ms()) {
            return Err(Error::Conflict("the token is no longer valid; make a new one".into()));
        }
        let lifetime_ms = row.expires_ms.map(|ms| ms - row.created_ms);
        let scopes = Scopes::parse(&row.scopes)?;
        let new = self.create_token(&row.name, &scopes, lifetime_ms.map(|ms| now_ms() + ms)).await?;
        let overlap_ms = i64::try_from(overlap.as_millis()).unwrap_or(i64::MAX);
        let until = now_ms().saturating_add(overlap_ms);
        let until = row.expires_ms.map_or(until, |ms| ms.min(until));
        let change = token::ActiveModel { expires_ms: Set(Some(until)), ..Default::default() };
        retried(ANSWER_PATIENCE, || self.change_token(id, change.clone())).await?;
        Ok(new)
    }

    /// Shuts a token out, with the sessions that it opened.
    pub async fn revoke_token(&self, id: &str) -> Result<wire::Token> {
        let row = self.token_row(id).await?;
        if row.revoked_ms.is_none() {
            let change = token::ActiveModel { revoked_ms: Set(Some(now_ms())), ..Default::default() };
            retried(ANSWER_PATIENCE, || self.change_token(id, change.clone())).await?;
        }
        token_of(self.token_row(id).await?)
    }

    async fn change_token(&self, id: &str, change: token::ActiveModel) -> Result<()> {
        let t = self.db.write().await?;
        token::Entity::update_many().set(change).filter(token::Column::Id.eq(id)).exec(&*t).await?;
        t.commit().await
    }

    async fn token_row(&self, id: &str) -> Result<token::Model> {
        let found = token::Entity::find_by_id(id).one(self.db.read()).await?;
        found.ok_or_else(|| Error::NotFound { what: "token", id: id.into() })
    }

    /// Tokens, the newest first, without their secrets.
    pub async fn tokens(&self, page: &Page) -> Result<wire::TokenPage> {
        let mut query = token::Entity::find().order_by(token::Column::Id, Order::Desc).limit(page.limit + 1);
        if let Some(cursor) = &page.cursor {
            query = query.filter(token::Column::Id.lt(cursor.as_str()));
        }
        let mut rows = query.all(self.db.read()).await?;
        let next_cursor = page.next(&mut rows, |r| r.id.clone());
        Ok(wire::TokenPage { items: rows.into_iter().map(token_of).collect::<Result<_>>()?, next_cursor })
    }

    /// A code that logs one browser in, once.
    pub async fn create_login(&self, name: &str, scopes: &Scopes) -> Result<String> {
        let secret = Secret::new()?;
        let row = login_code::Model {
            secret_sha256: secret.hash(),
            name: name.into(),
            scopes: scopes.to_text(),
            expires_ms: now_ms() + LOGIN_TIME.as_millis() as i64,
        };
        let t = self.db.write().await?;
        login_code::Entity::insert(login_code::ActiveModel::from(row)).exec_without_returning(&*t).await?;
        t.commit().await?;
        Ok(secret.into_text())
    }

    /// A session for a login code, which is used up, or for a token; its secret.
    pub async fn log_in(&self, secret: &str) -> Result<Option<(String, Visitor)>> {
        retried(ANSWER_PATIENCE, || self.try_log_in(secret)).await
    }

    async fn try_log_in(&self, secret: &str) -> Result<Option<(String, Visitor)>> {
        let (hash, now) = (sha256_of(secret), now_ms());
        let t = self.db.write().await?;
        let code = login_code::Entity::find_by_id(&hash).lock_exclusive().one(&*t).await?;
        let (name, scopes, token_id) = match code {
            Some(code) => {
                login_code::Entity::delete_by_id(&hash).exec(&*t).await?;
                if code.expires_ms <= now {
                    t.commit().await?;
                    return Ok(None);
                }
                (code.name, code.scopes, None)
            }
            None => {
                let found = token::Entity::find().filter(token::Column::SecretSha256.eq(&hash)).one(&*t).await?;
                let Some(row) = found.filter(|row| holds(row, now)) else { return Ok(None) };
                (row.name, row.scopes, Some(row.id))
            }
        };
        let session = Secret::new()?;
        let expires_ms = now + SESSION_TIME.as_millis() as i64;
        let row = session::Model {
            secret_sha256: session.hash(),
            token_id,
            name: name.clone(),
            scopes: scopes.clone(),
            created_ms: now,
            expires_ms,
        };
        let key = row.secret_sha256.clone();
        session::Entity::insert(session::ActiveModel::from(row)).exec_without_returning(&*t).await?;
        t.commit().await?;
        let visitor = Visitor { name, key, scopes: Scopes::parse(&scopes)?, expires_ms: Some(expires_ms) };
        Ok(Some((session.into_text(), visitor)))
    }

    /// Ends a session.
    pub async fn log_out(&self, secret: &str) -> Result<()> {
        let t = self.db.write().await?;
        session::Entity::delete_by_id(sha256_of(secret)).exec(&*t).await?;
        t.commit().await
    }

    /// Adds a line to the audit log.
    pub async fn write_down(&self, deed: &Deed) -> Result<()> {
        let id = Queue::new_id();
        retried(ANSWER_PATIENCE, || self.insert_deed(&id, deed)).await
    }

    async fn insert_deed(&self, id: &str, deed: &Deed) -> Result<()> {
        let row = audit::ActiveModel {
            id: Set(id.into()),
            at_ms: Set(now_ms()),
            who: Set(deed.who.clone()),
            address: Set(deed.address.clone()),
            method: Set(deed.method.clone()),
            path: Set(deed.path.clone()),
            status: Set(deed.status.into()),
            request: Set(deed.request.clone()),
        };
        let t = self.db.write().await?;
        audit::Entity::insert(row).exec_without_returning(&*t).await?;
        t.commit().await
    }

    /// The audit log, the newest line first.
    pub async fn audit(&self, page: &Page) -> Result<AuditPage> {
        let mut query = audit::Entity::find().order_by(audit::Column::Id, Order::Desc).limit(page.limit + 1);
        if let Some(cursor) = &page.cursor {
            query = query.filter(audit::Column::Id.lt(cursor.as_str()));
        }
        let mut rows = query.all(self.db.read()).await?;
        let next_cursor = page.next(&mut rows, |r| r.id.clone());
        let of = |r: audit::Model| AuditLine {
            id: r.id,
            at: to_text(r.at_ms),
            who: r.who,
            address: r.address,
            method: r.method,
            path: r.path,
            status: u16::try_from(r.status).unwrap_or(0),
            request: r.request,
        };
        Ok(AuditPage { items: rows.into_iter().map(of).collect(), next_cursor })
    }

    /// Forgets what is over: sessions, login codes, old lines of the audit log.
    pub async fn forget(&self) -> Result<()> {
        let now = now_ms();
        let over = Condition::all().add(audit::Column::AtMs.lt(now - AUDIT_KEPT_MS));
        let t = self.db.write().await?;
        session::Entity::delete_many().filter(session::Column::ExpiresMs.lte(now)).exec(&*t).await?;
        login_code::Entity::delete_many().filter(login_code::Column::ExpiresMs.lte(now)).exec(&*t).await?;
        audit::Entity::delete_many().filter(over).exec(&*t).await?;
        t.commit().await
    }
}

fn holds(row: &token::Model, now: i64) -> bool {
    row.revoked_ms.is_none() && row.expires_ms.is_none_or(|ms| ms > now)
}

fn token_of(row: token::Model) -> Result<wire::Token> {
    Ok(wire::Token {
        valid: holds(&row, now_ms()),
        scopes: Scopes::parse(&row.scopes)?.list(),
        id: row.id,
        name: row.name,
        created_at: to_text(row.created_ms),
        expires_at: row.expires_ms.map(to_text),
        used_at: row.used_ms.map(to_text),
        revoked_at: row.revoked_ms.map(to_text),
    })
}

#[cfg(test)]
mod tests;

//! The doors' promises, on a real database.

use super::*;
use crate::db::DatabasePlace;

async fn doors() -> (Auth, tempfile::TempDir) {
    let folder = tempfile::tempdir().expect("folder");
    let db = Db::open(&DatabasePlace::Sqlite(folder.path().join("stria.db"))).await.expect("opens");
    (Auth::new(db), folder)
}

#[tokio::test]
async fn a_token_opens_until_it_is_revoked_or_over() {
    let (auth, folder) = doors().await;
    assert!(auth.is_new().await.expect("asks"));
    let scopes = Scopes::parse("ingest").expect("one");
    let made = auth.create_token("robot 3", &scopes, None).await.expect("makes");
    assert!(made.secret.starts_with("stria_") && made.secret.len() > 40 && !auth.is_new().await.expect("asks"));
    let visitor = auth.by_token(&made.secret).await.expect("asks").expect("opens");
    assert_eq!((visitor.name.as_str(), visitor.scopes), ("robot 3", scopes.clone()));
    let kept = std::fs::read(folder.path().join("stria.db-wal")).expect("the log of SQLite");
    let secret = made.secret.as_bytes();
    assert!(!kept.windows(secret.len()).any(|w| w == secret), "the secret itself is nowhere on disk");
    assert!(auth.by_token("stria_another").await.expect("asks").is_none());

    let page = Page::new(None, None).expect("a page");
    assert!(auth.tokens(&page).await.expect("lists").items[0].used_at.is_some());
    auth.revoke_token(&made.token.id).await.expect("revokes");
    assert!(auth.by_token(&made.secret).await.expect("asks").is_none());
    assert!(auth.create_token("late", &scopes, Some(now_ms() - 1)).await.is_err());
    let short = auth.create_token("short", &scopes, Some(now_ms() + 50)).await.expect("makes");
    tokio::time::sleep(Duration::from_millis(80)).await;
    assert!(auth.by_token(&short.secret).await.expect("asks").is_none());
}

#[tokio::test]
async fn rotation_overlaps() {
    let (auth, _folder) = doors().await;
    let old = auth.create_token("robot", &Scopes::parse("ingest").expect("one"), None).await.expect("makes");
    let new = auth.rotate_token(&old.token.id, Duration::from_millis(300)).await.expect("rotates");
    for secret in [&old.secret, &new.secret] {
        assert!(auth.by_token(secret).await.expect("asks").is_some());
    }
    tokio::time::sleep(Duration::from_millis(350)).await;
    assert!(auth.by_token(&old.secret).await.expect("asks").is_none());
    assert!(auth.by_token(&new.secret).await.expect("asks").is_some());
    assert!(matches!(auth.rotate_token(&old.token.id, Duration::ZERO).await, Err(Error::Conflict(_))));
}

#[tokio::test]
async fn a_login_code_opens_once_and_a_session_ends_with_its_token() {
    let (auth, _folder) = doors().await;
    let code = auth.create_login("first start", &Scopes::all()).await.expect("makes");
    let (session, visitor) = auth.log_in(&code).await.expect("asks").expect("opens");
    assert!(visitor.scopes.allow(Scope::Admin));
    assert!(auth.log_in(&code).await.expect("asks").is_none(), "only once");
    assert_eq!(auth.by_session(&session).await.expect("asks"), Some(visitor));
    assert!(auth.by_token(&session).await.expect("asks").is_none(), "a session is no token");
    auth.log_out(&session).await.expect("ends");
    assert!(auth.by_session(&session).await.expect("asks").is_none());

    let token = auth.create_token("desk", &Scopes::parse("read").expect("one"), None).await.expect("makes");
    let (session, _) = auth.log_in(&token.secret).await.expect("asks").expect("opens");
    assert!(auth.by_session(&session).await.expect("asks").is_some());
    auth.revoke_token(&token.token.id).await.expect("revokes");
    assert!(auth.by_session(&session).await.expect("asks").is_none());
}

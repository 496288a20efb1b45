//! The store's promises in a folder; `tests/cluster.rs` asks the same of S3.

use super::*;

fn opened(dir: &tempfile::TempDir) -> Store {
    Store::open(&StorePlace::Folder(dir.path().join("store"))).expect("opens")
}

async fn read(store: &Store, key: &Key, range: Range<u64>) -> Vec<u8> {
    let chunks: Vec<Bytes> = store.read(key, range).await.expect("opens").try_collect().await.expect("reads");
    chunks.concat()
}

#[tokio::test]
async fn files_come_back_by_range_and_go_by_prefix() {
    let dir = tempfile::tempdir().expect("folder");
    let store = opened(&dir);
    let name = ProductName::new("tiles/0.png").expect("plain");
    let (moved, copied) = (Key::product("job", 1, &name), Key::segment("job", 1, 0));
    let file = dir.path().join("made");
    std::fs::write(&file, b"0123456789").expect("writes");
    let facts = store.copy_file(&file, &copied).await.expect("copies");
    assert_eq!(facts, facts_of(&file).expect("reads"));
    let other = Facts { bytes: 10, sha256: sha256_of("another") };
    assert!(store.take_file(&file, &moved, &other).await.is_err(), "a file that is not what it should be");
    assert!(store.size(&moved).await.is_err());
    store.take_file(&file, &moved, &facts).await.expect("moves");
    store.sync().await.expect("syncs");
    assert!(!file.exists());
    for key in [&moved, &copied] {
        for (range, expected) in [(0..10, "0123456789"), (3..5, "34"), (9..10, "9"), (4..4, "")] {
            assert_eq!(read(&store, key, range).await, expected.as_bytes());
        }
    }
    let own = store.local_copy(&moved, &facts, dir.path()).await.expect("is there");
    assert!(own.starts_with(dir.path().join("store")), "a folder's file needs no copy");
    store.delete_prefix(&attempt_prefix("job", 2)).await.expect("nothing there is no error");
    store.delete_prefix(&attempt_prefix("job", 1)).await.expect("deletes");
    assert!(store.size(&moved).await.is_err() && store.size(&copied).await.is_err());
    assert!(!dir.path().join("store/jobs").exists(), "empty folders go too");
}

#[tokio::test]
async fn parts_become_a_file_in_their_order() {
    let dir = tempfile::tempdir().expect("folder");
    let store = opened(&dir);
    let key = Key::upload("u");
    let name = store.begin_parts(&key).await.expect("begins");
    // Another process goes on with it, and one part comes twice.
    let other = opened(&dir);
    let second = other.put_part(&key, &name, 1, Bytes::from_static(b"world")).await.expect("puts");
    store.put_part(&key, &name, 0, Bytes::from_static(b"half")).await.expect("puts");
    let first = store.put_part(&key, &name, 0, Bytes::from_static(b"hello ")).await.expect("puts");
    assert!(store.size(&key).await.is_err(), "not there before its end");
    store.finish_parts(&key, &name, vec![first, second]).await.expect("ends");
    assert_eq!(store.get_bytes(&key, 100).await.expect("reads"), "hello world");
    assert!(store.get_bytes(&key, 5).await.is_err(), "larger than asked for");
    let listed: Vec<_> = store.list(&upload_prefix("u")).try_collect().await.expect("lists");
    assert_eq!(listed, [(key.clone(), 11)], "the parts are gone");

    let name = store.begin_parts(&key).await.expect("begins");
    store.put_part(&key, &name, 0, Bytes::from_static(b"x")).await.expect("puts");
    store.drop_parts(&key, &name).await.expect("gives up");
    assert_eq!(store.get_bytes(&key, 100).await.expect("reads"), "hello world", "what is there stays");
}

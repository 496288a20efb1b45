//! What a child made → the store, checked; the records follow in one transaction (`Queue::finish`).

use std::path::{Component, Path, PathBuf};

use futures::stream::{StreamExt, TryStreamExt};
use stria_core::defects::DefectList;
use stria_core::export::defect_list;
use stria_core::export::manifest::{FileEntry, Manifest};

use super::Worker;
use super::scratch::Scratch;
use crate::error::{Error, Result};
use crate::metrics::{Stage, metrics};
use crate::queue::{Lease, Outcome, PublishedProduct};
use crate::store::{Facts, Key, ProductName, facts_of};

/// Products on their way into the store at the same time: to S3, waiting costs more than sending.
const FILES_AT_ONCE: usize = 8;

/// A list of defects larger than this is none of ours: a hundred thousand take a tenth of it.
const MAX_LIST_BYTES: u64 = 512 * 1024 * 1024;

/// The list of the products is a product itself, and the only one that cannot list its own hash.
const MANIFEST: &str = "manifest.json";

/// Puts every product into the store under the attempt's own keys.
pub(super) async fn store(worker: &Worker, lease: &Lease, scratch: &Scratch, manifest: Manifest) -> Result<Outcome> {
    let out = scratch.out();
    let path = out.join(MANIFEST);
    let own = tokio::task::spawn_blocking(move || facts_of(&path).map_err(|e| Error::io(path, e)))
        .await
        .map_err(|e| Error::Internal(format!("reading the manifest stopped: {e}")))??;
    let listed = manifest.products.into_iter().filter(|p| p.name != MANIFEST);
    let mut products = vec![PublishedProduct { name: name(MANIFEST)?, facts: own }];
    for FileEntry { name: text, bytes, sha256 } in listed {
        products.push(PublishedProduct { name: name(&text)?, facts: Facts { bytes, sha256 } });
    }
    // A person looks for the files first; the tiles are for programs.
    products.sort_by_key(|p| p.name.as_str().contains('/'));
    let defects = defects(&products, &out).await?;
    // As a list: the compiler cannot tell that a closure's futures may go from thread to thread.
    let into_store: Vec<_> = products.iter().map(|product| put(worker, lease, &out, product)).collect();
    futures::stream::iter(into_store).buffer_unordered(FILES_AT_ONCE).try_collect::<()>().await?;
    worker.store.sync().await?;
    for (stage, seconds) in &manifest.timings_s {
        metrics().stage_s.get_or_create(&Stage { stage: stage.clone() }).observe(*seconds);
    }
    metrics().frames.inc_by(manifest.quality.frames);
    let quality = serde_json::to_value(&manifest.quality).map_err(|e| Error::Internal(format!("quality: {e}")))?;
    Ok(Outcome { products, warnings: manifest.warnings, quality, frames: manifest.quality.frames, defects })
}

/// The list of defects, where there is one: read before it goes into the store.
async fn defects(products: &[PublishedProduct], out: &Path) -> Result<Option<Box<DefectList>>> {
    let Some(listed) = products.iter().find(|p| p.name.as_str() == defect_list::JSON_NAME) else { return Ok(None) };
    if listed.facts.bytes > MAX_LIST_BYTES {
        let found = format!("{} has {} bytes", defect_list::JSON_NAME, listed.facts.bytes);
        return Err(Error::Internal(format!("{found}; at most {MAX_LIST_BYTES} are read")));
    }
    check_plain_file(out, &out.join(defect_list::JSON_NAME), listed.facts.bytes).await?;
    let folder: PathBuf = out.into();
    let read = tokio::task::spawn_blocking(move || defect_list::load(&folder)).await;
    let read = read.map_err(|e| Error::Internal(format!("reading the list of defects stopped: {e}")))?;
    read.map(|list| Some(Box::new(list))).map_err(|e| Error::Internal(format!("the child's list of defects: {e}")))
}

/// Checks a product and puts it into the store.
async fn put(worker: &Worker, lease: &Lease, out: &Path, product: &PublishedProduct) -> Result<()> {
    let file = out.join(product.name.as_str());
    check_plain_file(out, &file, product.facts.bytes).await?;
    let key = Key::product(&lease.job, lease.fence, &product.name);
    worker.store.take_file(&file, &key, &product.facts).await
}

/// Puts a recording segment into the store while the child goes on.
pub(super) async fn segment(worker: &Worker, lease: &Lease, scratch: &Scratch, number: u32, path: &str) -> Result<()> {
    let inside = Path::new(path).components().all(|c| matches!(c, Component::Normal(_)));
    if !inside {
        return Err(Error::Internal(format!("the child named a segment outside its folder: {path:?}")));
    }
    let file = scratch.out().join(path);
    let bytes = tokio::fs::symlink_metadata(&file).await.map_err(|e| Error::io(&file, e))?.len();
    if bytes > worker.limits.segment_bytes {
        let most = worker.limits.segment_bytes;
        return Err(Error::Internal(format!("recording segment {number} has {bytes} bytes; at most {most} are taken")));
    }
    let facts = worker.store.copy_file(&file, &Key::segment(&lease.job, lease.fence, number)).await?;
    worker.queue.segment(lease, number, &facts).await
}

fn name(text: &str) -> Result<ProductName> {
    ProductName::new(text).ok_or_else(|| Error::Internal(format!("the child named a product {text:?}")))
}

/// A product is a file of the listed size, and no link to somewhere else.
async fn check_plain_file(out: &Path, file: &Path, bytes: u64) -> Result<()> {
    let facts = tokio::fs::symlink_metadata(file).await.map_err(|e| Error::io(file, e))?;
    if facts.is_file() && facts.len() == bytes {
        return Ok(());
    }
    let name = file.strip_prefix(out).unwrap_or(file).display();
    Err(Error::Internal(format!("{name} is not the file of {bytes} bytes that the manifest lists")))
}

//! A job on a server, for `stria export`.

use std::io::Write;
use std::path::Path;
use std::time::Duration;

use reqwest::Url;
use reqwest::blocking::{Client, Response};
use serde_json::Value;
use stria_core::export::manifest::{FileEntry, sha256_of_file};
use stria_core::export::new_file::NewFile;

use super::super::Failed;
use crate::wire::Direction;

/// Longest time to a server's first word.
const ANSWER: Duration = Duration::from_secs(60);
/// Longest silence in the middle of a file.
const SILENCE: Duration = Duration::from_secs(120);
/// Items of a page.
const PAGE: usize = 1000;

/// A job that the server has.
pub(super) struct RemoteJob {
    client: Client,
    job: Url,
    /// Chainage of its run's first frame, mm.
    pub chainage_mm: f64,
    /// Which way its run went.
    pub direction: Direction,
}

impl RemoteJob {
    /// Asks the server for a job and its run.
    pub(super) fn find(server: &Url, id: &str) -> Result<RemoteJob, Failed> {
        let client = Client::builder().connect_timeout(ANSWER).timeout(SILENCE).build();
        let client = client.map_err(|e| Failed::Other(format!("the HTTP client did not start: {e}")))?;
        let address = |path: &str| {
            server.join(path).map_err(|e| Failed::Input(format!("--server {server}: {e}; expected http://HOST:PORT")))
        };
        let job = address(&format!("/api/jobs/{id}/"))?;
        let facts = json(get(&client, address(&format!("/api/jobs/{id}"))?)?)?;
        let run = facts["run"].as_str().unwrap_or_default();
        let run = json(get(&client, address(&format!("/api/runs/{run}"))?)?)?;
        let direction = run["direction"].as_str().and_then(Direction::parse).unwrap_or_default();
        Ok(RemoteJob { client, job, chainage_mm: run["chainage_mm"].as_f64().unwrap_or(0.0), direction })
    }

    fn address(&self, path: &str) -> Result<Url, Failed> {
        self.job.join(path).map_err(|e| Failed::Other(format!("{path}: {e}")))
    }

    /// Downloads one file of the job.
    pub(super) fn download(&self, path: &str, to: &Path) -> Result<(), Failed> {
        let address = self.address(path)?;
        let mut response = get(&self.client, address.clone())?;
        let mut file = NewFile::create(to)?;
        response.copy_to(&mut file).map_err(|e| Failed::Other(format!("{address}: {}", cause(&e))))?;
        file.flush().map_err(|e| stria_core::Error::io(to, e))?;
        file.commit()?;
        Ok(())
    }

    /// Downloads the products that are needed into a folder, and checks their hashes.
    pub(super) fn fetch(&self, needed: &[&str], folder: &Path) -> Result<(), Failed> {
        let wanted = |name: &str| needed.iter().any(|n| name == *n || (n.ends_with('/') && name.starts_with(n)));
        for product in self.products()?.into_iter().filter(|product| wanted(&product.name)) {
            let path = folder.join(&product.name);
            let inside = path.strip_prefix(folder).is_ok_and(|p| p.components().all(|c| c.as_os_str() != ".."));
            if !inside {
                return Err(Failed::Other(format!("the server names a product {:?}", product.name)));
            }
            if let Some(parent) = path.parent() {
                std::fs::create_dir_all(parent).map_err(|e| stria_core::Error::io(parent, e))?;
            }
            self.download(&format!("products/{}", product.name), &path)?;
            if sha256_of_file(&path)? != product.sha256 {
                return Err(Failed::Other(format!("{}: other bytes than the server lists", product.name)));
            }
        }
        Ok(())
    }

    fn products(&self) -> Result<Vec<FileEntry>, Failed> {
        let (mut all, mut cursor) = (Vec::new(), None::<String>);
        loop {
            let more = cursor.map_or_else(String::new, |cursor| format!("&cursor={cursor}"));
            let page = json(get(&self.client, self.address(&format!("products?limit={PAGE}{more}"))?)?)?;
            for item in page["items"].as_array().into_iter().flatten() {
                let product: FileEntry = serde_json::from_value(item.clone())
                    .map_err(|e| Failed::Other(format!("the server's list of products: {e}")))?;
                all.push(product);
            }
            match page["next_cursor"].as_str() {
                Some(next) => cursor = Some(next.to_string()),
                None => return Ok(all),
            }
        }
    }
}

fn get(client: &Client, address: Url) -> Result<Response, Failed> {
    let response = client.get(address.clone()).send();
    let response = response.map_err(|e| Failed::Other(format!("{address}: {}", cause(&e))))?;
    let status = response.status();
    if status.is_success() {
        return Ok(response);
    }
    let problem: Value = response.json().unwrap_or_default();
    let detail = problem["detail"].as_str().map_or_else(|| status.to_string(), String::from);
    let message = format!("the server refuses ({status}): {detail}");
    Err(if status.is_client_error() { Failed::Input(message) } else { Failed::Other(message) })
}

fn json(response: Response) -> Result<Value, Failed> {
    let address = response.url().clone();
    response.json().map_err(|e| Failed::Other(format!("{address}: {}", cause(&e))))
}

/// The innermost cause says most: "connection refused" instead of "error sending request".
fn cause(error: &reqwest::Error) -> String {
    let mut inner: &dyn std::error::Error = error;
    while let Some(next) = inner.source() {
        inner = next;
    }
    inner.to_string()
}

//! Where the files are, as `--store` says it.

use std::fmt;
use std::path::PathBuf;
use std::time::Duration;

use object_store::aws::{AmazonS3, AmazonS3Builder};
use object_store::{BackoffConfig, ClientOptions, RetryConfig};

use crate::error::{Error, Result};

/// S3 gives no byte for this long: the request is broken off and tried again.
const SILENCE: Duration = Duration::from_secs(30);
/// A connection to S3 is made within this time.
const CONNECT: Duration = Duration::from_secs(5);

/// Where the files are.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum StorePlace {
    /// A folder.
    Folder(PathBuf),
    /// A bucket on S3, and a prefix in it (perhaps empty).
    Bucket {
        /// Its name.
        bucket: String,
        /// What stands before every key, without `/` at either end.
        prefix: String,
    },
}

impl StorePlace {
    /// Reads `s3://BUCKET/PREFIX`, or a folder.
    pub fn parse(text: &str) -> Result<StorePlace> {
        let bad = || {
            let expected = "a folder, or s3://BUCKET/PREFIX with the AWS_* variables set";
            Error::field("--store", format!("--store is {text:?}"), expected)
        };
        if let Some(rest) = text.strip_prefix("s3://") {
            let (bucket, prefix) = rest.split_once('/').unwrap_or((rest, ""));
            if bucket.is_empty() {
                return Err(bad());
            }
            return Ok(StorePlace::Bucket { bucket: bucket.into(), prefix: prefix.trim_matches('/').into() });
        }
        let folder = text.strip_prefix("file://").unwrap_or(text);
        if folder.is_empty() || folder.contains("://") {
            return Err(bad());
        }
        Ok(StorePlace::Folder(folder.into()))
    }
}

impl fmt::Display for StorePlace {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            StorePlace::Folder(path) => write!(f, "{}", path.display()),
            StorePlace::Bucket { bucket, prefix } if prefix.is_empty() => write!(f, "s3://{bucket}"),
            StorePlace::Bucket { bucket, prefix } => write!(f, "s3://{bucket}/{prefix}"),
        }
    }
}

/// The client of a bucket. Keys, region and endpoint come from the environment under their usual names
/// (`AWS_ACCESS_KEY_ID`, `AWS_SECRET_ACCESS_KEY`, `AWS_REGION`, `AWS_ENDPOINT`, `AWS_ALLOW_HTTP` …).
pub(super) fn s3(bucket: &str) -> Result<AmazonS3> {
    // A whole transfer may take long; only silence is an end.
    let options = ClientOptions::new().with_timeout_disabled().with_connect_timeout(CONNECT).with_read_timeout(SILENCE);
    let mut builder = AmazonS3Builder::new().with_client_options(options);
    for (name, value) in std::env::vars() {
        if name.starts_with("AWS_")
            && let Ok(key) = name.to_ascii_lowercase().parse()
        {
            builder = builder.with_config(key, value);
        }
    }
    let built = builder.with_bucket_name(bucket).with_retry(retry()).build();
    built.map_err(|e| Error::field("--store", format!("s3://{bucket}: {e}"), "the AWS_* variables of an S3 service"))
}

/// An S3 that is away for a minute or two costs nothing but time.
fn retry() -> RetryConfig {
    let backoff =
        BackoffConfig { init_backoff: Duration::from_millis(100), max_backoff: Duration::from_secs(5), base: 2.0 };
    RetryConfig { backoff, max_retries: 1000, retry_timeout: Duration::from_secs(180) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_are_read() {
        let bucket = |bucket: &str, prefix: &str| StorePlace::Bucket { bucket: bucket.into(), prefix: prefix.into() };
        for (text, place) in [
            ("s3://walls", bucket("walls", "")),
            ("s3://walls/", bucket("walls", "")),
            ("s3://walls/a/b/", bucket("walls", "a/b")),
            ("file:///data/store", StorePlace::Folder("/data/store".into())),
            ("data/store", StorePlace::Folder("data/store".into())),
        ] {
            assert_eq!(StorePlace::parse(text).expect(text), place);
        }
        for bad in ["", "s3://", "s3:///x", "gs://walls", "file://"] {
            assert!(StorePlace::parse(bad).is_err(), "{bad}");
        }
    }
}

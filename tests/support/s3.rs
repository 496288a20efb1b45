//! S3 on a folder, served inside the test by a program that we did not write. It can be taken away and brought back.

use std::net::{SocketAddr, TcpListener};
use std::path::PathBuf;

use hyper_util::rt::TokioIo;
use s3s::auth::SimpleAuth;
use s3s::service::{S3Service, S3ServiceBuilder};
use tempfile::TempDir;
use tokio::runtime::Runtime;

/// The bucket that is there.
pub const BUCKET: &str = "walls";
const ACCESS_KEY: &str = "robot";
const SECRET_KEY: &str = "a secret of the tests";

/// A running (or stopped) S3.
pub struct S3 {
    folder: TempDir,
    address: SocketAddr,
    runtime: Option<Runtime>,
}

impl S3 {
    /// Starts it on a new folder, with one bucket.
    ///
    /// # Panics
    /// Where it does not start.
    pub fn start() -> S3 {
        let folder = tempfile::Builder::new().prefix("stria-s3-").tempdir().expect("a temporary folder");
        std::fs::create_dir(folder.path().join(BUCKET)).expect("a bucket");
        let address = TcpListener::bind("127.0.0.1:0").and_then(|l| l.local_addr()).expect("a free port");
        let mut s3 = S3 { folder, address, runtime: None };
        s3.start_again();
        s3
    }

    /// Starts it (again) at its address.
    ///
    /// # Panics
    /// Where it cannot.
    pub fn start_again(&mut self) {
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build();
        let runtime = runtime.expect("a runtime");
        let files = s3s_fs::FileSystem::new(self.folder.path()).expect("a folder for S3");
        let mut builder = S3ServiceBuilder::new(files);
        builder.set_auth(SimpleAuth::from_single(ACCESS_KEY, SECRET_KEY));
        let service = builder.build();
        let listener = runtime.block_on(tokio::net::TcpListener::bind(self.address)).expect("its port is free");
        runtime.spawn(serve(listener, service));
        self.runtime = Some(runtime);
    }

    /// Takes it away: connections break, new ones are refused.
    pub fn stop_hard(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            // Waits for writes that have begun, as a disk would: what is half-written has another name.
            runtime.shutdown_timeout(std::time::Duration::from_secs(5));
        }
    }

    /// The variables under which programs find it.
    pub fn variables(&self) -> Vec<(String, String)> {
        [
            ("AWS_ACCESS_KEY_ID", ACCESS_KEY.into()),
            ("AWS_SECRET_ACCESS_KEY", SECRET_KEY.into()),
            ("AWS_REGION", "us-east-1".into()),
            ("AWS_ENDPOINT", format!("http://{}", self.address)),
            ("AWS_ALLOW_HTTP", "true".into()),
            ("NO_PROXY", "127.0.0.1".into()),
        ]
        .map(|(name, value): (&str, String)| (name.to_string(), value))
        .to_vec()
    }

    /// The files of the bucket as they lie there.
    pub fn bucket(&self) -> PathBuf {
        self.folder.path().join(BUCKET)
    }
}

impl Drop for S3 {
    fn drop(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_background();
        }
    }
}

async fn serve(listener: tokio::net::TcpListener, service: S3Service) {
    loop {
        let Ok((stream, _)) = listener.accept().await else { continue };
        let connection =
            hyper::server::conn::http1::Builder::new().serve_connection(TokioIo::new(stream), service.clone());
        // Clients leave in all ways.
        tokio::spawn(async move { drop(connection.await) });
    }
}

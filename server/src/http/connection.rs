//! Connections: accept, serve, and let go of those who keep one without using it.

use std::io;
use std::net::SocketAddr;
use std::path::Path;
use std::pin::{Pin, pin};
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use axum::Router;
use hyper_util::rt::{TokioIo, TokioTimer};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Semaphore;
use tokio::time::{Instant, Sleep};
use tokio_rustls::TlsAcceptor;
use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer};
use tokio_rustls::rustls::{self, ServerConfig};
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;
use tower::ServiceExt;

use crate::config::RequestLimits;

/// Wait after a failed accept (out of file descriptors, say) before the next.
const ACCEPT_PAUSE: Duration = Duration::from_millis(200);

/// Who is at the other end of a connection; every request carries it.
#[derive(Clone, Copy, Debug)]
pub struct Peer(pub SocketAddr);

/// Serves until asked to stop, then lets open requests end within their grace.
pub async fn serve(
    listener: TcpListener,
    router: Router,
    limits: RequestLimits,
    tls: Option<TlsAcceptor>,
    stop: CancellationToken,
) {
    let places = Arc::new(Semaphore::new(limits.connections));
    let open = TaskTracker::new();
    loop {
        let accepted = tokio::select! {
            place = places.clone().acquire_owned() => match place {
                Ok(place) => tokio::select! {
                    accepted = listener.accept() => accepted.map(|(stream, peer)| (stream, peer, place)),
                    () = stop.cancelled() => break,
                },
                Err(_) => break,
            },
            () = stop.cancelled() => break,
        };
        let (stream, peer, place) = match accepted {
            Ok(accepted) => accepted,
            Err(error) => {
                tracing::warn!(%error, "a connection could not be accepted");
                tokio::time::sleep(ACCEPT_PAUSE).await;
                continue;
            }
        };
        let (router, limits, tls) = (router.clone(), limits.clone(), tls.clone());
        let stop = stop.clone();
        open.spawn(async move {
            if let Err(error) = answer(stream, peer, router, &limits, tls, stop).await {
                // Clients leave in all ways; that is their right and no news.
                tracing::debug!(error, %peer, "a connection ended early");
            }
            drop(place);
        });
    }
    drop(listener);
    open.close();
    let _ = tokio::time::timeout(limits.stop_grace, open.wait()).await;
}

/// One connection, to its end.
async fn answer(
    stream: TcpStream,
    peer: SocketAddr,
    router: Router,
    limits: &RequestLimits,
    tls: Option<TlsAcceptor>,
    stop: CancellationToken,
) -> std::result::Result<(), String> {
    let stream = Impatient::new(stream, limits.receiver_silence);
    match tls {
        None => talk(TokioIo::new(stream), peer, router, limits, stop).await,
        Some(tls) => {
            let shaken = tokio::time::timeout(limits.head_timeout, tls.accept(stream)).await;
            let stream = shaken.map_err(|_| "no TLS handshake in time".to_string())?.map_err(|e| e.to_string())?;
            talk(TokioIo::new(stream), peer, router, limits, stop).await
        }
    }
}

async fn talk<S>(
    stream: TokioIo<S>,
    peer: SocketAddr,
    router: Router,
    limits: &RequestLimits,
    stop: CancellationToken,
) -> std::result::Result<(), String>
where
    S: AsyncRead + AsyncWrite + Unpin + Send + 'static,
{
    let service = hyper::service::service_fn(move |mut request: hyper::Request<hyper::body::Incoming>| {
        request.extensions_mut().insert(Peer(peer));
        router.clone().oneshot(request)
    });
    let mut connection = pin!(http1(limits).serve_connection(stream, service).with_upgrades());
    let ended = tokio::select! {
        ended = connection.as_mut() => ended,
        () = stop.cancelled() => {
            // What was begun is answered; no further request is taken.
            connection.as_mut().graceful_shutdown();
            connection.await
        }
    };
    ended.map_err(|e| e.to_string())
}

fn http1(limits: &RequestLimits) -> hyper::server::conn::http1::Builder {
    let mut builder = hyper::server::conn::http1::Builder::new();
    builder.timer(TokioTimer::new()).header_read_timeout(limits.head_timeout).half_close(false);
    builder
}

/// Listens; `Err` names the address.
pub async fn listen(address: SocketAddr) -> io::Result<TcpListener> {
    TcpListener::bind(address).await
}

/// What TLS needs, from PEM files; `Err` says in words what is wrong with which.
pub fn tls(certificates: &Path, key: &Path) -> std::result::Result<TlsAcceptor, String> {
    let named = |path: &Path, e: String| format!("{}: {e}", path.display());
    let chain: Vec<CertificateDer<'static>> =
        CertificateDer::pem_file_iter(certificates)
            .and_then(Iterator::collect)
            .map_err(|e| named(certificates, format!("{e}; expected PEM certificates")))?;
    let key_der =
        PrivateKeyDer::from_pem_file(key).map_err(|e| named(key, format!("{e}; expected a PEM private key")))?;
    let provider = Arc::new(rustls::crypto::aws_lc_rs::default_provider());
    let config = ServerConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()
        .and_then(|builder| builder.with_no_client_auth().with_single_cert(chain, key_der))
        .map_err(|e| named(certificates, e.to_string()))?;
    Ok(TlsAcceptor::from(Arc::new(config)))
}

/// A stream whose peer must take what is written to it within a time.
struct Impatient {
    stream: TcpStream,
    silence: Duration,
    /// Runs while a write waits.
    waiting: Option<Pin<Box<Sleep>>>,
}

impl Impatient {
    fn new(stream: TcpStream, silence: Duration) -> Impatient {
        // Small answers go out at once. A socket that cannot do this still works.
        let _ = stream.set_nodelay(true);
        Impatient { stream, silence, waiting: None }
    }

    fn patience<T>(&mut self, cx: &mut Context<'_>, written: Poll<io::Result<T>>) -> Poll<io::Result<T>> {
        if written.is_ready() {
            self.waiting = None;
            return written;
        }
        let deadline = Instant::now() + self.silence;
        let sleep = self.waiting.get_or_insert_with(|| Box::pin(tokio::time::sleep_until(deadline)));
        ready!(sleep.as_mut().poll(cx));
        Poll::Ready(Err(io::Error::new(io::ErrorKind::TimedOut, "the receiver took nothing for too long")))
    }
}

impl AsyncRead for Impatient {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buffer: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_read(cx, buffer)
    }
}

impl AsyncWrite for Impatient {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.stream).poll_write(cx, bytes);
        self.patience(cx, written)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        parts: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.stream).poll_write_vectored(cx, parts);
        self.patience(cx, written)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(cx)
    }
}

//! Logs on stderr, as text or as one JSON object a line; traces to an OpenTelemetry collector where asked for.

use clap::{Args, ValueEnum};
use opentelemetry::trace::TracerProvider;
use opentelemetry_otlp::{SpanExporter, WithExportConfig};
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::error::OTelSdkResult;
use opentelemetry_sdk::trace::{SdkTracerProvider, Span, SpanData, SpanExporter as _, SpanProcessor};
use tokio::sync::mpsc;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{EnvFilter, Layer};

use super::Failed;

/// Ended spans that may wait for the collector; what comes beyond is dropped.
const QUEUED_SPANS: usize = 4096;
/// Spans of one export.
const SPANS_AT_ONCE: usize = 256;

/// How the process tells what it does.
#[derive(Args)]
pub(super) struct LogArgs {
    /// How log lines are written; STRIA_LOG says which (info, or like stria=debug)
    #[arg(long, value_name = "KIND", default_value = "text", env = "STRIA_LOG_FORMAT")]
    log_format: LogFormat,
    /// Send traces (OTLP over HTTP) to this collector, such as http://127.0.0.1:4318/v1/traces
    #[arg(long, value_name = "URL", env = "STRIA_TRACES")]
    traces: Option<String>,
}

#[derive(Clone, Copy, ValueEnum)]
enum LogFormat {
    Text,
    Json,
}

impl LogArgs {
    /// Begins to log; inside the async runtime, which sends the traces.
    pub(super) fn start(&self) -> Result<(), Failed> {
        use std::io::IsTerminal;
        let filter = || EnvFilter::try_from_env("STRIA_LOG").unwrap_or_else(|_| EnvFilter::new("info"));
        let lines = tracing_subscriber::fmt::layer().with_writer(std::io::stderr);
        let lines = match self.log_format {
            LogFormat::Text => lines.with_ansi(std::io::stderr().is_terminal()).with_filter(filter()).boxed(),
            LogFormat::Json => lines.json().flatten_event(true).with_filter(filter()).boxed(),
        };
        let traces = match &self.traces {
            None => None,
            Some(url) => {
                let exporter = SpanExporter::builder().with_http().with_endpoint(url).build();
                let exporter = exporter.map_err(|e| Failed::Input(format!("--traces {url}: {e}")))?;
                let provider = SdkTracerProvider::builder()
                    .with_resource(Resource::builder().with_service_name("stria").build())
                    .with_span_processor(Sender::start(exporter))
                    .build();
                let spans = EnvFilter::new("off,stria=info");
                Some(tracing_opentelemetry::layer().with_tracer(provider.tracer("stria")).with_filter(spans))
            }
        };
        // A second subscriber in one process is a test's; the first stays.
        let _ = tracing_subscriber::registry().with(lines).with(traces).try_init();
        Ok(())
    }
}

/// Hands ended spans to a task of the runtime, which sends them; nobody waits for a collector.
#[derive(Debug)]
struct Sender(mpsc::Sender<SpanData>);

impl Sender {
    fn start(exporter: SpanExporter) -> Sender {
        let (sender, mut queue) = mpsc::channel(QUEUED_SPANS);
        tokio::spawn(async move {
            let mut spans = Vec::new();
            while queue.recv_many(&mut spans, SPANS_AT_ONCE).await > 0 {
                if let Err(error) = exporter.export(std::mem::take(&mut spans)).await {
                    // Not as a span: that would be one more to send.
                    eprintln!("stria: traces could not be sent: {error}");
                }
            }
        });
        Sender(sender)
    }
}

impl SpanProcessor for Sender {
    fn on_start(&self, _span: &mut Span, _context: &opentelemetry::Context) {}

    fn on_end(&self, span: SpanData) {
        let _ = self.0.try_send(span);
    }

    fn force_flush(&self) -> OTelSdkResult {
        Ok(())
    }

    fn shutdown_with_timeout(&self, _timeout: std::time::Duration) -> OTelSdkResult {
        Ok(())
    }
}

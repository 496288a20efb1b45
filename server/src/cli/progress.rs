//! What a person sees while a job goes on: stage, frames a second, time left.

use std::time::Duration;

use indicatif::{ProgressBar, ProgressStyle};

/// Steps of the bar: a thousandth each.
const STEPS: u64 = 1000;

/// A bar on stderr; nothing where that is no terminal.
pub(super) struct JobBar(ProgressBar);

impl JobBar {
    pub(super) fn new() -> JobBar {
        let bar = ProgressBar::new(STEPS).with_style(style("{prefix:>14} [{bar:30}] {percent:>3} %  {msg}"));
        bar.enable_steady_tick(Duration::from_millis(200));
        JobBar(bar)
    }

    /// Shows how far it is.
    pub(super) fn show(
        &self,
        stage: &str,
        fraction: f64,
        frames: u64,
        frames_total: Option<u64>,
        frames_per_s: f64,
        time_left_s: Option<f64>,
    ) {
        let mut words = Vec::new();
        if frames > 0 {
            words.push(match frames_total {
                Some(total) => format!("{frames} of {total} frames"),
                None => format!("{frames} frames"),
            });
        }
        if frames_per_s > 0.0 {
            words.push(format!("{frames_per_s:.1} frames/s"));
        }
        if let Some(left_s) = time_left_s {
            words.push(format!("{} left", duration(left_s)));
        }
        self.0.set_prefix(stage.to_string());
        self.0.set_position((fraction.clamp(0.0, 1.0) * STEPS as f64) as u64);
        self.0.set_message(words.join(", "));
    }

    /// Prints a line above the bar.
    pub(super) fn say(&self, line: &str) {
        self.0.suspend(|| eprintln!("{line}"));
    }

    /// Takes the bar away.
    pub(super) fn clear(&self) {
        self.0.finish_and_clear();
    }
}

const BYTES: &str = "{prefix:>14} [{bar:30}] {percent:>3} %  {decimal_bytes} of {decimal_total_bytes}, \
                     {decimal_bytes_per_sec}, {eta} left";
const FRAMES: &str = "          live {pos} frames, {per_sec}, {msg}";

/// A bar of bytes on stderr.
pub(super) fn byte_bar(what: &'static str, bytes: u64) -> ProgressBar {
    ProgressBar::new(bytes).with_prefix(what).with_style(style(BYTES))
}

/// A line on stderr for what has no end yet.
pub(super) fn live_bar() -> ProgressBar {
    ProgressBar::no_length().with_style(style(FRAMES))
}

fn style(template: &str) -> ProgressStyle {
    // The templates are in this file and a test draws them; the default stands in for one that is broken.
    ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar()).progress_chars("█▉▊▋▌▍▎▏ ")
}

/// A time for people: `2.1 s`, `48 s`, `3 min 05 s`, `2 h 10 min`.
pub(super) fn duration(seconds: f64) -> String {
    if (0.0..9.95).contains(&seconds) {
        return format!("{seconds:.1} s");
    }
    let whole = seconds.max(0.0).round() as u64;
    match (whole / 3600, whole / 60 % 60, whole % 60) {
        (0, 0, s) => format!("{s} s"),
        (0, m, s) => format!("{m} min {s:02} s"),
        (h, m, _) => format!("{h} h {m:02} min"),
    }
}

/// A size for people, in powers of ten: `999 B`, `1.2 MB`.
pub(super) fn size(bytes: u64) -> String {
    let mut value = bytes as f64;
    for unit in ["B", "kB", "MB", "GB"] {
        if value < 999.5 {
            return if unit == "B" { format!("{bytes} B") } else { format!("{value:.1} {unit}") };
        }
        value /= 1000.0;
    }
    format!("{value:.1} TB")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn people_read_times_and_sizes() {
        assert_eq!([0.4, 48.0, 185.0, 7800.0].map(duration), ["0.4 s", "48 s", "3 min 05 s", "2 h 10 min"]);
        assert_eq!([0, 999, 1_234_567, 64_000_000_000].map(size), ["0 B", "999 B", "1.2 MB", "64.0 GB"]);
    }

    #[test]
    fn templates_are_sound() {
        for template in ["{prefix:>14} [{bar:30}] {percent:>3} %  {msg}", BYTES, FRAMES] {
            assert!(ProgressStyle::with_template(template).is_ok(), "{template}");
        }
    }
}

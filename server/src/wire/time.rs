//! Times: integer milliseconds since 1970 inside, RFC 3339 in UTC on the wire.

use jiff::Timestamp;

/// Now, ms since 1970.
pub fn now_ms() -> i64 {
    Timestamp::now().as_millisecond()
}

/// As the wire writes it, with milliseconds.
pub fn to_text(ms: i64) -> String {
    match Timestamp::from_millisecond(ms) {
        Ok(time) => format!("{time:.3}"),
        // Only times that we wrote ourselves come here; one outside the years -9999 to 9999 is none of them.
        Err(_) => format!("{:.3}", Timestamp::UNIX_EPOCH),
    }
}

/// Reads RFC 3339 (`2026-05-17T08:30:00Z`, any offset); `None` where it is not.
pub fn from_text(text: &str) -> Option<i64> {
    text.trim().parse::<Timestamp>().ok().map(|t| t.as_millisecond())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_come_back() {
        for text in ["2026-05-17T08:30:00.250Z", "1969-12-31T23:59:59.000Z"] {
            assert_eq!(to_text(from_text(text).expect("a time")), text);
        }
        assert_eq!(from_text("2026-05-17T10:30:00+02:00"), from_text("2026-05-17T08:30:00Z"));
        for text in ["", "yesterday", "2026-05-17", "2026-13-17T08:30:00Z"] {
            assert_eq!(from_text(text), None, "{text}");
        }
    }
}

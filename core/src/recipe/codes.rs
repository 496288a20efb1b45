//! The operator's own codes for defects: a table from kind and severity to what their documents call it.

use std::collections::BTreeMap;

use super::SEVERITIES;
use crate::defects::DefectKind;

/// Longest code, characters.
const MOST_CODE_CHARS: usize = 40;

/// Codes by kind, and by kind and severity.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Codes {
    by_name: BTreeMap<String, String>,
}

impl Codes {
    /// Reads `kind=code` and `kind.severity=code`, separated by semicolons.
    ///
    /// # Errors
    /// What was found and what was expected, for the first entry that is none.
    pub fn parse(text: &str) -> Result<Codes, (String, String)> {
        let mut by_name = BTreeMap::new();
        for entry in text.split(';').map(str::trim).filter(|entry| !entry.is_empty()) {
            let Some((name, code)) = entry.split_once('=') else {
                return Err((format!("'{entry}'"), "kind=code or kind.severity=code".into()));
            };
            let (name, code) = (name.trim(), code.trim());
            check_name(name)?;
            let plain = |c: char| !c.is_control() && !matches!(c, '"' | '\'' | '\\');
            if code.is_empty() || code.chars().count() > MOST_CODE_CHARS || !code.chars().all(plain) {
                return Err((
                    format!("the code '{code}' of {name}"),
                    format!("1 to {MOST_CODE_CHARS} characters without quotes and backslashes"),
                ));
            }
            if by_name.insert(name.to_string(), code.to_string()).is_some() {
                return Err((format!("{name} twice"), "one code for each".into()));
            }
        }
        Ok(Codes { by_name })
    }

    /// The code of a kind and severity: the more specific entry counts.
    pub fn of(&self, kind: DefectKind, severity: &str) -> Option<&str> {
        let specific = self.by_name.get(&format!("{}.{severity}", kind.name()));
        specific.or_else(|| self.by_name.get(kind.name())).map(String::as_str)
    }
}

fn check_name(name: &str) -> Result<(), (String, String)> {
    let (kind, severity) = name.split_once('.').map_or((name, None), |(kind, severity)| (kind, Some(severity)));
    let kinds = DefectKind::ALL.map(DefectKind::name);
    if !kinds.contains(&kind) {
        return Err((format!("the kind '{kind}'"), format!("one of {}", kinds.join(", "))));
    }
    match severity {
        Some(severity) if !SEVERITIES.contains(&severity) => {
            Err((format!("the severity '{severity}'"), format!("one of {}", SEVERITIES.join(", "))))
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_more_specific_code_counts() {
        let codes = Codes::parse(" dent = BAA ; dent.severe=BAA B; hole=BAC;").expect("a table");
        assert_eq!(codes.of(DefectKind::Dent, "minor"), Some("BAA"));
        assert_eq!(codes.of(DefectKind::Dent, "severe"), Some("BAA B"));
        assert_eq!(codes.of(DefectKind::Step, "severe"), None);
        assert_eq!(Codes::parse("").expect("nothing"), Codes::default());
    }

    #[test]
    fn what_is_no_table_is_named() {
        for (text, part) in [
            ("dent", "kind=code"),
            ("crack=BAB", "missing_material"),
            ("dent.bad=X", "moderate"),
            ("dent=", "1 to 40"),
            ("dent=a\"b", "quotes"),
            ("dent=A;dent=B", "one code"),
        ] {
            let (_, expected) = Codes::parse(text).expect_err(text);
            assert!(expected.contains(part), "{text}: {expected}");
        }
    }
}

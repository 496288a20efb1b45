//! `GET /api/docs`: the OpenAPI document as a page for people. Made from the document itself, without a script, a font
//! or a request to anywhere.

use std::fmt::Write;
use std::sync::LazyLock;

use axum::http::header::{CACHE_CONTROL, CONTENT_SECURITY_POLICY, CONTENT_TYPE};
use axum::response::{IntoResponse, Response};
use serde_json::{Map, Value};

use super::files::REVALIDATE;

/// What the page may do: show itself.
const POLICY: &str = "default-src 'none'; style-src 'unsafe-inline'; frame-ancestors 'none'; base-uri 'none'";

const STYLE: &str = include_str!("docs.css");

const METHODS: [&str; 7] = ["get", "head", "post", "put", "patch", "delete", "options"];

/// The page; it needs no token, as the document needs none.
pub(super) async fn get_docs() -> Response {
    static PAGE: LazyLock<String> = LazyLock::new(|| {
        // Serialising what was generated from types cannot fail.
        page(&serde_json::to_value(super::openapi()).unwrap_or_default())
    });
    let headers =
        [(CONTENT_TYPE, "text/html; charset=utf-8"), (CACHE_CONTROL, REVALIDATE), (CONTENT_SECURITY_POLICY, POLICY)];
    (headers, PAGE.as_str()).into_response()
}

fn page(document: &Value) -> String {
    let info = &document["info"];
    let mut groups: Vec<(String, Vec<Operation>)> = Vec::new();
    for operation in operations(document) {
        let group = operation.what["tags"][0].as_str().unwrap_or("other").to_string();
        match groups.iter_mut().find(|(name, _)| *name == group) {
            Some((_, list)) => list.push(operation),
            None => groups.push((group, vec![operation])),
        }
    }
    let mut out = format!(
        "<!doctype html><html lang=\"en\"><meta charset=\"utf-8\"><title>Stria: HTTP interface</title>\
         <meta name=\"viewport\" content=\"width=device-width\"><style>{STYLE}</style>\
         <header><h1>Stria {}</h1><p>{}</p><p>The same for programs: <a href=\"/api/openapi.json\">openapi.json</a> \
         (OpenAPI {}). <a href=\"/\">To the runs</a></p></header><nav><ul>",
        text(&info["version"]),
        text(&info["description"]),
        text(&document["openapi"])
    );
    for (group, list) in &groups {
        let _ = write!(out, "<li><a href=\"#{0}\">{0}</a> <small>{1}</small></li>", escaped(group), list.len());
    }
    out += "<li><a href=\"#schemas\">schemas</a></li></ul></nav><main>";
    for (group, list) in &groups {
        let _ = write!(out, "<section id=\"{0}\"><h2>{0}</h2>", escaped(group));
        list.iter().for_each(|operation| operation.write(&mut out));
        out += "</section>";
    }
    out += "<section id=\"schemas\"><h2>schemas</h2>";
    for (name, schema) in entries(&document["components"]["schemas"]) {
        let _ = write!(out, "<article id=\"{0}\"><h3>{0}</h3><p>{1}</p>", escaped(name), text(&schema["description"]));
        fields(&mut out, schema);
        out += "</article>";
    }
    out + "</section></main></html>"
}

struct Operation<'a> {
    method: &'static str,
    path: &'a str,
    what: &'a Value,
}

fn operations(document: &Value) -> Vec<Operation<'_>> {
    let paths = entries(&document["paths"]);
    paths
        .flat_map(|(path, item)| METHODS.map(|method| Operation { method, path, what: &item[method] }))
        .filter(|operation| operation.what.is_object())
        .collect()
}

impl Operation<'_> {
    fn write(&self, out: &mut String) {
        let what = self.what;
        let _ = write!(
            out,
            "<article id=\"{id}\"><h3><a href=\"#{id}\"><b class=\"{}\">{}</b> <code>{}</code></a></h3><p>{}</p><p>{}</p>",
            self.method,
            self.method.to_uppercase(),
            escaped(self.path),
            text(&what["summary"]),
            text(&what["description"]),
            id = text(&what["operationId"]),
        );
        let _ = write!(out, "<p class=\"needs\">Needs: {}</p>", needs(what));
        let parameters = what["parameters"].as_array().map(Vec::as_slice).unwrap_or_default();
        if !parameters.is_empty() {
            out.push_str("<table><tr><th>parameter<th>in<th>type<th>");
            for p in parameters {
                let must = if p["required"] == true { " <b>required</b>" } else { "" };
                let (name, place) = (text(&p["name"]), text(&p["in"]));
                let _ = write!(
                    out,
                    "<tr><td><code>{name}</code>{must}<td>{place}<td>{}<td>{}",
                    kind(&p["schema"]),
                    text(&p["description"])
                );
            }
            out.push_str("</table>");
        }
        for (media, content) in entries(&what["requestBody"]["content"]) {
            let _ = write!(out, "<p>Body: <code>{}</code> {}</p>", escaped(media), kind(&content["schema"]));
        }
        out.push_str("<table><tr><th>answer<th>body<th>");
        for (status, response) in entries(&what["responses"]) {
            let bodies: Vec<String> = entries(&response["content"])
                .map(|(media, content)| format!("{} <code>{}</code>", kind(&content["schema"]), escaped(media)))
                .collect();
            let _ = write!(
                out,
                "<tr><td><code>{}</code><td>{}<td>{}",
                escaped(status),
                bodies.join("<br>"),
                text(&response["description"])
            );
        }
        out.push_str("</table></article>");
    }
}

/// What the doors ask of who comes.
fn needs(what: &Value) -> String {
    let ways = what["security"].as_array().map(Vec::as_slice).unwrap_or_default();
    match ways.first().and_then(|way| entries(way).next()) {
        None => "nothing".into(),
        Some((_, scopes)) => match scopes[0].as_str() {
            Some(scope) => format!("a token or session with the scope <code>{}</code>", escaped(scope)),
            None => "a token or session".into(),
        },
    }
}

fn fields(out: &mut String, schema: &Value) {
    if let Some(all) = schema["allOf"].as_array() {
        return all.iter().for_each(|part| fields(out, part));
    }
    let required = schema["required"].as_array().map(Vec::as_slice).unwrap_or_default();
    let mut rows = entries(&schema["properties"]).peekable();
    if rows.peek().is_none() {
        let _ = write!(out, "<p>{}</p>", kind(schema));
        return;
    }
    out.push_str("<table><tr><th>field<th>type<th>");
    for (name, field) in rows {
        let may = if required.iter().any(|r| r == name.as_str()) { "" } else { " <small>may be absent</small>" };
        let (name, words) = (escaped(name), text(&field["description"]));
        let _ = write!(out, "<tr><td><code>{name}</code>{may}<td>{}<td>{words}", kind(field));
    }
    out.push_str("</table>");
}

/// A schema in a few words.
fn kind(schema: &Value) -> String {
    if let Some(name) = schema["$ref"].as_str().and_then(|r| r.rsplit('/').next()) {
        return format!("<a href=\"#{0}\">{0}</a>", escaped(name));
    }
    for several in ["oneOf", "anyOf", "allOf"] {
        if let Some(all) = schema[several].as_array() {
            let kinds: Vec<String> = all.iter().map(kind).filter(|kind| kind != "null").collect();
            return kinds.join(" or ");
        }
    }
    if let Some(words) = schema["enum"].as_array() {
        let words: Vec<String> = words.iter().map(|word| format!("<code>{}</code>", text(word))).collect();
        return words.join(" | ");
    }
    let name = match &schema["type"] {
        Value::Array(all) => all.iter().filter_map(Value::as_str).find(|t| *t != "null").unwrap_or("anything"),
        one => one.as_str().unwrap_or("anything"),
    };
    match name {
        "array" => format!("list of {}", kind(&schema["items"])),
        "object" if schema["additionalProperties"].is_object() => {
            format!("names with {}", kind(&schema["additionalProperties"]))
        }
        "object" if schema["properties"].is_object() => {
            let names: Vec<String> = entries(&schema["properties"]).map(|(name, _)| escaped(name)).collect();
            format!("{{ {} }}", names.join(", "))
        }
        other => range(other, schema),
    }
}

fn range(name: &str, schema: &Value) -> String {
    match (schema["minimum"].as_f64(), schema["maximum"].as_f64()) {
        (Some(min), Some(max)) => format!("{name}, {min} to {max}"),
        (Some(min), None) => format!("{name} from {min}"),
        _ => escaped(name),
    }
}

fn entries(value: &Value) -> impl Iterator<Item = (&String, &Value)> {
    static NONE: LazyLock<Map<String, Value>> = LazyLock::new(Map::new);
    value.as_object().unwrap_or(&NONE).iter()
}

/// A value's words, safe to stand in a page; `code` stays code.
fn text(value: &Value) -> String {
    let words = match value {
        Value::String(words) => words.clone(),
        Value::Null => String::new(),
        other => other.to_string(),
    };
    let mut parts = words.split('`').map(escaped);
    let mut out = parts.next().unwrap_or_default();
    for (i, part) in parts.enumerate() {
        let _ = write!(out, "<{}code>{part}", if i % 2 == 0 { "" } else { "/" });
    }
    if words.matches('`').count() % 2 == 1 {
        out += "</code>";
    }
    out
}

/// Text as HTML shows it.
pub(super) fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_route_and_schema_is_on_the_page_and_every_link_leads_somewhere() {
        let document = serde_json::to_value(crate::http::openapi()).expect("JSON");
        let page = page(&document);
        let ids: std::collections::BTreeSet<&str> =
            page.split(" id=\"").skip(1).filter_map(|rest| rest.split('"').next()).collect();
        for operation in operations(&document) {
            let id = operation.what["operationId"].as_str().expect("a name");
            assert!(ids.contains(id), "{id}");
        }
        for (name, _) in entries(&document["components"]["schemas"]) {
            assert!(ids.contains(name.as_str()), "{name}");
        }
        for target in page.split("href=\"#").skip(1).filter_map(|rest| rest.split('"').next()) {
            assert!(ids.contains(target), "{target}");
        }
        for foreign in ["http://", "https://", "<script", "src="] {
            assert!(!page.contains(foreign), "{foreign}");
        }
    }

    #[test]
    fn words_of_the_document_do_not_become_markup() {
        assert_eq!(text(&"a `<b>` & `c".into()), "a <code>&lt;b&gt;</code> &amp; <code>c</code>");
    }
}

//! What the OpenAPI document says of every route alike: the scope it needs, the answers of the doors, what every request
//! that cannot be used hears, and the ranges of what many routes take.

use axum::http::Method;
use utoipa::openapi::path::{Operation, Parameter, ParameterIn};
use utoipa::openapi::schema::{Object, Schema, SchemaType, Type};
use utoipa::openapi::security::{ApiKey, ApiKeyValue, Http, HttpAuthScheme, SecurityRequirement, SecurityScheme};
use utoipa::openapi::{Components, Content, ContentBuilder, OpenApi, Ref, RefOr, Response, ResponseBuilder};

use super::doors::{COOKIE_NAME, Need, need_of};
use super::ingest::MAX_KEY_CHARS;
use super::uploads;
use crate::runs::{CONTENT_TYPES, Page};

/// Routes that give files of any kind, by the beginning and the end of their paths.
const FILES: [(&str, &str); 5] = [
    ("/api/runs/", "/source"),
    ("/api/jobs/", "/products/{name}"),
    ("/api/jobs/", "/tiles/{name}"),
    ("/api/jobs/", "/live/{name}"),
    ("/api/jobs/", "/residual/{name}"),
];

/// Adds them.
pub(super) fn add_doors(document: &mut OpenApi) {
    let components = document.components.get_or_insert_with(Components::new);
    components.add_security_scheme("token", SecurityScheme::Http(Http::new(HttpAuthScheme::Bearer)));
    let cookie = SecurityScheme::ApiKey(ApiKey::Cookie(ApiKeyValue::new(COOKIE_NAME)));
    components.add_security_scheme("session", cookie);
    for (path, item) in &mut document.paths.paths {
        for (method, operation) in [
            (Method::GET, &mut item.get),
            (Method::PUT, &mut item.put),
            (Method::POST, &mut item.post),
            (Method::DELETE, &mut item.delete),
            (Method::OPTIONS, &mut item.options),
            (Method::HEAD, &mut item.head),
            (Method::PATCH, &mut item.patch),
        ] {
            if let Some(operation) = operation {
                add_to(operation, need_of(&method, path));
                add_refusals(operation, path);
                if FILES.iter().any(|files| path.starts_with(files.0) && path.ends_with(files.1)) {
                    add_content_types(operation);
                }
                operation.parameters.iter_mut().flatten().for_each(add_range);
            }
        }
    }
}

fn add_to(operation: &mut Operation, need: Need) {
    let scopes: Vec<&str> = match need {
        Need::Nothing | Need::Somebody => vec![],
        Need::Scope(scope) => vec![scope.as_str()],
    };
    let requirement = |name: &str| SecurityRequirement::new(name, scopes.iter().copied());
    // An empty list says that nothing is needed.
    operation.security = Some(match need {
        Need::Nothing => vec![],
        _ => vec![requirement("token"), requirement("session")],
    });
    let answers = [
        ("401", "Nobody that this server knows"),
        ("403", "The token may not do this, or the request comes from a foreign page"),
        ("429", "Too many requests; `Retry-After` says when to come back"),
        ("503", "The records or files do not answer, or all places are taken; come back in a moment"),
    ];
    for (status, words) in answers {
        operation.responses.responses.entry(status.into()).or_insert_with(|| RefOr::T(problem(words)));
    }
}

/// What a request hears that cannot be used as it is: each extractor refuses in its own way.
fn add_refusals(operation: &mut Operation, path: &str) {
    let is_word = |p: &RefOr<Parameter>| matches!(p, RefOr::T(p) if !matches!(p.parameter_in, ParameterIn::Path));
    let takes_words = operation.parameters.iter().flatten().any(is_word);
    let takes_body = operation.request_body.is_some();
    let tus = path.starts_with("/api/uploads");
    let answers = [
        (takes_words || takes_body, "400", "The request cannot be used; `field` and `expected` say why"),
        (takes_body, "408", "The sender was silent for too long"),
        (takes_body, "413", "More bytes than this server takes"),
        (takes_body, "415", "The body's type does not fit"),
        (tus, "412", "Another version of tus than 1.0.0; `Tus-Version` says which one is spoken"),
    ];
    for (_, status, words) in answers.into_iter().filter(|(heard, ..)| *heard) {
        operation.responses.responses.entry(status.into()).or_insert_with(|| RefOr::T(problem(words)));
    }
}

/// A file is answered as what its name says.
fn add_content_types(operation: &mut Operation) {
    for status in ["200", "206"] {
        let Some(RefOr::T(response)) = operation.responses.responses.get_mut(status) else { continue };
        for kind in CONTENT_TYPES {
            let inside = if kind == "application/json" { SchemaType::AnyValue } else { SchemaType::new(Type::String) };
            let content = ContentBuilder::new().schema(Some(Object::with_type(inside))).build();
            response.content.entry(kind.into()).or_insert_with(|| RefOr::T(content));
        }
    }
}

/// Ranges of parameters that many routes take.
fn add_range(parameter: &mut RefOr<Parameter>) {
    let RefOr::T(parameter) = parameter else { return };
    let object = match &mut parameter.schema {
        Some(RefOr::T(Schema::Object(object))) => object,
        _ => return,
    };
    let range = |object: &mut Object, least: usize, most: usize| {
        object.minimum = Some(utoipa::Number::UInt(least));
        object.maximum = Some(utoipa::Number::UInt(most));
    };
    let words = |object: &mut Object, words: &[&str]| {
        object.enum_values = Some(words.iter().map(|word| (*word).into()).collect());
    };
    match parameter.name.as_str() {
        "limit" => range(object, 1, Page::MAX as usize),
        "Idempotency-Key" => {
            object.min_length = Some(1);
            object.max_length = Some(MAX_KEY_CHARS);
            object.pattern = Some("^[!-~]+$".into());
        }
        "Tus-Resumable" => words(object, &[uploads::VERSION]),
        "X-HTTP-Method-Override" => words(object, &["PATCH", "HEAD", "DELETE"]),
        _ => {}
    }
}

fn problem(words: &str) -> Response {
    let content = Content::new(Some(Ref::from_schema_name("Problem")));
    ResponseBuilder::new().description(words).content("application/problem+json", content).build()
}

//! What the OpenAPI document says of every route alike: the scope it needs, and the answers of the doors.

use axum::http::Method;
use utoipa::openapi::path::Operation;
use utoipa::openapi::security::{ApiKey, ApiKeyValue, Http, HttpAuthScheme, SecurityRequirement, SecurityScheme};
use utoipa::openapi::{Components, Content, OpenApi, Ref, RefOr, Response, ResponseBuilder};

use super::doors::{COOKIE_NAME, Need, need_of};

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

fn problem(words: &str) -> Response {
    let content = Content::new(Some(Ref::from_schema_name("Problem")));
    ResponseBuilder::new().description(words).content("application/problem+json", content).build()
}

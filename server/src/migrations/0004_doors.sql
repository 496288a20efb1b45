-- Who may come in. Secrets are kept as SHA-256 only: they are 256 random bits, so nobody can guess one from its hash.
-- `scopes` are words with a space between them.

CREATE TABLE tokens (
    id TEXT NOT NULL PRIMARY KEY,
    name TEXT NOT NULL,
    secret_sha256 TEXT NOT NULL UNIQUE,
    scopes TEXT NOT NULL,
    created_ms BIGINT NOT NULL,
    expires_ms BIGINT,
    used_ms BIGINT,
    revoked_ms BIGINT
);

-- A browser that logged in: by a token, whose end is also the session's, or by a login code (then `token_id` is NULL).
CREATE TABLE sessions (
    secret_sha256 TEXT NOT NULL PRIMARY KEY,
    token_id TEXT REFERENCES tokens (id) ON DELETE CASCADE,
    name TEXT NOT NULL,
    scopes TEXT NOT NULL,
    created_ms BIGINT NOT NULL,
    expires_ms BIGINT NOT NULL
);
CREATE INDEX sessions_by_expiry ON sessions (expires_ms);

-- One-time login addresses.
CREATE TABLE login_codes (
    secret_sha256 TEXT NOT NULL PRIMARY KEY,
    name TEXT NOT NULL,
    scopes TEXT NOT NULL,
    expires_ms BIGINT NOT NULL
);

-- Every request that wrote, or wanted to, and was let in.
CREATE TABLE audit (
    id TEXT NOT NULL PRIMARY KEY,
    at_ms BIGINT NOT NULL,
    who TEXT NOT NULL,
    address TEXT NOT NULL,
    method TEXT NOT NULL,
    path TEXT NOT NULL,
    status INTEGER NOT NULL,
    request TEXT NOT NULL
);
CREATE INDEX audit_by_time ON audit (at_ms);

-- Rules of keeping that people stored: one row, none before the first time. `stored` is 0 where the servers' own settings
-- hold again; the version goes on growing, so that nobody changes what they have not seen.
CREATE TABLE retention_rules (
    id INTEGER NOT NULL PRIMARY KEY CHECK (id = 1),
    keep_days DOUBLE PRECISION,
    quota_gb DOUBLE PRECISION,
    stored INTEGER NOT NULL,
    version BIGINT NOT NULL,
    changed_ms BIGINT NOT NULL,
    changed_by TEXT NOT NULL
);

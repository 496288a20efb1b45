-- Runs that no policy lets go.
CREATE TABLE pins (
    run_id TEXT NOT NULL PRIMARY KEY REFERENCES runs (id) ON DELETE CASCADE,
    at_ms BIGINT NOT NULL
);

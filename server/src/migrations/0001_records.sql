-- The records. SQL that SQLite and PostgreSQL both take: ids are text (UUIDs of version 7, whose order is the order
-- of creation), times are ms since 1970, small structures are JSON in text, flags are 0 or 1.

CREATE TABLE rigs (
    name TEXT NOT NULL PRIMARY KEY,
    created_ms BIGINT NOT NULL,
    toml TEXT NOT NULL,
    sha256 TEXT NOT NULL
);

CREATE TABLE assets (
    name TEXT NOT NULL PRIMARY KEY,
    created_ms BIGINT NOT NULL
);

-- `state` and `latest_job` repeat what the run's latest job says, so that lists need no join; they change in the same
-- transaction as the job.
CREATE TABLE runs (
    id TEXT NOT NULL PRIMARY KEY,
    created_ms BIGINT NOT NULL,
    asset TEXT NOT NULL REFERENCES assets (name),
    chainage_mm DOUBLE PRECISION NOT NULL,
    direction TEXT NOT NULL,
    recorded_ms BIGINT NOT NULL,
    note TEXT NOT NULL,
    filename TEXT NOT NULL,
    source_extension TEXT NOT NULL,
    source_bytes BIGINT NOT NULL,
    source_sha256 TEXT NOT NULL,
    fps DOUBLE PRECISION,
    rig_name TEXT NOT NULL,
    state TEXT NOT NULL,
    latest_job TEXT NOT NULL
);
CREATE INDEX runs_by_asset ON runs (asset, id);
CREATE INDEX runs_by_state ON runs (state, id);
CREATE INDEX runs_by_recording ON runs (recorded_ms);
CREATE INDEX runs_by_job ON runs (latest_job);

-- `fence` grows with every claim and goes into every write and every key of an attempt; `attempt` is what people see
-- (a claim that ended in a clean stop is not counted); `failures` counts the attempts that ended in an error,
-- `losses` those that ended with their worker.
-- `beat` grows with every sign of life of the worker.
CREATE TABLE jobs (
    id TEXT NOT NULL PRIMARY KEY,
    run_id TEXT NOT NULL REFERENCES runs (id) ON DELETE CASCADE,
    created_ms BIGINT NOT NULL,
    priority TEXT NOT NULL,
    rank_ms BIGINT NOT NULL,
    rig_name TEXT NOT NULL,
    rig_toml TEXT NOT NULL,
    recipe_name TEXT NOT NULL,
    recipe_toml TEXT NOT NULL,
    state TEXT NOT NULL,
    cancel_requested INTEGER NOT NULL,
    not_before_ms BIGINT NOT NULL,
    fence BIGINT NOT NULL,
    attempt INTEGER NOT NULL,
    failures INTEGER NOT NULL,
    losses INTEGER NOT NULL,
    node TEXT NOT NULL,
    worker TEXT NOT NULL,
    beat BIGINT NOT NULL,
    stage TEXT NOT NULL,
    fraction DOUBLE PRECISION NOT NULL,
    frames BIGINT NOT NULL,
    frames_total BIGINT,
    frames_per_s DOUBLE PRECISION NOT NULL,
    time_left_s DOUBLE PRECISION,
    warnings TEXT NOT NULL,
    error TEXT,
    quality TEXT,
    result_fence BIGINT,
    started_ms BIGINT,
    finished_ms BIGINT
);
CREATE INDEX jobs_by_rank ON jobs (state, rank_ms);
CREATE INDEX jobs_by_state ON jobs (state, id);
CREATE INDEX jobs_by_run ON jobs (run_id, id);

CREATE TABLE products (
    job_id TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    name TEXT NOT NULL,
    position BIGINT NOT NULL,
    bytes BIGINT NOT NULL,
    sha256 TEXT NOT NULL,
    PRIMARY KEY (job_id, name)
);
CREATE INDEX products_by_position ON products (job_id, position);

-- The recording segments of a job's present (or last) attempt.
CREATE TABLE segments (
    job_id TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    number BIGINT NOT NULL,
    fence BIGINT NOT NULL,
    bytes BIGINT NOT NULL,
    sha256 TEXT NOT NULL,
    PRIMARY KEY (job_id, number)
);

CREATE TABLE log_lines (
    job_id TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    number BIGINT NOT NULL,
    at_ms BIGINT NOT NULL,
    attempt INTEGER NOT NULL,
    line TEXT NOT NULL,
    PRIMARY KEY (job_id, number)
);

-- What a creating request with an Idempotency-Key made, and from what.
CREATE TABLE idempotency_keys (
    key TEXT NOT NULL PRIMARY KEY,
    created_ms BIGINT NOT NULL,
    fingerprint TEXT NOT NULL,
    job_id TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE
);
CREATE INDEX idempotency_keys_by_job ON idempotency_keys (job_id);
CREATE INDEX idempotency_keys_by_age ON idempotency_keys (created_ms);

-- Store keys under these prefixes belong to nothing that is published: they are deleted once they are due. A prefix is
-- written here before the first byte goes there, and leaves in the transaction that publishes it.
CREATE TABLE unpublished (
    prefix TEXT NOT NULL PRIMARY KEY,
    due_ms BIGINT NOT NULL
);
CREATE INDEX unpublished_by_due ON unpublished (due_ms);

CREATE TABLE workers (
    name TEXT NOT NULL PRIMARY KEY,
    node TEXT NOT NULL,
    slots INTEGER NOT NULL,
    started_ms BIGINT NOT NULL,
    seen_ms BIGINT NOT NULL
);

-- Uploads that are not a run yet (tus). `offset_bytes` is what is promised: everything before it is durable. `hash_state`
-- is the SHA-256 of those bytes as far as it got, so that no byte is read again, by whichever server goes on. `fence`
-- grows with every request that takes the upload over, and goes into its writes. A file on S3 is a multipart upload
-- (`parts_name`) whose parts are rows; what does not fill a part yet is an object, the `tail_number`-th of the request
-- with `tail_fence`.
CREATE TABLE uploads (
    id TEXT NOT NULL PRIMARY KEY,
    created_ms BIGINT NOT NULL,
    expires_ms BIGINT NOT NULL,
    state TEXT NOT NULL,
    idempotency_key TEXT,
    fingerprint TEXT NOT NULL,
    length_bytes BIGINT,
    offset_bytes BIGINT NOT NULL,
    metadata TEXT NOT NULL,
    new_run TEXT NOT NULL,
    sha256 TEXT,
    run_id TEXT NOT NULL,
    job_id TEXT,
    fence BIGINT NOT NULL,
    hash_state TEXT NOT NULL,
    part_bytes BIGINT NOT NULL,
    parts_name TEXT,
    tail_fence BIGINT NOT NULL,
    tail_number BIGINT NOT NULL,
    tail_bytes BIGINT NOT NULL
);
CREATE INDEX uploads_by_expiry ON uploads (state, expires_ms);
CREATE UNIQUE INDEX uploads_by_key ON uploads (idempotency_key);

CREATE TABLE upload_parts (
    upload_id TEXT NOT NULL REFERENCES uploads (id) ON DELETE CASCADE,
    number BIGINT NOT NULL,
    part TEXT NOT NULL,
    PRIMARY KEY (upload_id, number)
);

-- A run that came live is made of segments, and open while its robot may still send.
ALTER TABLE runs ADD COLUMN source_kind TEXT NOT NULL DEFAULT 'file';
ALTER TABLE runs ADD COLUMN source_open INTEGER NOT NULL DEFAULT 0;

CREATE TABLE source_segments (
    run_id TEXT NOT NULL REFERENCES runs (id) ON DELETE CASCADE,
    number BIGINT NOT NULL,
    fence BIGINT NOT NULL,
    bytes BIGINT NOT NULL,
    sha256 TEXT NOT NULL,
    frames BIGINT NOT NULL,
    part_arrival_ns BIGINT,
    PRIMARY KEY (run_id, number)
);

-- The live streams by name, each with its latest run. `fence` grows with every connection that takes the stream over and
-- goes into its writes; `beat` grows with every sign of life of the sender. `missing` lists the frames that were never
-- sent, as JSON [[first, last], …].
CREATE TABLE streams (
    name TEXT NOT NULL PRIMARY KEY,
    run_id TEXT NOT NULL,
    job_id TEXT NOT NULL,
    kind TEXT NOT NULL,
    is_open INTEGER NOT NULL,
    fence BIGINT NOT NULL,
    beat BIGINT NOT NULL,
    next_seq BIGINT NOT NULL,
    frames BIGINT NOT NULL,
    segments BIGINT NOT NULL,
    bytes BIGINT NOT NULL,
    missing TEXT NOT NULL,
    hash_state TEXT NOT NULL,
    opened_ms BIGINT NOT NULL
);
CREATE INDEX streams_by_state ON streams (is_open);

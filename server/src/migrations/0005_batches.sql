-- Reprocessing in bulk. A batch takes the runs that its filter finds and that came before it (ids sort by time); it
-- queues them in steps, in the order of their ids, and `queued_to` is the last one that has its job. Rig and recipe are
-- kept here and not in 100,000 jobs: a job of a batch with an empty rig or recipe has that of its batch, or else of
-- `base_job`, the run's latest job before it; they are written into the job when it is claimed.
-- `wanted` is what people asked for (run, pause, cancel), `settled` is 1 once the jobs are as wanted.
CREATE TABLE batches (
    id TEXT NOT NULL PRIMARY KEY,
    created_ms BIGINT NOT NULL,
    note TEXT NOT NULL,
    filter TEXT NOT NULL,
    rig_name TEXT,
    rig_toml TEXT,
    recipe_name TEXT,
    recipe_toml TEXT,
    runs BIGINT NOT NULL,
    queued_to TEXT NOT NULL,
    wanted TEXT NOT NULL,
    settled INTEGER NOT NULL,
    idempotency_key TEXT UNIQUE,
    fingerprint TEXT NOT NULL
);
CREATE INDEX batches_by_work ON batches (settled, id);

-- The runs of a batch that was given as a list.
CREATE TABLE batch_runs (
    batch_id TEXT NOT NULL REFERENCES batches (id) ON DELETE CASCADE,
    run_id TEXT NOT NULL,
    PRIMARY KEY (batch_id, run_id)
);

ALTER TABLE jobs ADD COLUMN batch_id TEXT;
ALTER TABLE jobs ADD COLUMN base_job TEXT;
CREATE INDEX jobs_by_batch ON jobs (batch_id, state, id);

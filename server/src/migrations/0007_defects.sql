-- Defects of jobs that are done. `id` is the job's and the defect's number in its list, so that it grows with the time of
-- the job. `asset`, `chainage_mm` and `clock_h` repeat what follows from the run as it is now, so that lists need no join.
-- `is_current` is 1 for those of the run's latest job that is done; `size_mm` is the depth without its sign. `state`,
-- `comment`, `version`, `changed_ms` and `changed_by` are what people say about it; `carried_from` is the defect of an
-- earlier job of the same run whose words these were.

CREATE TABLE defects (
    id TEXT NOT NULL PRIMARY KEY,
    job_id TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    run_id TEXT NOT NULL,
    asset TEXT NOT NULL,
    is_current INTEGER NOT NULL,
    number BIGINT NOT NULL,
    kind TEXT NOT NULL,
    severity TEXT NOT NULL,
    code TEXT,
    chainage_mm DOUBLE PRECISION NOT NULL,
    clock_h DOUBLE PRECISION,
    height_mm DOUBLE PRECISION,
    x_mm DOUBLE PRECISION NOT NULL,
    y_mm DOUBLE PRECISION NOT NULL,
    z_mm DOUBLE PRECISION NOT NULL,
    depth_mm DOUBLE PRECISION NOT NULL,
    size_mm DOUBLE PRECISION NOT NULL,
    length_mm DOUBLE PRECISION NOT NULL,
    width_mm DOUBLE PRECISION NOT NULL,
    area_mm2 DOUBLE PRECISION NOT NULL,
    volume_mm3 DOUBLE PRECISION NOT NULL,
    steepest_slope_deg DOUBLE PRECISION NOT NULL,
    confidence DOUBLE PRECISION NOT NULL,
    at_edge INTEGER NOT NULL,
    state TEXT NOT NULL,
    comment TEXT NOT NULL,
    version BIGINT NOT NULL,
    changed_ms BIGINT,
    changed_by TEXT,
    carried_from TEXT
);
CREATE INDEX defects_by_job ON defects (job_id, id);
CREATE INDEX defects_by_run ON defects (run_id, is_current);
CREATE INDEX defects_by_age ON defects (is_current, id);
CREATE INDEX defects_by_place ON defects (is_current, asset, chainage_mm, id);
CREATE INDEX defects_by_chainage ON defects (is_current, chainage_mm, id);
CREATE INDEX defects_by_size ON defects (is_current, size_mm, id);
CREATE INDEX defects_by_state ON defects (is_current, state, id);

-- What a job that is done has looked at: world x from and to, and how deep a round dent of 20 mm radius had to be.
CREATE TABLE inspections (
    job_id TEXT NOT NULL PRIMARY KEY REFERENCES jobs (id) ON DELETE CASCADE,
    x_min_mm DOUBLE PRECISION NOT NULL,
    x_max_mm DOUBLE PRECISION NOT NULL,
    detection_limit_mm DOUBLE PRECISION NOT NULL,
    doubtful BIGINT NOT NULL,
    omitted BIGINT NOT NULL
);

-- The queue's order, whole: a batch has one rank, and its jobs must not be sorted anew at every claim.
DROP INDEX jobs_by_rank;
CREATE INDEX jobs_by_rank ON jobs (state, rank_ms, id);

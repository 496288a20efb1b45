//! The rerun recording and the MCAP archive, written from a run whose every value is known, read back by programs
//! that we did not write: rerun's own SDK and its `rrd verify`, and PyPI's mcap with its CRC checks.

mod recording_archive {
    mod archive;
    mod known_run;
    mod recording;
}

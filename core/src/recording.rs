//! The rerun recording of a job: the steps of the method and the growing surface.

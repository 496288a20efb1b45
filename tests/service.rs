//! The service from outside: the real binary, real sockets, kill -9.

mod service {
    mod api;
    mod batches;
    mod commands;
    mod crashes;
    mod doors;
    mod jobs;
    mod keeping;
    mod measure;
    mod refusals;
    mod uploads;
}

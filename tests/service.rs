//! The service from outside: the real binary, real sockets, kill -9.

mod service {
    mod api;
    mod batches;
    mod commands;
    mod confined;
    mod crashes;
    mod defects;
    mod doors;
    mod jobs;
    mod keeping;
    mod measure;
    mod openapi;
    mod refusals;
    mod slow;
    mod uploads;
}

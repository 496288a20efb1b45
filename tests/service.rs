//! The service from outside: the real binary, real sockets, kill -9.

mod service {
    mod api;
    mod commands;
    mod crashes;
    mod jobs;
    mod measure;
    mod refusals;
    mod uploads;
}

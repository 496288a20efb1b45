//! Many machines from outside: servers and workers on one PostgreSQL and one S3, and what takes them away.

mod cluster {
    mod chaos;
    mod copies;
    mod engines;
    mod many;
    mod streams;
}

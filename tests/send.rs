//! `stria send` from outside: the real binary, the real server, a network between them that does what networks do.

mod send {
    mod file;
    mod live;
    mod relay;
    mod sender;
    mod tls;
    mod watch;
}

//! Uploads in pieces (tus 1.0.0) from outside: the clients that others wrote, a tunnel that cuts, the behaviours that
//! tusd tests for, kill -9, a full disk, and S3.

mod uploads {
    mod behaviours;
    mod cuts;
    mod disk;
    mod endings;
    mod ledger;
    mod oracle;
    mod pieces;
    mod sites;
    mod storms;
    mod tunnel;
}

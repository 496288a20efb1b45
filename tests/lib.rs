//! Stria from outside. The tests live beside this file, one file per concern.

pub mod support;

//! A known wall or pipe, a rig and a motion → frames and the truth.

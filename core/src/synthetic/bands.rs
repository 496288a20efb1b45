//! Work on an image's rows by all processors.

use std::sync::Mutex;

/// Calls `work(first row, rows)` for bands of rows of `row_len` elements each, on all processors.
pub(super) fn for_bands<T: Send>(
    data: &mut [T],
    row_len: usize,
    rows_a_band: usize,
    work: impl Fn(usize, &mut [T]) + Sync,
) {
    let threads = std::thread::available_parallelism().map_or(1, |n| n.get());
    let bands = Mutex::new(data.chunks_mut(row_len * rows_a_band).enumerate());
    let next = || bands.lock().unwrap_or_else(|poisoned| poisoned.into_inner()).next();
    let run = || {
        while let Some((band, rows)) = next() {
            work(band * rows_a_band, rows);
        }
    };
    std::thread::scope(|scope| {
        for _ in 1..threads {
            scope.spawn(run);
        }
        run();
    });
}

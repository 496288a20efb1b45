//! Connected places that deviate: each summit with what belongs to it.
//!
//! Cells are taken from the highest down. A cell beside a region joins it, one beside none begins a new one; where two
//! meet, the lower one is swallowed unless it stands out: two dents that touch stay two, a noisy bottom stays one.

use super::cells::Field;

/// Share of the threshold down to which a region reaches.
const LOW: f32 = 0.3;
/// Share of its own height to which a region reaches down, at least.
const FOOT: f32 = 0.06;
/// A summit stands out where it rises this share of its height above the pass to the next, and this many thresholds.
const STANDS_OUT: f32 = 0.35;
const STANDS_OUT_THRESHOLDS: f32 = 0.8;
const NONE: u32 = u32::MAX;

/// A region on one side of the undamaged surface.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Region {
    /// 1: away from the camera, −1: towards it.
    pub sign: f32,
    /// Its highest cell.
    pub summit: usize,
    /// Its cells.
    pub cells: Vec<usize>,
}

/// The regions of a deviation whose summits reach the threshold of their row, mm.
pub(super) fn find(deviation: &Field, thresholds_mm: &[f32]) -> Vec<Region> {
    let mut regions = Vec::new();
    for sign in [1.0, -1.0] {
        regions.extend(one_side(deviation, thresholds_mm, sign));
    }
    regions
}

fn one_side(deviation: &Field, thresholds_mm: &[f32], sign: f32) -> Vec<Region> {
    let columns = deviation.columns;
    let mut order: Vec<(f32, u32)> = Vec::new();
    for (row, line) in deviation.values.chunks_exact(columns).enumerate() {
        let least = LOW * thresholds_mm[row];
        let high = line.iter().enumerate().filter(|(_, v)| sign * **v > least);
        order.extend(high.map(|(column, v)| (sign * v, (row * columns + column) as u32)));
    }
    order.sort_unstable_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    let mut basins = Basins {
        columns,
        thresholds_mm,
        of_cell: vec![NONE; deviation.values.len()],
        parents: Vec::new(),
        summits: Vec::new(),
    };
    for (here, cell) in &order {
        basins.add(*cell as usize, *here, |cell| sign * deviation.values[cell]);
    }
    basins.regions(&order, sign)
}

struct Basins<'a> {
    columns: usize,
    thresholds_mm: &'a [f32],
    of_cell: Vec<u32>,
    parents: Vec<u32>,
    /// Height, mm, and cell of each basin's summit.
    summits: Vec<(f32, u32)>,
}

impl Basins<'_> {
    fn root(&mut self, mut basin: u32) -> u32 {
        while self.parents[basin as usize] != basin {
            let above = self.parents[self.parents[basin as usize] as usize];
            self.parents[basin as usize] = above;
            basin = above;
        }
        basin
    }

    fn add(&mut self, cell: usize, here: f32, height: impl Fn(usize) -> f32) {
        let columns = self.columns;
        let (column, row) = (cell % columns, cell / columns);
        let rows = self.of_cell.len() / columns;
        let mut beside: Option<(f32, u32)> = None;
        let mut roots = [NONE; 8];
        let mut count = 0;
        for next_row in row.saturating_sub(1)..(row + 2).min(rows) {
            for next_column in column.saturating_sub(1)..(column + 2).min(columns) {
                let next = next_row * columns + next_column;
                if next == cell || self.of_cell[next] == NONE {
                    continue;
                }
                let root = self.root(self.of_cell[next]);
                if beside.is_none_or(|(high, _)| height(next) > high) {
                    beside = Some((height(next), root));
                }
                if !roots[..count].contains(&root) {
                    roots[count] = root;
                    count += 1;
                }
            }
        }
        let Some((_, steepest)) = beside else {
            self.of_cell[cell] = self.parents.len() as u32;
            self.parents.push(self.parents.len() as u32);
            self.summits.push((here, cell as u32));
            return;
        };
        self.of_cell[cell] = steepest;
        let highest = roots[..count].iter().copied().fold(steepest, |best, root| {
            if self.summits[root as usize].0 > self.summits[best as usize].0 { root } else { best }
        });
        for root in &roots[..count] {
            let (summit, at) = self.summits[*root as usize];
            let threshold = self.threshold_mm(at);
            let rises = (STANDS_OUT * summit).max(STANDS_OUT_THRESHOLDS * threshold);
            let stands_out = summit >= threshold && summit - here >= rises;
            if *root != highest && !stands_out {
                self.parents[*root as usize] = highest;
            }
        }
    }

    fn threshold_mm(&self, cell: u32) -> f32 {
        self.thresholds_mm[cell as usize / self.columns]
    }

    fn regions(mut self, order: &[(f32, u32)], sign: f32) -> Vec<Region> {
        let mut places = vec![NONE; self.parents.len()];
        let mut regions: Vec<Region> = Vec::new();
        for (here, cell) in order {
            let root = self.root(self.of_cell[*cell as usize]) as usize;
            let (height, summit) = self.summits[root];
            if height < self.threshold_mm(summit) || *here < FOOT * height {
                continue;
            }
            if places[root] == NONE {
                places[root] = regions.len() as u32;
                regions.push(Region { sign, summit: summit as usize, cells: Vec::new() });
            }
            regions[places[root] as usize].cells.push(*cell as usize);
        }
        regions
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bumps(bumps: &[(f32, f32, f32, f32)]) -> Field {
        let mut field = Field::new(80, 40, 0.0);
        for (cell, value) in field.values.iter_mut().enumerate() {
            let (column, row) = ((cell % 80) as f32, (cell / 80) as f32);
            for (x, y, radius, height) in bumps {
                let away = (column - x).hypot(row - y) / radius;
                *value += if away < 1.0 { height * (1.0 - away * away) } else { 0.0 };
            }
            *value += 0.02 * ((cell * 37 % 11) as f32 - 5.0);
        }
        field
    }

    #[test]
    fn two_that_touch_stay_two_and_a_noisy_one_stays_one() {
        let found =
            find(&bumps(&[(20.0, 20.0, 9.0, 4.0), (36.0, 20.0, 9.0, 3.0), (60.0, 20.0, 6.0, -2.0)]), &[0.5; 40]);
        let mut heads: Vec<(f32, usize)> = found.iter().map(|r| (r.sign, r.summit % 80)).collect();
        heads.sort_by_key(|head| head.1);
        assert_eq!(heads.len(), 3, "{heads:?}");
        assert!(heads[0].1.abs_diff(20) < 3 && heads[1].1.abs_diff(36) < 3 && heads[2].0 == -1.0, "{heads:?}");
    }

    #[test]
    fn below_the_threshold_there_is_nothing() {
        assert!(find(&bumps(&[(20.0, 20.0, 9.0, 0.4)]), &[0.6; 40]).is_empty());
    }
}

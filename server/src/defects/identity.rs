//! Which defects of two lists are the same one: of one kind, at one place.

use std::collections::HashMap;

/// Places closer than this are one place, however small the defect, mm.
const LEAST_REACH_MM: f64 = 8.0;
/// Shifts are counted in cells of this size, mm.
const SHIFT_CELL_MM: f64 = 10.0;
/// Most defects of each list that say how the lists lie to each other.
const MOST_VOTERS: usize = 200;

/// Where a defect is.
#[derive(Clone, Debug)]
pub(super) struct Place<'a> {
    /// Its kind.
    pub kind: &'a str,
    /// Along the asset, mm.
    pub x_mm: f64,
    /// Across it, mm.
    pub y_mm: f64,
    /// Mean of length and width, mm.
    pub extent_mm: f64,
}

/// For each earlier defect the later one that is the same, if any. Nothing is the same as two. The later list may lie
/// shifted against the earlier one by up to `slack_mm` along each axis: the shift that most defects agree on is taken.
pub(super) fn partners(earlier: &[Place], later: &[Place], slack_mm: f64) -> Vec<Option<usize>> {
    let (dx, dy) = if slack_mm > 0.0 { shift(earlier, later, slack_mm) } else { (0.0, 0.0) };
    let mut order: Vec<usize> = (0..later.len()).collect();
    order.sort_by(|a, b| later[*a].x_mm.total_cmp(&later[*b].x_mm));
    let widest = later.iter().map(|p| p.extent_mm).fold(0.0, f64::max);
    let mut pairs = Vec::new();
    for (i, a) in earlier.iter().enumerate() {
        let most = reach(a.extent_mm, widest);
        let x_mm = a.x_mm + dx;
        let first = order.partition_point(|j| later[*j].x_mm < x_mm - most);
        for j in order[first..].iter().copied().take_while(|j| later[*j].x_mm <= x_mm + most) {
            let b = &later[j];
            let apart = (b.x_mm - x_mm).hypot(b.y_mm - a.y_mm - dy) / reach(a.extent_mm, b.extent_mm);
            if b.kind == a.kind && apart < 1.0 {
                pairs.push((apart, i, j));
            }
        }
    }
    pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut found = vec![None; earlier.len()];
    let mut taken = vec![false; later.len()];
    for (_, i, j) in pairs {
        if found[i].is_none() && !taken[j] {
            (found[i], taken[j]) = (Some(j), true);
        }
    }
    found
}

fn reach(a_mm: f64, b_mm: f64) -> f64 {
    (0.5 * a_mm.max(b_mm)).max(LEAST_REACH_MM)
}

/// The shift of the later list against the earlier one on which most pairs agree; of several, the smallest.
fn shift(earlier: &[Place], later: &[Place], slack_mm: f64) -> (f64, f64) {
    let mut votes: HashMap<(i64, i64), Vec<(f64, f64)>> = HashMap::new();
    for a in earlier.iter().take(MOST_VOTERS) {
        for b in later.iter().take(MOST_VOTERS).filter(|b| b.kind == a.kind) {
            let (dx, dy) = (b.x_mm - a.x_mm, b.y_mm - a.y_mm);
            let alike = a.extent_mm.max(b.extent_mm) < 2.0 * a.extent_mm.min(b.extent_mm);
            if alike && dx.abs() <= slack_mm && dy.abs() <= slack_mm {
                let cell = |d: f64| (d / SHIFT_CELL_MM).round() as i64;
                votes.entry((cell(dx), cell(dy))).or_default().push((dx, dy));
            }
        }
    }
    let gathered = votes.keys().map(|(cx, cy)| {
        let around = (-1..=1).flat_map(|i| (-1..=1).map(move |j| (cx + i, cy + j)));
        around.filter_map(|cell| votes.get(&cell)).flatten().copied().collect::<Vec<_>>()
    });
    let mean = |all: &[(f64, f64)]| {
        let count = all.len() as f64;
        (all.iter().map(|v| v.0).sum::<f64>() / count, all.iter().map(|v| v.1).sum::<f64>() / count)
    };
    let by_weight = gathered.map(|all| (all.len(), mean(&all)));
    let best = by_weight.min_by(|a, b| {
        let far = |s: &(f64, f64)| s.0.hypot(s.1);
        b.0.cmp(&a.0).then(far(&a.1).total_cmp(&far(&b.1)))
    });
    best.map_or((0.0, 0.0), |(_, shift)| shift)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(kind: &'static str, x_mm: f64, y_mm: f64) -> Place<'static> {
        Place { kind, x_mm, y_mm, extent_mm: 40.0 }
    }

    #[test]
    fn the_same_kind_at_the_same_place_is_the_same_and_nothing_is_two() {
        let earlier = [at("dent", 100.0, 0.0), at("dent", 112.0, 0.0), at("hole", 500.0, 20.0), at("dent", 900.0, 0.0)];
        let later = [at("dent", 110.0, 1.0), at("bulge", 501.0, 20.0), at("dent", 925.0, 0.0)];
        assert_eq!(partners(&earlier, &later, 0.0), [None, Some(0), None, None]);
        assert_eq!(partners(&[], &later, 0.0), []);
        assert_eq!(partners(&earlier, &[], 50.0), [None; 4]);
    }

    #[test]
    fn lists_that_lie_shifted_are_laid_on_each_other_by_what_most_agree_on() {
        let earlier = [at("dent", 100.0, 0.0), at("dent", 180.0, 40.0), at("hole", 500.0, 20.0)];
        // Shifted by 70 and -30 mm, with one gone and one new that lies where another was.
        let later = [at("dent", 251.0, 10.0), at("hole", 570.0, -10.0), at("dent", 101.0, 0.0)];
        assert_eq!(partners(&earlier, &later, 100.0), [None, Some(0), Some(1)]);
        // Farther than the slack they are others.
        assert_eq!(partners(&earlier[2..], &later[1..2], 50.0), [None]);
    }
}

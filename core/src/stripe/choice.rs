//! Several spots in a row: continuity along the line decides.
//!
//! The paper knows one spot per row. Real images hold more: other lamps, paint, a second line. The
//! sequence of spots that is strong and bends least is found by dynamic programming over the rows.

use serde::{Deserialize, Serialize};

/// A spot that a row may have.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Candidate {
    /// Where, px.
    pub across_px: f32,
    /// How far it stands out of its row, gray values 0 to 255.
    pub contrast: f32,
}

/// Sideways motion that a line may have from row to row at no great cost, px: a pipe's edge.
const FREE_SLOPE_PX: f32 = 1.5;
/// Cost of a pixel of such motion, in gray values of contrast.
const SLOPE_COST: f32 = 0.5;
/// Cost of a pixel beyond it.
const JUMP_COST: f32 = 8.0;
/// The cost of a jump does not grow past this many pixels: a real step may be larger.
const LARGEST_COUNTED_JUMP_PX: f32 = 400.0;
/// Ends of paths that are followed at once.
const OPEN_ENDS: usize = 16;

/// Two spots belong to one piece of the line when they lie no further apart than this per row between them:
/// noise of the laser's colour in the dark jumps further, and so falls into pieces too short to be believed.
const PIECE_SLOPE_PX: f32 = 1.5;
/// Rows without a spot that do not end a piece.
const PIECE_GAP_ROWS: usize = 3;

/// Which of several spots in a row is the line.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SpotChoice {
    /// The one that continues the line of the other rows, strong and little bent.
    #[default]
    Continuous,
    /// The strongest of its row.
    Strongest,
    /// The one at the least column (row, with a horizontal line).
    First,
    /// The one at the greatest.
    Last,
}

/// One spot or none per row by the given rule; no piece of the line is shorter than `piece_min_rows`.
pub(super) fn choose(rows: &[Vec<Candidate>], choice: SpotChoice, piece_min_rows: usize) -> Vec<Option<Candidate>> {
    let mut line = match choice {
        SpotChoice::Continuous => strongest_path(rows),
        SpotChoice::Strongest => {
            rows.iter().map(|row| row.iter().max_by(|a, b| a.contrast.total_cmp(&b.contrast)).copied()).collect()
        }
        SpotChoice::First => {
            rows.iter().map(|row| row.iter().min_by(|a, b| a.across_px.total_cmp(&b.across_px)).copied()).collect()
        }
        SpotChoice::Last => {
            rows.iter().map(|row| row.iter().max_by(|a, b| a.across_px.total_cmp(&b.across_px)).copied()).collect()
        }
    };
    drop_short_pieces(&mut line, piece_min_rows);
    line
}

/// One spot or none per row, in the order of the rows; no piece of the line is shorter than `piece_min_rows`.
pub(super) fn continuous(rows: &[Vec<Candidate>], piece_min_rows: usize) -> Vec<Option<Candidate>> {
    let mut line = strongest_path(rows);
    drop_short_pieces(&mut line, piece_min_rows);
    line
}

fn drop_short_pieces(line: &mut [Option<Candidate>], piece_min_rows: usize) {
    let mut piece: Vec<usize> = Vec::new();
    for row in 0..=line.len() {
        let spot = line.get(row).copied().flatten();
        let continues = match (spot, piece.last()) {
            (None, Some(last)) => row < line.len() && row - last <= PIECE_GAP_ROWS,
            (Some(spot), Some(&last)) => line[last].is_some_and(|before| {
                let rows = (row - last) as f32;
                row - last <= PIECE_GAP_ROWS + 1 && (spot.across_px - before.across_px).abs() <= PIECE_SLOPE_PX * rows
            }),
            (_, None) => true,
        };
        if !continues {
            if piece.len() < piece_min_rows {
                piece.iter().for_each(|dropped| line[*dropped] = None);
            }
            piece.clear();
        }
        if spot.is_some() {
            piece.push(row);
        }
    }
}

/// The path with the greatest sum of contrast less the cost of its jumps. It may pass rows by, also such
/// as hold spots: a second line shall not be joined to the first one's gaps.
fn strongest_path(rows: &[Vec<Candidate>]) -> Vec<Option<Candidate>> {
    if rows.iter().all(|row| row.len() < 2) {
        return rows.iter().map(|row| row.first().copied()).collect();
    }
    let mut steps: Vec<Step> = Vec::new();
    let mut ends: Vec<usize> = Vec::new();
    for (row, candidates) in rows.iter().enumerate() {
        for candidate in candidates {
            let arrive = |from: &usize| (steps[*from].score - steps[*from].cost_to(row, candidate), Some(*from));
            let begin = (0.0, None);
            let (score, from) = ends.iter().map(arrive).fold(begin, |a, b| if b.0 > a.0 { b } else { a });
            steps.push(Step { row, candidate: *candidate, score: score + candidate.contrast, from });
        }
        ends.extend(steps.len() - candidates.len()..steps.len());
        ends.sort_by(|a, b| steps[*b].score.total_cmp(&steps[*a].score));
        ends.truncate(OPEN_ENDS);
    }
    let mut path = vec![None; rows.len()];
    let mut at = ends.first().copied();
    while let Some(index) = at {
        path[steps[index].row] = Some(steps[index].candidate);
        at = steps[index].from;
    }
    path
}

/// The best path that ends in one candidate.
struct Step {
    row: usize,
    candidate: Candidate,
    score: f32,
    from: Option<usize>,
}

impl Step {
    fn cost_to(&self, row: usize, candidate: &Candidate) -> f32 {
        let sideways_px = (candidate.across_px - self.candidate.across_px).abs();
        let jump_px = (sideways_px - FREE_SLOPE_PX * (row - self.row) as f32).clamp(0.0, LARGEST_COUNTED_JUMP_PX);
        SLOPE_COST * sideways_px.min(LARGEST_COUNTED_JUMP_PX) + JUMP_COST * jump_px
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spot(across_px: f32, contrast: f32) -> Candidate {
        Candidate { across_px, contrast }
    }

    #[test]
    fn a_lamp_beside_the_line_is_passed_by() {
        let rows: Vec<Vec<Candidate>> = (0..40)
            .map(|i| {
                let line = spot(100.0 + i as f32 * 0.3, 80.0);
                if (10..20).contains(&i) { vec![spot(30.0, 120.0), line] } else { vec![line] }
            })
            .collect();
        let chosen = continuous(&rows, 1);
        assert!(chosen.iter().all(|c| c.is_some_and(|c| c.across_px >= 100.0)));
    }

    #[test]
    fn of_two_lines_one_is_kept() {
        let rows: Vec<Vec<Candidate>> =
            (0..60).map(|i| vec![spot(50.0, 90.0 + (i % 7) as f32), spot(200.0, 90.0 + (i % 5) as f32)]).collect();
        let chosen = continuous(&rows, 1);
        let first = chosen[0].expect("a spot").across_px;
        assert!(chosen.iter().all(|c| c.is_some_and(|c| c.across_px == first)));
    }

    #[test]
    fn a_gap_in_the_line_is_not_filled_from_another_line() {
        let rows: Vec<Vec<Candidate>> = (0..200)
            .map(|i| {
                if (60..100).contains(&i) { vec![spot(300.0, 60.0)] } else { vec![spot(50.0, 60.0), spot(300.0, 50.0)] }
            })
            .collect();
        let chosen = continuous(&rows, 12);
        let first = chosen[0].expect("a spot").across_px;
        assert!(chosen.iter().flatten().all(|c| c.across_px == first));
    }

    #[test]
    fn noise_that_jumps_about_is_no_line() {
        let jumps = [0.0, 2.5, -1.0, 3.0, 0.5, -2.0, 1.0, 4.0];
        let rows: Vec<Vec<Candidate>> =
            (0..100).map(|i| vec![spot(100.0 + if i < 40 { jumps[i % 8] } else { 0.2 * i as f32 }, 50.0)]).collect();
        let chosen = continuous(&rows, 12);
        assert!((0..100).all(|i| chosen[i].is_some() == (i >= 40)));
    }

    #[test]
    fn rows_without_spots_stay_empty() {
        let rows = vec![vec![], vec![spot(1.0, 9.0), spot(2.0, 10.0)], vec![], vec![spot(2.0, 10.0)]];
        let chosen = continuous(&rows, 1);
        assert_eq!(chosen.iter().map(Option::is_some).collect::<Vec<_>>(), [false, true, false, true]);
    }

    #[test]
    fn specks_are_dropped_and_a_broken_line_is_kept() {
        let mut rows: Vec<Vec<Candidate>> = (0..100).map(|i| vec![spot(100.0 + i as f32 * 0.5, 50.0)]).collect();
        rows[40..43].fill(vec![]); // a short gap
        rows[60..64].fill(vec![spot(300.0, 90.0)]); // a speck elsewhere, with nothing of the line in its rows
        let chosen = continuous(&rows, 12);
        assert!((0..100).all(|i| chosen[i].is_some() != ((40..43).contains(&i) || (60..64).contains(&i))));
    }
}

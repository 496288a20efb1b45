//! Several spots in a row: continuity along the line decides.
//!
//! The paper knows one spot per row. Real images hold more: other lamps, paint, a second line. The
//! sequence of spots that is strong and bends least is found by dynamic programming over the rows.

/// A spot that a row may have.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Candidate {
    /// Where, px.
    pub across_px: f32,
    /// How far it stands out of its row, gray values 0 to 255.
    pub contrast: f32,
}

/// The cost of a jump does not grow past this many pixels: a real step may be larger.
const LARGEST_COUNTED_JUMP_PX: f32 = 40.0;
/// Cost of one pixel of jump, in gray values of contrast.
const COST_PER_PX: f32 = 8.0;

/// Two spots belong to one piece of the line when they lie no further apart than this per row between them.
const PIECE_SLOPE_PX: f32 = 4.0;
/// Rows without a spot that do not end a piece.
const PIECE_GAP_ROWS: usize = 3;

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

fn strongest_path(rows: &[Vec<Candidate>]) -> Vec<Option<Candidate>> {
    if rows.iter().all(|row| row.len() < 2) {
        return rows.iter().map(|row| row.first().copied()).collect();
    }
    // best[i][j]: the best sum of a path that ends in candidate j of the i-th row that has any.
    let filled: Vec<usize> = (0..rows.len()).filter(|i| !rows[*i].is_empty()).collect();
    let mut best: Vec<Vec<(f32, usize)>> = Vec::with_capacity(filled.len());
    for (position, &row) in filled.iter().enumerate() {
        let scores = rows[row].iter().map(|candidate| {
            let Some(previous) = position.checked_sub(1) else { return (candidate.contrast, 0) };
            let before = &rows[filled[previous]];
            let gap_rows = (row - filled[previous]) as f32;
            let arrive = |(index, from): (usize, &Candidate)| {
                let jump_px = ((candidate.across_px - from.across_px).abs() / gap_rows).min(LARGEST_COUNTED_JUMP_PX);
                (best[previous][index].0 - COST_PER_PX * jump_px, index)
            };
            let (score, index) =
                before.iter().enumerate().map(arrive).fold((f32::MIN, 0), |a, b| if b.0 > a.0 { b } else { a });
            (score + candidate.contrast, index)
        });
        let scores: Vec<_> = scores.collect();
        best.push(scores);
    }
    let mut chosen = vec![None; rows.len()];
    let last = best.last().map_or(&[][..], Vec::as_slice);
    let mut index = (0..last.len()).fold(0, |a, b| if last[b].0 > last[a].0 { b } else { a });
    for (position, &row) in filled.iter().enumerate().rev() {
        chosen[row] = Some(rows[row][index]);
        index = best[position][index].1;
    }
    chosen
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

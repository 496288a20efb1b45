//! The laser's lines of all photos: which way they lie, which photo is free of the laser, which corners they spoil.

use super::board::{self, Corner};
use super::camera::{self, CameraFit, Posed, View};
use super::line::{self, BoardLine};
use super::{Options, Photo, light};
use crate::rig::LineDirection;

/// Two photos show one pose where their corners lie so near together, root mean square px.
const SAME_POSE_PX: f64 = 0.3;
/// Corners are left out within the line's reach: so many of its standard deviations, and the corner's own window.
const LINE_SIGMAS: f64 = 4.0;

/// The laser's line in each view, in the direction that most of the light agrees with.
pub(super) fn find(photos: &[Photo], options: &Options, fit: &CameraFit) -> Vec<Option<BoardLine>> {
    let directions = match options.line {
        Some(direction) => vec![direction],
        None => vec![LineDirection::Vertical, LineDirection::Horizontal],
    };
    let look = |view: &Posed, without: Option<&Posed>, direction: LineDirection| {
        let image = &photos[view.photo].image;
        let evidence = light::evidence(image, options.colour, without.map(|w| &photos[w.photo].image));
        line::find(&evidence, &fit.camera, &options.board, &view.camera_from_board, direction)
    };
    let found = directions.iter().map(|direction| {
        let lines: Vec<_> = fit.views.iter().map(|view| look(view, None, *direction)).collect();
        let spots: usize = lines.iter().flatten().map(|l| l.spots.len()).sum();
        (spots, *direction, lines)
    });
    let Some((_, direction, lines)) = found.max_by_key(|(spots, ..)| *spots) else { return Vec::new() };
    let dark: Vec<&Posed> = fit.views.iter().zip(&lines).filter(|(_, l)| l.is_none()).map(|(v, _)| v).collect();
    let views = fit.views.iter().zip(lines);
    let better = |(view, line): (&Posed, Option<BoardLine>)| {
        let twin = dark.iter().find(|d| d.photo != view.photo && same_pose(d, view))?;
        look(view, Some(twin), direction).filter(|_| line.is_some())
    };
    views.map(|(view, line)| better((view, line.clone())).or(line)).collect()
}

/// True where two photos show the board in one place, whichever end the detector began at.
fn same_pose(a: &Posed, b: &Posed) -> bool {
    let last = a.corners.iter().chain(&b.corners).map(|c| c.index).max().unwrap_or(0);
    let apart = |turned: bool| {
        let pairs = a.corners.iter().filter_map(|one| {
            let index = if turned { last - one.index } else { one.index };
            let other = b.corners.iter().find(|c| c.index == index)?;
            Some((one.pixel.u_px - other.pixel.u_px).powi(2) + (one.pixel.v_px - other.pixel.v_px).powi(2))
        });
        let (sum, count) = pairs.fold((0.0, 0.0), |(sum, count), square| (sum + square, count + 1.0));
        (sum / count).sqrt()
    };
    apart(false) < SAME_POSE_PX || apart(true) < SAME_POSE_PX
}

/// A view without the corners that the laser's light reaches; the others measured again in all channels.
pub(super) fn without(mut view: View, photos: &[Photo], lines: &[Option<BoardLine>], fit: &CameraFit) -> View {
    let line = fit.views.iter().position(|v| v.photo == view.photo).and_then(|i| lines.get(i)?.as_ref());
    let clear = |c: &Corner| {
        line.is_none_or(|line| line.distance_px(&fit.camera, c.pixel) > LINE_SIGMAS * line.sigma_px + c.window_px)
    };
    if view.corners.iter().filter(|c| clear(c)).count() >= camera::MIN_CORNERS {
        let mut corners = view.corners.clone();
        corners.retain(clear);
        board::measure_again(&photos[view.photo].image, &mut corners);
        if corners.len() >= camera::MIN_CORNERS {
            view.corners = corners;
        }
    }
    view
}

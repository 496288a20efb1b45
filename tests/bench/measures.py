"""One function per measure: run and products in, a flat dictionary of figures out (None = does not apply)."""

import numpy as np

from geometry import angle_deg
from run_data import DepthMap, Run, Trajectory
from surface_error import Alignment, TrueSurface, residuals

FALSE_PX = 3.0
"""A stripe further than this from the truth is false."""
STILL_MM = 1e-3
"""A true step shorter than this is standing still."""
STILL_FRAMES = 5
"""Shortest standstill that is looked at."""
REVISIT_CELL_MM = 2.0
LEAST_ROWS = 20
"""Pairs of pixels that two neighbouring columns need to be compared."""


def percent(share: float) -> float:
    """A share as percent."""
    return 100.0 * float(share)


def stripe_error(run: Run, stripes_px: np.ndarray) -> dict:
    """Measured stripes [frames, positions] against the true ones."""
    frames = min(len(stripes_px), len(run.stripes_px))
    found, true = stripes_px[:frames].astype(float), run.stripes_px[:frames].astype(float)
    finite, measurable = np.isfinite(found), run.measurable[:frames]
    error = found - true
    false = finite & ~(np.abs(error) <= FALSE_PX)
    on_rows = error[finite & measurable & np.isfinite(true)]
    figures = {
        "stripe_found_percent": percent((finite & measurable).sum() / measurable.sum()) if measurable.any() else None,
        "stripe_false_percent": percent(false.mean()),
        "stripe_false_rows": int(false.sum()),
    }
    if len(on_rows):
        near = on_rows[np.abs(on_rows) <= FALSE_PX]
        figures |= {
            "stripe_median_px": float(np.median(np.abs(on_rows))),
            "stripe_p95_px": float(np.percentile(np.abs(on_rows), 95)),
            "stripe_bias_px": float(near.mean()) if len(near) else None,
        }
    return figures


def cloud_error(points_mm: np.ndarray, surface: TrueSurface, alignment: Alignment) -> dict:
    """The aligned cloud [n, 3] against the true surface: distances along the normal, and along z."""
    along_z, distance, _ = residuals(alignment.apply(points_mm), surface)
    on = np.isfinite(distance)
    if not on.any():
        return {"cloud_points": len(points_mm)}
    size = np.abs(distance[on])
    return {
        "cloud_points": len(points_mm),
        "cloud_rmse_mm": float(np.sqrt(np.mean(size**2))),
        "cloud_median_mm": float(np.median(size)),
        "cloud_p95_mm": float(np.percentile(size, 95)),
        "cloud_z_rmse_mm": float(np.sqrt(np.mean(along_z[on] ** 2))),
        "cloud_off_surface_percent": percent(1 - on.mean()),
        "align_shift_mm": float(np.linalg.norm(alignment.apply(points_mm.mean(axis=0)) - points_mm.mean(axis=0))),
        "align_turn_deg": float(angle_deg(alignment.rotation[None])[0]),
    }


def travel(run: Run, trajectory: Trajectory) -> dict:
    """Distance travelled against the truth, in percent: at the end along x, and the whole path's length."""
    true, found = run.trajectory.position_mm, trajectory.position_mm
    found = found[np.isfinite(found).all(axis=1)]
    if len(found) < 2 or abs(true[-1, 0] - true[0, 0]) < 1:
        return {}

    def path_mm(positions: np.ndarray) -> float:
        return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())

    end_mm, true_end_mm = found[-1, 0] - found[0, 0], true[-1, 0] - true[0, 0]
    return {
        "travel_true_mm": float(true_end_mm),
        "travel_error_percent": percent(end_mm / true_end_mm - 1),
        "path_error_percent": percent(path_mm(found) / path_mm(true) - 1),
    }


def pose_error(run: Run, trajectory: Trajectory, alignment: Alignment) -> dict:
    """Poses after the cloud's alignment, and the image's shift, against the truth."""
    _, mine, theirs = np.intersect1d(trajectory.frame, run.trajectory.frame, return_indices=True)
    true = run.trajectory.position_mm[theirs]
    off = np.linalg.norm(alignment.apply(trajectory.position_mm[mine]) - true, axis=1)
    turned = np.isfinite(trajectory.angles_deg[mine]).all(axis=1)
    between = np.swapaxes(run.trajectory.rotations[theirs], 1, 2) @ alignment.rotation @ trajectory.rotations[mine]
    angles = angle_deg(between[turned])
    shift = (trajectory.shift_px[mine] - run.trajectory.shift_px[theirs])[1:]
    tracked = shift[np.isfinite(shift).all(axis=1)]
    figures = {"frames_without_shift": int(len(shift) - len(tracked))}
    if np.isfinite(off).any():
        figures["position_rms_mm"] = float(np.sqrt(np.nanmean(off**2)))
        figures["position_max_mm"] = float(np.nanmax(off))
    if len(angles):
        figures["rotation_rms_deg"] = float(np.sqrt(np.mean(angles**2)))
    if len(tracked):
        figures |= {
            "dx_bias_px": float(tracked[:, 0].mean()),
            "dx_rms_px": float(np.sqrt(np.mean(tracked[:, 0] ** 2))),
            "dy_bias_px": float(tracked[:, 1].mean()),
        }
    return figures


def drift(run: Run, trajectory: Trajectory, stated: dict | None) -> dict:
    """Where the last frame is, against the truth and against what the manifest states of it: the largest of the three
    directions, in stated standard deviations."""
    if not stated or not np.isfinite(trajectory.position_mm[-1]).all():
        return {}
    off_mm = trajectory.position_mm[-1] - run.trajectory.position_mm[trajectory.frame[-1]]
    stated_mm = np.array([stated["x_mm"], stated["y_mm"], stated["z_mm"]])
    return {"drift_sigmas": float(np.max(np.abs(off_mm) / stated_mm)), "drift_x_mm": float(stated_mm[0])}


def runs_of(mask: np.ndarray) -> list[tuple[int, int]]:
    """The stretches (first, one past the last) where a mask [n] is true."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def standstill(run: Run, trajectory: Trajectory) -> dict:
    """While the true camera stands still: the largest spread (max − min) of the measured place, mm."""
    still = np.linalg.norm(np.diff(run.trajectory.position_mm, axis=0), axis=1) < STILL_MM
    spreads = []
    for first, end in runs_of(still):
        # Step k leads from frame k to frame k + 1.
        inside = (trajectory.frame >= first) & (trajectory.frame <= end)
        places = trajectory.position_mm[inside]
        places = places[np.isfinite(places).all(axis=1)]
        if end - first >= STILL_FRAMES and len(places) >= STILL_FRAMES:
            spreads.append(np.ptp(places, axis=0))
    if not spreads:
        return {}
    x, y, z = np.max(spreads, axis=0)
    return {"still_spread_x_mm": float(x), "still_spread_y_mm": float(y), "still_spread_z_mm": float(z)}


def revisit(run: Run, points_mm: np.ndarray, frame: np.ndarray, surface: TrueSurface, alignment: Alignment) -> dict:
    """The same place seen on different passes: |dz| between the passes' means in cells of 2 mm.

    Passes end where the true travel turns round. The true surface is taken off first, so that a slope within a
    cell does not count while a pass that lies beside the other does.
    """
    step = np.diff(run.trajectory.position_mm[:, 0])
    direction = np.sign(np.where(np.abs(step) < STILL_MM, 0, step))
    moving = np.flatnonzero(direction)
    if len(moving) == 0 or (direction[moving] == direction[moving[0]]).all():
        return {}
    turns = moving[1:][np.diff(direction[moving]) != 0]
    pass_of_frame = np.searchsorted(turns, np.arange(len(run.trajectory.frame)), side="right")
    aligned = alignment.apply(points_mm)
    off_mm, _, _ = residuals(aligned, surface)
    use = np.isfinite(off_mm) & (frame < len(pass_of_frame))
    cell = np.floor(aligned[use, :2] / REVISIT_CELL_MM).astype(np.int64)
    cell -= cell.min(axis=0)
    place = cell[:, 0] * (cell[:, 1].max() + 1) + cell[:, 1]
    passes = len(turns) + 1
    key, of = np.unique(place * passes + pass_of_frame[frame[use]], return_inverse=True)
    mean_mm = np.bincount(of, weights=off_mm[use]) / np.bincount(of)
    # Keys are sorted by place: neighbours with the same place are two passes over it.
    same = key[1:] // passes == key[:-1] // passes
    difference = np.abs(np.diff(mean_mm))[same]
    if len(difference) == 0:
        return {}
    return {
        "revisit_cells": int(same.sum()),
        "revisit_median_mm": float(np.median(difference)),
        "revisit_p95_mm": float(np.percentile(difference, 95)),
    }


def jitter(depth: DepthMap, surface: TrueSurface) -> dict:
    """Vertical stripes of the depth map: mean |median over rows of z(column + 1) − z(column)| in mm, with the true
    surface's own taken off."""
    if min(depth.z_mm.shape) < 2:
        return {}
    step = np.diff(depth.z_mm.astype(float), axis=1)
    true = np.diff(surface.at(*np.meshgrid(depth.x_mm, depth.y_mm))[0], axis=1)
    both = np.isfinite(step) & np.isfinite(true)
    columns = both.sum(axis=0) >= LEAST_ROWS
    if not columns.any():
        return {}

    def medians(of: np.ndarray) -> np.ndarray:
        return np.nanmedian(np.where(both, of, np.nan)[:, columns], axis=0)

    return {"jitter_mm": float(np.abs(medians(step) - medians(true)).mean())}

"""How much of the surface that could be measured has a depth."""

import numpy as np

from run_data import DepthMap, Run

CELL_MM = 2.0
SAMPLE_MM = 1.0
"""Places between two neighbouring profiles are taken this far apart."""
LONGEST_FILL_MM = 50.0
"""Neighbouring profiles further apart than this are not joined."""


def cells(x_mm: np.ndarray, y_mm: np.ndarray, origin_mm: tuple[float, float], shape: tuple[int, int]) -> np.ndarray:
    """Marks the cells [rows, columns] of `CELL_MM` from `origin_mm` on that hold any of the places."""
    marked = np.zeros(shape, bool)
    finite = np.isfinite(x_mm) & np.isfinite(y_mm)
    column = np.floor((x_mm[finite] - origin_mm[0]) / CELL_MM).astype(int)
    row = np.floor((y_mm[finite] - origin_mm[1]) / CELL_MM).astype(int)
    inside = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
    marked[row[inside], column[inside]] = True
    return marked


def measurable_cells(run: Run) -> tuple[np.ndarray, tuple[float, float]]:
    """The grid of `CELL_MM` of all places that a frame's measurable stripe passed, filled linearly between
    neighbouring frames; and its origin (x, y) in mm."""
    points = run.measurable_points_mm()[..., :2]
    seen = points[np.isfinite(points[..., 0])]
    if len(seen) == 0:
        return np.zeros((0, 0), bool), (0.0, 0.0)
    origin = (float(seen[:, 0].min()), float(seen[:, 1].min()))
    extent = seen.max(axis=0) - origin
    shape = (int(extent[1] / CELL_MM) + 1, int(extent[0] / CELL_MM) + 1)
    marked = cells(points[..., 0].ravel(), points[..., 1].ravel(), origin, shape)
    step = points[1:] - points[:-1]
    length = np.linalg.norm(step, axis=-1)
    close = np.where(length <= LONGEST_FILL_MM, length, np.nan)
    if np.isfinite(close).any():
        parts = int(np.ceil(np.nanmax(close) / SAMPLE_MM)) + 1
        for k in range(1, parts):
            between = points[:-1] + step * np.where(np.isfinite(close), k / parts, np.nan)[..., None]
            marked |= cells(between[..., 0].ravel(), between[..., 1].ravel(), origin, shape)
    return marked, origin


def coverage(run: Run, depth: DepthMap) -> dict:
    """Percent of the measurable cells with a depth, and of the cells with a depth that no measurable stripe
    passed (both None where nothing could be measured)."""
    wanted, origin = measurable_cells(run)
    if not wanted.any():
        return {"coverage_percent": None, "depth_elsewhere_percent": None}
    if depth.z_mm.size == 0:
        return {"coverage_percent": 0.0, "depth_elsewhere_percent": None}
    rows, columns = np.nonzero(np.isfinite(depth.z_mm))
    has = cells(depth.x_mm[columns], depth.y_mm[rows], origin, wanted.shape)
    # Maps with pixels larger than a cell: the pixel at the cell's centre speaks for it.
    x = origin[0] + CELL_MM * (np.arange(wanted.shape[1]) + 0.5)
    y = origin[1] + CELL_MM * (np.arange(wanted.shape[0]) + 0.5)
    column = np.rint((x - depth.x_mm[0]) / depth.mm_per_px).astype(int)
    row = np.rint((y - depth.y_mm[0]) / depth.mm_per_px).astype(int)
    in_x, in_y = (column >= 0) & (column < len(depth.x_mm)), (row >= 0) & (row < len(depth.y_mm))
    has[np.ix_(in_y, in_x)] |= np.isfinite(depth.z_mm[np.ix_(row[in_y], column[in_x])])
    elsewhere = (has & ~wanted).sum() / max(has.sum(), 1)
    return {
        "coverage_percent": 100.0 * float(has[wanted].mean()),
        "depth_elsewhere_percent": 100.0 * float(elsewhere),
    }

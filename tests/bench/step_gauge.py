"""The step gauge: the height of each block above the plate around it."""

import numpy as np

from run_data import Run

INSIDE_MM = 4.0
"""Points of a block are taken this far from its edges: places along x may be off by a little."""
RING_MM = (4.0, 12.0)
"""Points of the plate around a block are taken from here to there outside its edges."""
LEAST_POINTS = 60


def blocks(run: Run, feature: dict) -> list[tuple[float, float, float, float]]:
    """(x from, x to, y from, y to) in mm of a step's blocks, found in the true surface along its middle line."""
    step_mm, x0_mm, y0_mm = (run.surface[key] for key in ("step_mm", "x0_mm", "y0_mm"))
    row = int(round((feature["y"] - y0_mm) / step_mm))
    if not 0 <= row < len(run.surface_z_mm):
        return []
    z_mm = run.surface_z_mm[row].astype(float)
    plate_mm = np.nanmax(z_mm)
    on = plate_mm - z_mm > feature["height"] / 2
    edges = np.flatnonzero(np.diff(on.astype(np.int8)))
    bounds = [0, *(edges + 1), len(on)]
    y = (feature["y"] - feature["half"], feature["y"] + feature["half"])
    return [
        (x0_mm + step_mm * first, x0_mm + step_mm * (end - 1), *y)
        for first, end in zip(bounds[:-1], bounds[1:], strict=True)
        if on[first]
    ]


def height_mm(points_mm: np.ndarray, block: tuple[float, float, float, float]) -> float | None:
    """How far the points [n, 3] on a block stand in front of a plane through the plate around it."""
    x_from, x_to, y_from, y_to = block
    x, y, z = points_mm.T
    # Distance outside the block's rectangle; negative inside.
    outside = np.maximum(np.maximum(x_from - x, x - x_to), np.maximum(y_from - y, y - y_to))
    top, ring = outside < -INSIDE_MM, (outside > RING_MM[0]) & (outside < RING_MM[1])
    if top.sum() < LEAST_POINTS or ring.sum() < LEAST_POINTS:
        return None
    centre = points_mm[ring].mean(axis=0)
    off = points_mm - centre
    plane = np.zeros(3)
    use = ring
    # Twice more without the points far from the plane: a neighbouring block may reach into the ring.
    for _ in range(3):
        terms = np.column_stack([off[use, 0], off[use, 1], np.ones(use.sum())])
        plane, *_ = np.linalg.lstsq(terms, off[use, 2], rcond=None)
        miss = off[:, 2] - off[:, :2] @ plane[:2] - plane[2]
        spread = np.median(np.abs(miss[ring] - np.median(miss[ring])))
        use = ring & (np.abs(miss - np.median(miss[ring])) <= 3 * max(spread, 0.02))
    return float(-np.median(off[top, 2] - off[top, :2] @ plane[:2] - plane[2]))


def step_heights(run: Run, points_mm: np.ndarray, label: str) -> dict:
    """Error in mm of each step's height (measured − true, mean over its blocks); None where no block was seen.

    `points_mm` [n, 3] from the cloud or the depth map (`label` names which).
    """
    figures: dict = {}
    for feature in run.surface.get("features", []):
        if feature["kind"] != "step":
            continue
        margin = RING_MM[1] + 1
        near = points_mm[np.abs(points_mm[:, 1] - feature["y"]) < feature["half"] + margin]
        heights = []
        for block in blocks(run, feature):
            around = near[(near[:, 0] > block[0] - margin) & (near[:, 0] < block[1] + margin)]
            heights.append(height_mm(around, block))
        known = [h for h in heights if h is not None]
        error = float(np.mean(known)) - feature["height"] if known else None
        figures[f"step_{feature['height']:g}_{label}_error_mm"] = error
    return figures

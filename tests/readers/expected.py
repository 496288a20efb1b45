"""What the Rust side says that a product should hold."""

import json
import sys
from pathlib import Path

import numpy as np

FOLDER = Path(sys.argv[1])


def expected():
    return json.loads((FOLDER / "expected.json").read_text())


def map_geometry():
    return expected()["map"]


def depth_mm():
    geometry = map_geometry()
    return np.fromfile(FOLDER / "depth.f32", "<f4").reshape(geometry["height_px"], geometry["width_px"])


def texture_rgb():
    geometry = map_geometry()
    return np.fromfile(FOLDER / "texture.rgb", "u1").reshape(geometry["height_px"], geometry["width_px"], 3)


def halved(values):
    """Half the size: the mean of what was measured of each four."""
    rows, columns = (size + size % 2 for size in values.shape)
    padded = np.full((rows, columns), np.nan)
    padded[: values.shape[0], : values.shape[1]] = values
    fours = padded.reshape(rows // 2, 2, columns // 2, 2).transpose(0, 2, 1, 3).reshape(rows // 2, columns // 2, 4)
    measured = np.isfinite(fours)
    sums = np.where(measured, fours, 0).sum(axis=2)
    counts = measured.sum(axis=2)
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)

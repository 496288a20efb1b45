"""Cross-sections from the server against depth.tif as tifffile reads it: every number, pixel by pixel."""

import csv
import json
import sys
from pathlib import Path

import numpy as np
import tifffile

FOLDER = Path(sys.argv[1])
MAP = json.loads((FOLDER / "manifest.json").read_text())["depth_map"]
DEPTH_MM = tifffile.imread(FOLDER / "depth.tif")


def expected(section):
    """The nearest pixel's value at each of the section's places; NaN outside."""
    column = np.rint((np.array(section["x_mm"]) - MAP["x0_mm"]) / MAP["mm_per_px"]).astype(int)
    row = np.rint((np.array(section["y_mm"]) - MAP["y0_mm"]) / MAP["mm_per_px"]).astype(int)
    inside = (column >= 0) & (column < DEPTH_MM.shape[1]) & (row >= 0) & (row < DEPTH_MM.shape[0])
    z_mm = np.full(len(column), np.nan, np.float32)
    z_mm[inside] = DEPTH_MM[row[inside], column[inside]]
    return z_mm


sections = json.loads((FOLDER / "sections.json").read_text())
for section in sections:
    found = np.array([np.nan if z is None else z for z in section["z_mm"]], np.float32)
    np.testing.assert_array_equal(found, expected(section))
    assert np.isfinite(found).sum() > 50, "a section of holes tests nothing"
    np.testing.assert_allclose(section["chainage_mm"], 5000 - np.array(section["x_mm"]), atol=1e-9)
    way = np.hypot(np.diff(section["x_mm"]), np.diff(section["y_mm"]))
    np.testing.assert_allclose(way, section["step_mm"], atol=1e-6)
    np.testing.assert_allclose(np.diff(section["distance_mm"]), section["step_mm"], atol=1e-6)

rows = list(csv.DictReader((FOLDER / "section.csv").open()))
assert [row["z_mm"] for row in rows] == ["" if z is None else row["z_mm"] for z, row in zip(sections[1]["z_mm"], rows)]
numbers = np.array([float(row["z_mm"]) if row["z_mm"] else np.nan for row in rows], np.float32)
np.testing.assert_array_equal(numbers, np.array([np.nan if z is None else z for z in sections[1]["z_mm"]], np.float32))

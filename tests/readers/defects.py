"""The defect list, the sections and the residual map agree with each other."""

import csv
import json
import sys
from pathlib import Path

import numpy as np
import rasterio

FOLDER = Path(sys.argv[1])
listed = json.loads((FOLDER / "defects.json").read_text())
with open(FOLDER / "defects.csv", newline="") as file:
    table = list(csv.DictReader(file))
with open(FOLDER / "sections.csv", newline="") as file:
    sections = list(csv.DictReader(file))

assert len(table) == len(listed["defects"]) > 0
for row, defect in zip(table, listed["defects"], strict=True):
    assert row["id"] == str(defect["id"]) and row["kind"] == defect["kind"]
    for name in ("chainage_mm", "x_mm", "y_mm", "depth_mm", "area_mm2", "volume_mm3", "confidence"):
        assert abs(float(row[name]) - defect[name]) < 0.1, (name, row, defect)
    assert 0 < defect["confidence"] <= 1 and defect["severity"] in ("minor", "moderate", "severe")

assert len(sections) >= 5
steps = np.diff([float(row["chainage_mm"]) for row in sections])
assert np.allclose(steps[:-1], 100, atol=2), steps
assert all(float(row["flatness_mm"]) > 0 and row["radius_mm"] == "" for row in sections)

with rasterio.open(FOLDER / "residual.tif") as file:
    residual = file.read(1)
    assert abs(file.transform.a - listed["cell_mm"]) < 1e-9
    for defect in listed["defects"]:
        row, column = file.index(defect["deepest_x_mm"], defect["deepest_y_mm"])
        near = residual[row - 2 : row + 3, column - 2 : column + 3]
        assert abs(np.nanmedian(near) - defect["depth_mm"]) < max(0.8, 0.15 * abs(defect["depth_mm"])), defect
    quiet = residual[np.isfinite(residual)]
    assert np.median(np.abs(quiet)) < 3 * listed["noise_mm"] + 0.1

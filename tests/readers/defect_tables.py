"""The server's defects as CSV and as GeoJSON against its JSON."""

import csv
import json
import sys
from pathlib import Path

FOLDER = Path(sys.argv[1])
listed = json.loads((FOLDER / "list.json").read_text())["items"]
with open(FOLDER / "defects.csv", newline="", encoding="utf-8") as file:
    table = list(csv.DictReader(file))
collection = json.loads((FOLDER / "defects.geojson").read_text())

assert collection["type"] == "FeatureCollection" and "no places on Earth" in collection["coordinates_are"]
assert collection["crs"] is None
assert len(table) == len(collection["features"]) == len(listed) > 3
for row, feature, defect in zip(table, collection["features"], listed, strict=True):
    assert row["id"] == feature["id"] == defect["id"]
    assert feature["type"] == "Feature" and feature["geometry"]["type"] == "Point"
    x, y = feature["geometry"]["coordinates"]
    assert abs(x - defect["chainage_mm"] / 1000) < 1e-9, feature
    assert feature["properties"]["y_is"] == "height_m" and abs(y - defect["height_mm"] / 1000) < 1e-9, feature
    assert row["clock_h"] == "" and row["comment"] == defect["comment"], row
    for name in ("kind", "severity", "state", "asset", "run", "job"):
        assert row[name] == defect[name] == feature["properties"][name], (name, row)
    for name in ("chainage_mm", "height_mm", "depth_mm", "area_mm2", "confidence"):
        assert abs(float(row[name]) - defect[name]) < 0.001, (name, row)
print(len(table))

"""manifest.json by Python's json, its hashes by hashlib."""

import hashlib
import json

from expected import FOLDER, map_geometry

manifest = json.loads((FOLDER / "manifest.json").read_text())
assert manifest["schema_version"] == 1 and manifest["depth_map"] == map_geometry()
names = [product["name"] for product in manifest["products"]]
on_disk = sorted(str(p.relative_to(FOLDER)) for p in FOLDER.rglob("*") if p.is_file())
on_disk.remove("manifest.json")
assert names == on_disk and "tiles/tiles.json" in names and "depth.tif" in names, names
for product in manifest["products"]:
    content = (FOLDER / product["name"]).read_bytes()
    assert product["bytes"] == len(content), product
    assert product["sha256"] == hashlib.sha256(content).hexdigest(), product

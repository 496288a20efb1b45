"""The pyramid as a browser would read it: tiles.json says where everything is and what it means."""

import json

import numpy as np
from expected import FOLDER, depth_mm, halved, texture_rgb
from PIL import Image

TILES = FOLDER / "tiles"
index = json.loads((TILES / "tiles.json").read_text())
assert index["complete"] and index["schema_version"] == 1
SIDE = index["tile_side_px"]


def level_depth(level):
    """The whole level from its tiles, mm."""
    rows = []
    for row in range(level["first_row"], level["last_row"] + 1):
        line = []
        for column in range(level["first_column"], level["last_column"] + 1):
            image = Image.open(TILES / f"depth/{level['level']}/{column}_{row}.png")
            assert image.mode == "RGB" and image.size == (SIDE, SIDE)
            red, green, blue = np.moveaxis(np.asarray(image).astype(np.int64), 2, 0)
            value = red * 65536 + green * 256 + blue
            z_mm = value * index["depth_step_mm"] + index["depth_offset_mm"]
            line.append(np.where(value == 0, np.nan, z_mm))
        rows.append(np.hstack(line))
    return np.vstack(rows)


geometry, grid = index["depth_map"], index["grid"]
# The map's first pixel, counted from the first pixel of the first tile.
first = index["levels"][0]
left = round((geometry["x0_mm"] - grid["x0_mm"]) / grid["mm_per_px"]) - first["first_column"] * SIDE
top = round((geometry["y0_mm"] - grid["y0_mm"]) / grid["mm_per_px"]) - first["first_row"] * SIDE
assert first["first_column"] == -1 and first["first_row"] == -1, "the map reaches left of and above the origin"

whole = level_depth(first)
truth = np.full(whole.shape, np.nan)
truth[top : top + geometry["height_px"], left : left + geometry["width_px"]] = depth_mm()
np.testing.assert_allclose(whole, truth, rtol=0, atol=0.00056)

# The next level's first tile holds the tiles -2 and -1 of this one.
half = level_depth(index["levels"][1])
padded = np.full((whole.shape[0] + SIDE, whole.shape[1] + SIDE), np.nan)
padded[SIDE:, SIDE:] = truth
expected = halved(padded)
np.testing.assert_allclose(half[: expected.shape[0], : expected.shape[1]], expected, rtol=0, atol=0.0008)

low, high = index["depth_range_mm"]
inside = np.mean((depth_mm() >= low) & (depth_mm() <= high)) / np.mean(np.isfinite(depth_mm()))
assert 0.97 < inside < 0.995, inside

top_level = index["levels"][-1]
assert max(geometry["width_px"], geometry["height_px"]) / 2 ** top_level["level"] <= SIDE

texture = np.asarray(Image.open(TILES / "texture/0/0_0.jpg")).astype(int)
assert texture.shape == (SIDE, SIDE, 3)
column, row = SIDE - left, SIDE - top
assert np.median(np.abs(texture - texture_rgb()[row : row + SIDE, column : column + SIDE])) <= 2

"""depth.png by Pillow: 16-bit gray and its own text."""

import numpy as np
from expected import FOLDER, depth_mm, expected
from PIL import Image

image = Image.open(FOLDER / "depth.png")
assert image.mode.startswith("I;16"), image.mode
text = image.text
geometry, scale = expected()["map"], expected()["scale"]
for key in ["x0_mm", "y0_mm", "mm_per_px"]:
    assert float(text[key]) == geometry[key], key
for key in ["min_mm", "max_mm"]:
    assert float(text[key]) == scale[key], key
assert round(image.info["dpi"][0] / 25.4 * geometry["mm_per_px"], 3) == 1, "the size of a pixel"

values = np.asarray(image).astype(np.float64)
truth = depth_mm()
np.testing.assert_array_equal(values == 0, np.isnan(truth))
step_mm = (float(text["max_mm"]) - float(text["min_mm"])) / 65534
z_mm = float(text["min_mm"]) + (values - 1) * step_mm
assert np.nanmax(np.abs(np.where(values == 0, np.nan, z_mm) - truth)) <= 0.5001 * step_mm
assert values[values > 0].min() == 1 and values.max() == 65535

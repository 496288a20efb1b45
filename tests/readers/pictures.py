"""texture.jpg and preview.png by Pillow."""

import numpy as np
from expected import FOLDER, texture_rgb
from PIL import Image

texture = Image.open(FOLDER / "texture.jpg")
assert texture.format == "JPEG" and texture.mode == "RGB"
difference = np.abs(np.asarray(texture).astype(int) - texture_rgb())
assert difference.shape == texture_rgb().shape
# A JPEG is exact nowhere and rings beside the hole's edges.
assert np.median(difference) <= 2 and np.percentile(difference, 99) <= 8, np.percentile(difference, [50, 99])

preview = Image.open(FOLDER / "preview.png")
preview.load()
assert preview.format == "PNG" and preview.mode == "RGB" and preview.width <= 2000
colours = np.unique(np.asarray(preview).reshape(-1, 3), axis=0)
assert len(colours) > 1000, "a picture of a relief has many colours"

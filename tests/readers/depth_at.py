"""The values of depth.tif at places of the world, by tifffile: answers JSON. depth_at.py DEPTH_TIF PLACES, a file with [[x_mm, y_mm], …]."""

import json
import sys
from pathlib import Path

import numpy as np
import tifffile

with tifffile.TiffFile(sys.argv[1]) as tiff:
    page = tiff.pages[0]
    depth_mm = page.asarray()
    matrix = page.tags[34264].value  # ModelTransformation: pixel (0, 0)'s centre, pixels to mm
places = np.array(json.loads(Path(sys.argv[2]).read_text()), float)
column = np.rint((places[:, 0] - matrix[3]) / matrix[0]).astype(int)
row = np.rint((places[:, 1] - matrix[7]) / matrix[5]).astype(int)
inside = (column >= 0) & (column < depth_mm.shape[1]) & (row >= 0) & (row < depth_mm.shape[0])
values = [float(depth_mm[r, c]) if ok else float("nan") for r, c, ok in zip(row, column, inside)]
print(json.dumps([None if np.isnan(value) else value for value in values]))

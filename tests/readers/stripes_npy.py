"""stripes.npy by NumPy."""

import numpy as np
from expected import FOLDER

stripes = np.load(FOLDER / "stripes.npy", allow_pickle=False)
assert stripes.shape == (9, 720) and stripes.dtype == np.float32
frame, row = np.mgrid[:9, :720]
truth = np.where(row % 11 == 0, np.nan, 600 + frame + row / 64).astype(np.float32)
np.testing.assert_array_equal(stripes, truth)

"""A cloud as E57 by pye57, which is libE57Format; its checksums are verified on reading."""

import numpy as np
import pye57
from expected import FOLDER, expected

points = np.array(expected()["points"], dtype=np.float64)
file = pye57.E57(str(FOLDER / "cloud.e57"))
assert file.scan_count == 1
header = file.get_header(0)
assert header.point_count == len(points), header.point_count
assert header["name"].value() == "known cloud"
data = file.read_scan_raw(0)
for axis, name in enumerate(["cartesianX", "cartesianY", "cartesianZ"]):
    np.testing.assert_allclose(data[name], points[:, axis] / 1000, rtol=0, atol=1e-12)
for name, column in [("colorRed", 3), ("colorGreen", 4), ("colorBlue", 5), ("columnIndex", 7)]:
    np.testing.assert_array_equal(data[name], points[:, column])
np.testing.assert_allclose(data["intensity"], points[:, 6], rtol=0, atol=1e-7)

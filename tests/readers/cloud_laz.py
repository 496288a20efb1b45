"""cloud.laz by laspy, decompressed by lazrs."""

import laspy
import numpy as np
from expected import FOLDER, expected

points = np.array(expected()["points"], dtype=np.float64)
with laspy.open(FOLDER / "cloud.laz") as reader:
    header = reader.header
    assert (header.version.major, header.version.minor) == (1, 4), header.version
    assert header.point_format.id == 7 and header.are_points_compressed
    assert header.point_count == len(points), header.point_count
    assert list(header.point_format.extra_dimension_names) == ["confidence", "frame"]
    np.testing.assert_allclose(header.mins, points[:, :3].min(axis=0) / 1000, rtol=0, atol=1.01e-5)
    np.testing.assert_allclose(header.maxs, points[:, :3].max(axis=0) / 1000, rtol=0, atol=1.01e-5)
    las = reader.read()
np.testing.assert_allclose(las.xyz, points[:, :3] / 1000, rtol=0, atol=0.501e-5)
for name, column in [("red", 3), ("green", 4), ("blue", 5)]:
    np.testing.assert_array_equal(np.asarray(las[name]) // 257, points[:, column])
np.testing.assert_allclose(np.asarray(las["confidence"]), points[:, 6], rtol=0, atol=1e-5)
np.testing.assert_allclose(np.asarray(las["intensity"]) / 65535, points[:, 6], rtol=0, atol=1e-5)
np.testing.assert_array_equal(np.asarray(las["frame"]), points[:, 7])
assert set(np.asarray(las["return_number"])) == {1} and set(np.asarray(las["number_of_returns"])) == {1}

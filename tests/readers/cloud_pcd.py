"""A cloud as PCD by Open3D, which reads it with a parser of its own; its further columns by Open3D's tensors."""

import numpy as np
import open3d
from expected import FOLDER, expected

points = np.array(expected()["points"], dtype=np.float64)
path = str(FOLDER / "cloud.pcd")
cloud = open3d.io.read_point_cloud(path)
np.testing.assert_allclose(np.asarray(cloud.points), points[:, :3] / 1000, rtol=1e-7, atol=1e-7)
np.testing.assert_allclose(np.asarray(cloud.colors) * 255, points[:, 3:6], rtol=0, atol=1e-4)
tensors = open3d.t.io.read_point_cloud(path)
np.testing.assert_allclose(tensors.point["confidence"].numpy().ravel(), points[:, 6], rtol=0, atol=1e-7)
np.testing.assert_array_equal(tensors.point["frame"].numpy().ravel(), points[:, 7])

"""The same cloud in four formats: wall.ply in mm, wall.laz, wall.pcd and wall.e57 in metres, with the same numbers."""

import sys
from pathlib import Path

import laspy
import numpy as np
import open3d
import pye57
from plyfile import PlyData

folder = Path(sys.argv[1])
ply = PlyData.read(folder / "wall.ply")["vertex"]
xyz = np.stack([ply["x"], ply["y"], ply["z"]], axis=1).astype(np.float64) / 1000
assert len(xyz) > 1000, len(xyz)

las = laspy.read(folder / "wall.laz")
np.testing.assert_allclose(las.xyz, xyz, rtol=0, atol=0.51e-5)
np.testing.assert_array_equal(np.asarray(las.red) // 257, ply["red"])
np.testing.assert_allclose(np.asarray(las["confidence"]), ply["confidence"], rtol=0, atol=1e-5)
np.testing.assert_array_equal(np.asarray(las["frame"]), ply["frame"])

pcd = open3d.t.io.read_point_cloud(str(folder / "wall.pcd"))
np.testing.assert_allclose(pcd.point["positions"].numpy(), xyz, rtol=1.3e-7, atol=1e-9)
np.testing.assert_allclose(pcd.point["colors"].numpy()[:, 1], ply["green"] / (1 if pcd.point["colors"].dtype == open3d.core.uint8 else 255), atol=1e-6)
np.testing.assert_array_equal(pcd.point["frame"].numpy().ravel(), ply["frame"])

e57 = pye57.E57(str(folder / "wall.e57")).read_scan_raw(0)
np.testing.assert_allclose(e57["cartesianX"], xyz[:, 0], rtol=0, atol=1e-9)
np.testing.assert_allclose(e57["cartesianZ"], xyz[:, 2], rtol=0, atol=1e-9)
np.testing.assert_array_equal(e57["colorBlue"], ply["blue"])
np.testing.assert_array_equal(e57["columnIndex"], ply["frame"])
print(len(xyz))

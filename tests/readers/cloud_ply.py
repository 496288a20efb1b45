"""cloud.ply by plyfile."""

import numpy as np
from expected import FOLDER, expected
from plyfile import PlyData

cloud = PlyData.read(FOLDER / "cloud.ply")
assert not cloud.text and cloud.byte_order == "<"
vertex = cloud["vertex"]
kinds = [(p.name, p.val_dtype) for p in vertex.properties]
assert kinds == [
    ("x", "f4"),
    ("y", "f4"),
    ("z", "f4"),
    ("red", "u1"),
    ("green", "u1"),
    ("blue", "u1"),
    ("confidence", "f4"),
    ("frame", "i4"),
], kinds
points = np.array(expected()["points"])
assert len(vertex) == len(points) > 3000
for column, (name, kind) in enumerate(kinds):
    np.testing.assert_array_equal(vertex[name], points[:, column].astype(kind), err_msg=name)

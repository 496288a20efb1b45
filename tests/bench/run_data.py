"""A run with its truth, and the products that were made of it, as arrays."""

import csv
import json
import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tifffile
from plyfile import PlyData

from geometry import rotation, triangulate


LARGEST_MAP_PX = 150_000_000
"""A larger depth map is not read: of the bench's runs of a few metres it can only be wrong."""


@dataclass
class Trajectory:
    """One row a frame; NaN = not determined."""

    frame: np.ndarray
    """[n] index of the frame."""
    position_mm: np.ndarray
    """[n, 3] the camera's place in the world."""
    angles_deg: np.ndarray
    """[n, 3] roll, pitch, yaw of world_from_camera."""
    shift_px: np.ndarray
    """[n, 2] dx, dy of the image since the previous frame."""

    @property
    def rotations(self) -> np.ndarray:
        """[n, 3, 3]; the identity where no angle is given."""
        return rotation(*np.nan_to_num(self.angles_deg).T)


def read_trajectory(path: Path) -> Trajectory:
    """Reads `trajectory.csv`, of the truth or of a product folder; empty fields become NaN."""
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))

    def columns(*names: str) -> np.ndarray:
        values = [[float(row[name]) if row[name] else np.nan for name in names] for row in rows]
        return np.array(values, float).reshape(len(rows), len(names))

    return Trajectory(
        frame=columns("frame")[:, 0].astype(int),
        position_mm=columns("x_mm", "y_mm", "z_mm"),
        angles_deg=columns("roll_deg", "pitch_deg", "yaw_deg"),
        shift_px=columns("dx_px", "dy_px"),
    )


@dataclass
class Run:
    """A run folder: its rig and its truth."""

    rig: dict
    stripes_px: np.ndarray
    """[frames, positions] true raw column (row, with a horizontal line) of the laser; NaN = not seen."""
    measurable: np.ndarray
    """[frames, positions] what a careful method can measure."""
    trajectory: Trajectory
    surface_z_mm: np.ndarray
    """[rows, columns] true z on the grid of `surface`."""
    surface: dict
    """x0_mm, y0_mm, step_mm and the features."""

    def measurable_points_mm(self) -> np.ndarray:
        """[frames, positions, 3] in the world: where the measurable stripe truly lies; NaN elsewhere."""
        seen = np.where(self.measurable, self.stripes_px, np.nan)
        points = triangulate(seen, self.rig)
        poses = self.trajectory
        return np.einsum("fij,fpj->fpi", poses.rotations, points) + poses.position_mm[:, None, :]


def read_run(folder: Path) -> Run:
    """Reads `rig.toml` and `truth/`."""
    truth = folder / "truth"
    return Run(
        rig=tomllib.loads((folder / "rig.toml").read_text()),
        stripes_px=np.load(truth / "stripes.npy"),
        measurable=np.load(truth / "measurable.npy"),
        trajectory=read_trajectory(truth / "trajectory.csv"),
        surface_z_mm=np.load(truth / "surface_z_mm.npy"),
        surface=json.loads((truth / "surface.json").read_text()),
    )


@dataclass
class DepthMap:
    """`depth.tif` with its place in the world."""

    z_mm: np.ndarray
    """[rows, columns] world z; NaN = not measured."""
    x_mm: np.ndarray
    """[columns] world x of the pixel centres."""
    y_mm: np.ndarray
    """[rows] world y of the pixel centres."""
    mm_per_px: float

    def cut(self, x_mm: tuple[float, float], y_mm: tuple[float, float]) -> "DepthMap":
        """The part between two x and two y (least, greatest)."""
        columns = slice(*np.searchsorted(self.x_mm, x_mm))
        rows = slice(*np.searchsorted(self.y_mm, y_mm))
        return DepthMap(self.z_mm[rows, columns], self.x_mm[columns], self.y_mm[rows], self.mm_per_px)


@dataclass
class Products:
    """A product folder; `None` where a product was not made."""

    trajectory: Trajectory | None
    stripes_px: np.ndarray | None
    """[frames, positions] measured stripes."""
    points_mm: np.ndarray | None
    """[n, 3] the cloud in the world."""
    point_frame: np.ndarray | None
    """[n] the frame that measured each point."""
    depth: DepthMap | None
    manifest: dict


def read_products(folder: Path) -> Products:
    """Reads what there is of a product folder."""
    manifest = json.loads(found.read_text()) if (found := folder / "manifest.json").exists() else {}
    points_mm = point_frame = None
    if (path := folder / "cloud.ply").exists():
        vertex = PlyData.read(path)["vertex"]
        points_mm = np.stack([np.asarray(vertex[axis], float) for axis in "xyz"], axis=1)
        point_frame = np.asarray(vertex["frame"])
    return Products(
        trajectory=read_trajectory(path) if (path := folder / "trajectory.csv").exists() else None,
        stripes_px=np.load(path) if (path := folder / "stripes.npy").exists() else None,
        points_mm=points_mm,
        point_frame=point_frame,
        depth=read_depth(folder / "depth.tif", manifest.get("depth_map")),
        manifest=manifest,
    )


def read_depth(path: Path, place: dict | None) -> DepthMap | None:
    """The depth map, placed by the manifest's `depth_map`; None where there is none, or a much too large one."""
    if not path.exists() or not place or place["width_px"] * place["height_px"] > LARGEST_MAP_PX:
        return None
    z_mm = tifffile.imread(path, key=0)
    step = place["mm_per_px"]
    x_mm = place["x0_mm"] + step * np.arange(z_mm.shape[1])
    y_mm = place["y0_mm"] + step * np.arange(z_mm.shape[0])
    return DepthMap(z_mm=z_mm, x_mm=x_mm, y_mm=y_mm, mm_per_px=step)

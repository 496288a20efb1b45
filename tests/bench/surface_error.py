"""The true surface as a function, and a cloud's distance from it after one rigid alignment."""

from dataclasses import dataclass

import numpy as np

from geometry import rotation_of_vector

DISCONTINUITY_MM = 0.2
"""A step of more than this from one node to the next is an edge of the step gauge."""
POINTS_FOR_ALIGNMENT = 60_000
"""The alignment looks at no more points than this, evenly picked; the statistics look at all."""
SETTLED_MM = 1e-4
"""The alignment is done when a step moves the cloud by less than this."""
WEAKEST_DIRECTION = 0.01
"""A direction in which the residuals change less than this share of the strongest one stays as it is: a flat
plate says nothing about x, y and the turn in its own plane."""


class TrueSurface:
    """z(x, y) of the truth: bilinear between the nodes of its grid."""

    def __init__(self, z_mm: np.ndarray, surface: dict):
        """`z_mm` [rows, columns] with the x0_mm, y0_mm, step_mm and features of `surface`."""
        self.x0_mm, self.y0_mm = float(surface["x0_mm"]), float(surface["y0_mm"])
        self.step_mm = float(surface["step_mm"])
        self.z_mm = np.asarray(z_mm, float)
        if any(feature["kind"] == "step" for feature in surface.get("features", [])):
            self.z_mm = np.where(beside_an_edge(self.z_mm), np.nan, self.z_mm)

    def extent_mm(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """(least x, greatest x), (least y, greatest y)."""
        rows, columns = self.z_mm.shape
        x, y = self.x0_mm, self.y0_mm
        return (x, x + self.step_mm * (columns - 1)), (y, y + self.step_mm * (rows - 1))

    def at(self, x_mm: np.ndarray, y_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """z in mm and its slopes dz/dx, dz/dy at places of any one shape; NaN off the surface."""
        rows, columns = self.z_mm.shape
        u, v = (np.asarray(x_mm) - self.x0_mm) / self.step_mm, (np.asarray(y_mm) - self.y0_mm) / self.step_mm
        inside = (u >= 0) & (u <= columns - 1) & (v >= 0) & (v <= rows - 1)
        u, v = np.where(inside, u, 0), np.where(inside, v, 0)
        i, j = np.minimum(u.astype(int), columns - 2), np.minimum(v.astype(int), rows - 2)
        s, t = u - i, v - j
        at = j * columns + i
        flat = self.z_mm.ravel()
        a, b, c, d = flat[at], flat[at + 1], flat[at + columns], flat[at + columns + 1]
        z = a * (1 - s) * (1 - t) + b * s * (1 - t) + c * (1 - s) * t + d * s * t
        dx = ((b - a) * (1 - t) + (d - c) * t) / self.step_mm
        dy = ((c - a) * (1 - s) + (d - b) * s) / self.step_mm
        return np.where(inside, z, np.nan), dx, dy


def beside_an_edge(z_mm: np.ndarray) -> np.ndarray:
    """Nodes [rows, columns] that differ from a neighbour by more than `DISCONTINUITY_MM`, and their neighbours: the
    foot of an edge may be a slope."""
    near = np.pad(z_mm, 1, mode="edge")
    edge = np.zeros(z_mm.shape, bool)
    for row, column in ((0, 1), (2, 1), (1, 0), (1, 2)):
        edge |= np.abs(near[row:, column:][: z_mm.shape[0], : z_mm.shape[1]] - z_mm) > DISCONTINUITY_MM
    wide = np.pad(edge, 1)
    return np.any([wide[r:, c:][: z_mm.shape[0], : z_mm.shape[1]] for r in range(3) for c in range(3)], axis=0)


@dataclass
class Alignment:
    """truth = rotation · products + translation_mm."""

    rotation: np.ndarray
    translation_mm: np.ndarray

    def apply(self, points_mm: np.ndarray) -> np.ndarray:
        """Points [n, 3] of the products' world in the truth's."""
        return points_mm @ self.rotation.T + self.translation_mm


def residuals(points_mm: np.ndarray, surface: TrueSurface) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For points [n, 3]: z − true z in mm [n] (NaN off the surface), the distance from the surface's tangent
    plane in mm [n] with the same sign, and the unit normals [n, 3]."""
    z, dx, dy = surface.at(points_mm[:, 0], points_mm[:, 1])
    normal = np.stack([-dx, -dy, np.ones_like(dx)], axis=1)
    length = np.linalg.norm(normal, axis=1)
    along_z = points_mm[:, 2] - z
    return along_z, along_z / length, normal / length[:, None]


def align(points_mm: np.ndarray, surface: TrueSurface, iterations: int = 40) -> Alignment:
    """The rigid motion (6 degrees of freedom) that brings points [n, 3] closest to the surface: Gauss-Newton
    on the point-to-plane distances, from the identity on."""
    picked = points_mm[:: -(-len(points_mm) // POINTS_FOR_ALIGNMENT) or 1]
    found = Alignment(np.eye(3), np.zeros(3))
    for _ in range(iterations):
        moved = found.apply(picked)
        _, distance, normal = residuals(moved, surface)
        use = np.isfinite(distance)
        if use.sum() < 6:
            break
        centre = moved[use].mean(axis=0)
        arm = moved[use] - centre
        reach = np.sqrt(np.mean(np.sum(arm**2, axis=1)))
        # Turns are counted in mm at the cloud's reach, so that all six unknowns have one unit.
        jacobian = np.hstack([normal[use], np.cross(arm, normal[use]) / reach])
        step, *_ = np.linalg.lstsq(jacobian.T @ jacobian, -jacobian.T @ distance[use], rcond=WEAKEST_DIRECTION**2)
        turn = rotation_of_vector(step[3:] / reach)
        shift = centre + step[:3] - turn @ centre
        found = Alignment(turn @ found.rotation, turn @ found.translation_mm + shift)
        if np.linalg.norm(step) < SETTLED_MM:
            break
    return found

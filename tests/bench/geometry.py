"""Rotations, lens and laser plane in NumPy; the conventions of the rig file and of trajectory.csv."""

import numpy as np


def rotation(roll_deg: np.ndarray, pitch_deg: np.ndarray, yaw_deg: np.ndarray) -> np.ndarray:
    """R = Ry(yaw)·Rx(pitch)·Rz(roll) as [n, 3, 3] from three arrays [n] in degrees."""
    roll, pitch, yaw = (np.radians(np.atleast_1d(a).astype(float)) for a in (roll_deg, pitch_deg, yaw_deg))
    zero, one = np.zeros_like(roll), np.ones_like(roll)

    def matrix(*rows: tuple) -> np.ndarray:
        return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)

    cz, sz, cx, sx, cy, sy = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch), np.cos(yaw), np.sin(yaw)
    about_z = matrix((cz, -sz, zero), (sz, cz, zero), (zero, zero, one))
    about_x = matrix((one, zero, zero), (zero, cx, -sx), (zero, sx, cx))
    about_y = matrix((cy, zero, sy), (zero, one, zero), (-sy, zero, cy))
    return about_y @ about_x @ about_z


def rotation_of_vector(vector_rad: np.ndarray) -> np.ndarray:
    """Rodrigues' formula: the rotation [3, 3] about `vector_rad` [3] by its length in radians."""
    angle = float(np.linalg.norm(vector_rad))
    if angle < 1e-15:
        return np.eye(3)
    x, y, z = np.asarray(vector_rad) / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def angle_deg(rotations: np.ndarray) -> np.ndarray:
    """Angle in degrees of each rotation of [n, 3, 3]; accurate for small ones."""
    skew = np.stack(
        [
            rotations[:, 2, 1] - rotations[:, 1, 2],
            rotations[:, 0, 2] - rotations[:, 2, 0],
            rotations[:, 1, 0] - rotations[:, 0, 1],
        ],
        axis=1,
    )
    cosine = (np.trace(rotations, axis1=1, axis2=2) - 1) / 2
    return np.degrees(np.arctan2(np.linalg.norm(skew, axis=1) / 2, cosine))


def undistort(u_px: np.ndarray, v_px: np.ndarray, camera: dict) -> tuple[np.ndarray, np.ndarray]:
    """Raw pixels to the ray's (x/z, y/z); OpenCV's model with 4, 5 or 8 coefficients, by iteration."""
    if "fx_px" in camera:
        fx, fy, cx, cy = (camera[key] for key in ("fx_px", "fy_px", "cx_px", "cy_px"))
    else:
        fx = fy = camera["width_px"] / (2 * np.tan(np.radians(camera["fov_deg"]) / 2))
        cx, cy = (camera["width_px"] - 1) / 2, (camera["height_px"] - 1) / 2
    k1, k2, p1, p2, k3, k4, k5, k6 = (list(camera.get("distortion", [])) + [0.0] * 8)[:8]
    x0, y0 = (u_px - cx) / fx, (v_px - cy) / fy
    if not any((k1, k2, p1, p2, k3, k4, k5, k6)):
        return x0, y0
    x, y = x0, y0
    for _ in range(40):
        r2 = x * x + y * y
        radial = (1 + r2 * (k4 + r2 * (k5 + r2 * k6))) / (1 + r2 * (k1 + r2 * (k2 + r2 * k3)))
        dx = 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        dy = p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        x, y = (x0 - dx) * radial, (y0 - dy) * radial
    return x, y


def laser_plane(laser: dict) -> tuple[np.ndarray, float]:
    """Normal [3] and offset in mm of the laser plane, from either form of the rig file."""
    if "plane_normal" in laser:
        normal = np.array(laser["plane_normal"], float)
        return normal, float(laser["plane_offset_mm"])
    # X − Z / tan(angle) = baseline, or Y in the place of X where the line lies along the rows.
    slope = 1 / np.tan(np.radians(laser["angle_deg"])) if laser["angle_deg"] != 90 else 0.0
    across = [1.0, 0.0] if laser.get("line", "vertical") == "vertical" else [0.0, 1.0]
    return np.array([*across, -slope]), float(laser["baseline_mm"])


def triangulate(stripes_px: np.ndarray, rig: dict) -> np.ndarray:
    """Stripes [frames, positions] in raw px to points in the camera's frame, [frames, positions, 3] in mm;
    NaN where there is no stripe."""
    along = np.broadcast_to(np.arange(stripes_px.shape[1], dtype=float), stripes_px.shape)
    across = stripes_px.astype(float)
    lying = rig["laser"].get("line", "vertical") == "horizontal"
    x, y = undistort(*((along, across) if lying else (across, along)), rig["camera"])
    normal, offset_mm = laser_plane(rig["laser"])
    z_mm = offset_mm / (normal[0] * x + normal[1] * y + normal[2])
    with np.errstate(invalid="ignore"):
        return np.stack([x * z_mm, y * z_mm, z_mm], axis=-1)

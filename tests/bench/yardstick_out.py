"""What the yardstick writes: strips side by side, the cloud, the trajectory."""

import json
from pathlib import Path

import cv2
import numpy as np

SCALE_WINDOW_S = 2.0
"""The carried scale's slow part is what a window of this length averages."""

POINT = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "u1", 3), ("confidence", "<f4"), ("frame", "<i4")]
)


def carried_scale(scale: np.ndarray, rate_hz: float) -> np.ndarray:
    """What each frame's depths are multiplied by [frames]: the running product of the scales [frames] (NaN = not
    determined) without its slow part."""
    logs = np.cumsum(np.log(np.where(np.isfinite(scale), scale, 1.0)))
    width = max(1, min(int(SCALE_WINDOW_S * rate_hz) | 1, len(logs)))
    ones = np.ones(width)
    count = np.convolve(np.ones(len(logs)), ones, "same")[: len(logs)]
    slow = np.convolve(logs, ones, "same")[: len(logs)] / count
    return np.exp(logs - slow)


def write_products(
    out: Path,
    rig: dict,
    rate_hz: float,
    stripes_px: np.ndarray,
    points_mm: np.ndarray,
    colours: np.ndarray,
    motion: np.ndarray,
    factor: np.ndarray,
) -> None:
    """Writes the folder: stripes [frames, rows], points in the camera [frames, rows, 3], colours [frames, rows, RGB],
    motion [frames, (dx, dy, scale)], depth factors [frames]."""
    out.mkdir(parents=True, exist_ok=True)
    shift = np.nan_to_num(motion[:, :2])
    travel_px = -np.cumsum(shift, axis=0)
    found = np.isfinite(points_mm[..., 2])
    distance_mm = float(np.median(points_mm[..., 2][found])) if found.any() else 0.0
    f_px = rig["camera"]["fx_px"]
    place_mm = travel_px * distance_mm / f_px
    corrected = points_mm * factor[:, None, None]
    write_depth(out / "depth.png", corrected[..., 2], travel_px)
    world = corrected.copy()
    world[..., :2] += place_mm[:, None, :]
    write_cloud(out / "cloud.ply", world, colours, found)
    write_trajectory(out / "trajectory.csv", rate_hz, motion, place_mm, found.sum(axis=1))
    np.save(out / "stripes.npy", stripes_px)
    facts = {"software": "yardstick", "frames": len(stripes_px), "median_distance_mm": distance_mm}
    (out / "manifest.json").write_text(json.dumps(facts))


def write_depth(path: Path, z_mm: np.ndarray, travel_px: np.ndarray) -> None:
    """The depth image: each frame's z [frames, rows] as a strip as wide as the image moved since the frame before,
    shifted by the shift across; 0 = not measured, 1 to 65535 = min to max."""
    edges = np.rint(travel_px[:, 0]).astype(int)
    down = np.rint(travel_px[:, 1]).astype(int)
    edges -= edges.min()
    down -= down.min()
    frames, rows = z_mm.shape
    image = np.full((rows + down.max() + 1, edges.max() + 1), np.nan, np.float32)
    for k in range(frames):
        last = edges[min(k + 1, frames - 1)]
        first, end = min(edges[k], last), max(edges[k], last)
        image[down[k] : down[k] + rows, first : end + 1] = z_mm[k][:, None]
    finite = np.isfinite(image)
    gray = np.zeros(image.shape, np.uint16)
    if finite.any():
        low, high = float(image[finite].min()), float(image[finite].max())
        gray[finite] = 1 + np.rint((image[finite] - low) * (65534 / max(high - low, 1e-6))).astype(np.uint16)
    cv2.imwrite(str(path), gray)


def write_cloud(path: Path, world_mm: np.ndarray, colours: np.ndarray, found: np.ndarray) -> None:
    """The cloud as binary PLY."""
    vertex = np.zeros(int(found.sum()), POINT)
    for axis, name in enumerate("xyz"):
        vertex[name] = world_mm[..., axis][found]
    vertex["rgb"], vertex["confidence"] = colours[found], 1.0
    vertex["frame"] = np.nonzero(found)[0]
    kinds = "float x,float y,float z,uchar red,uchar green,uchar blue,float confidence,int frame".split(",")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertex)}"]
    header += [f"property {kind}" for kind in kinds] + ["end_header", ""]
    with open(path, "wb") as file:
        file.write("\n".join(header).encode())
        vertex.tofile(file)


def write_trajectory(path: Path, rate_hz: float, motion: np.ndarray, place_mm: np.ndarray, rows: np.ndarray) -> None:
    """One line a frame; empty = not determined."""
    lines = ["frame,time_s,dx_px,dy_px,scale,x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw_deg,rows_found"]
    for k, (shift, place) in enumerate(zip(motion, place_mm, strict=True)):
        moved = ",".join("" if np.isnan(v) else f"{v:.5f}" for v in shift)
        lines.append(f"{k},{k / rate_hz:.6f},{moved},{place[0]:.4f},{place[1]:.4f},0,,,,{rows[k]}")
    path.write_text("\n".join(lines) + "\n")

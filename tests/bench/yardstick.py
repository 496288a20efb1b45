"""The publication in plain Python, OpenCV and NumPy: the yardstick that the bench holds Stria's speed against.

    yardstick.py VIDEO --rig RIG --out DIR

Area of the laser's colour, equations (7) to (9) per row, triangulation (5), Harris corners and Lucas-Kanade, median
of 3 and mean, the scale of (14), strips as wide as the image moved; out come depth.png (16 bit), cloud.ply,
trajectory.csv, stripes.npy and manifest.json, in the form that accuracy.py reads, and frames/s on standard output.

What it does to be fast, and all it does:
- decoding runs ahead in a thread of its own (OpenCV gives Python's lock back), and so does the tracking of one frame
  while the next one's stripe is found; OpenCV itself uses all cores;
- colour, dilation, erosion and gray values are computed in a band around the line of the frame before only, and in the
  whole image where there was none;
- equations (8) and (9) and the two crossings are array operations over all rows at once, the crossings in a window
  around each row's maximum;
- corners are looked for in the image at half size, and followed at full size;
- maps and cloud are put together once, at the end.
It leaves out what `paper` adds for safety: the choice between several spots in a row, and gaps between pieces.
"""

import argparse
import json
import queue
import sys
import threading
import time
import tomllib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np

from geometry import triangulate
from yardstick_out import carried_scale, write_products

HSV_LOW, HSV_HIGH = (50, 70, 60), (100, 255, 255)
"""Green, in OpenCV's 8-bit units."""
K = 0.9
CONTRAST_MIN = 8.0
"""Least height of a row's maximum above its average, gray values."""
BAND_MARGIN_PX = 70
"""The band reaches this far beyond the line of the frame before."""
WINDOW_PX = 40
"""Half the width of the window around a row's maximum in which the crossings are looked for."""
CORNERS, CORNER_QUALITY, CORNER_DISTANCE_PX = 100, 0.001, 12
CORNER_BAND_PX = 40
"""No corner is taken nearer to the line than this."""
FLOW = {"winSize": (21, 21), "maxLevel": 4, "criteria": (3, 30, 0.005)}
FRAMES_AHEAD = 4


def frames(path: Path) -> Iterator[np.ndarray]:
    """The video's images [rows, columns, BGR], decoded ahead in a thread."""
    ahead: queue.Queue = queue.Queue(FRAMES_AHEAD)

    def decode() -> None:
        video = cv2.VideoCapture(str(path))
        while (got := video.read())[0]:
            ahead.put(got[1])
        ahead.put(None)

    threading.Thread(target=decode, daemon=True).start()
    while (image := ahead.get()) is not None:
        yield image


class StripeFinder:
    """The laser line in one image after the other."""

    def __init__(self) -> None:
        self.band: tuple[int, int] | None = None
        self.dilate = cv2.getStructuringElement(cv2.MORPH_RECT, (30, 1))
        self.erode = cv2.getStructuringElement(cv2.MORPH_RECT, (20, 50))
        self.restore = cv2.getStructuringElement(cv2.MORPH_RECT, (1, 50))

    def find(self, image: np.ndarray) -> np.ndarray:
        """Column of the line's centre per row [rows], px; NaN = none."""
        first, end = self.band or (0, image.shape[1])
        part = image[:, first:end]
        area = cv2.inRange(cv2.cvtColor(part, cv2.COLOR_BGR2HSV), HSV_LOW, HSV_HIGH)
        area = cv2.erode(cv2.dilate(area, self.dilate), self.erode)
        area = cv2.dilate(area, self.restore)
        gray = cv2.transform(part, np.array([[0.114, 0.587, 0.299]], np.float32))  # (7)
        columns = midpoints(gray, area) + first
        seen = columns[np.isfinite(columns)]
        reach = BAND_MARGIN_PX
        self.band = (
            (max(0, int(seen.min()) - reach), min(image.shape[1], int(seen.max()) + reach)) if len(seen) else None
        )
        return columns


def midpoints(gray: np.ndarray, area: np.ndarray) -> np.ndarray:
    """Equations (8), (9) and the midpoint of PtA and PtB for every row [rows] of gray values [rows, columns] in the
    area (255, else 0)."""
    effective = cv2.bitwise_and(gray, gray, mask=area).astype(np.float32, copy=False)
    count = cv2.reduce(area, 1, cv2.REDUCE_SUM, dtype=cv2.CV_32F)[:, 0] / 255
    average = cv2.reduce(effective, 1, cv2.REDUCE_SUM, dtype=cv2.CV_32F)[:, 0] / np.maximum(count, 1)  # (8)
    peak = effective.argmax(axis=1)
    rows = np.arange(len(gray))
    contrast = effective[rows, peak] - average
    threshold = K * contrast + average  # (9)
    width = gray.shape[1]
    start = np.clip(peak - WINDOW_PX, 0, max(width - 2 * WINDOW_PX - 1, 0))
    places = start[:, None] + np.arange(min(2 * WINDOW_PX + 1, width))
    curve, inside = gray[rows[:, None], places], area[rows[:, None], places] > 0
    above = (curve >= threshold[:, None]) & inside
    left = above.argmax(axis=1)
    right = above.shape[1] - 1 - above[:, ::-1].argmax(axis=1)
    good = (count > 0) & (contrast >= CONTRAST_MIN) & (left > 0) & (right < above.shape[1] - 1)
    before, after = np.maximum(left - 1, 0), np.minimum(right + 1, above.shape[1] - 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        rise = (threshold - curve[rows, before]) / (curve[rows, left] - curve[rows, before])
        fall = (curve[rows, right] - threshold) / (curve[rows, right] - curve[rows, after])
        middle = start + (before + rise + right + fall) / 2
    return np.where(good, middle, np.nan)


class Tracker:
    """The image's shift and scale from frame to frame."""

    def __init__(self) -> None:
        self.previous: tuple[np.ndarray, np.ndarray | None] | None = None
        self.random = np.random.default_rng(1)

    def track(self, image: np.ndarray, stripe_px: np.ndarray) -> tuple[float, float, float]:
        """(dx px, dy px, scale) since the frame before; NaN where it is not determined."""
        gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        shift = (np.nan, np.nan, np.nan)
        if self.previous is not None and self.previous[1] is not None:
            before, corners = self.previous
            moved, status, _ = cv2.calcOpticalFlowPyrLK(before, gray, corners, None, **FLOW)
            good = status.ravel() == 1
            if good.sum() >= 6:
                shift = self.shift(corners.reshape(-1, 2)[good], moved.reshape(-1, 2)[good])
        self.previous = (gray, corners_outside(gray, stripe_px))
        return shift

    def shift(self, before: np.ndarray, after: np.ndarray) -> tuple[float, float, float]:
        """The same from corners [n, 2] px before and after: random order, median of 3, mean; (14) by OpenCV."""
        flow = (after - before)[self.random.permutation(len(before))]
        medians = np.median(np.lib.stride_tricks.sliding_window_view(flow, 3, axis=0), axis=2)
        dx, dy = medians.mean(axis=0)
        matrix, _ = cv2.estimateAffinePartial2D(before, after, ransacReprojThreshold=1.0)
        scale = np.nan if matrix is None else float(np.hypot(matrix[0, 0], matrix[1, 0]))
        return float(dx), float(dy), scale


def corners_outside(gray: np.ndarray, stripe_px: np.ndarray) -> np.ndarray | None:
    """Harris corners [n, 1, 2] px away from the line, found at half size."""
    half = cv2.resize(gray, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    mask = np.full(half.shape, 255, np.uint8)
    seen = stripe_px[np.isfinite(stripe_px)]
    if len(seen):
        mask[:, max(0, int(seen.min() - CORNER_BAND_PX) // 2) : int(seen.max() + CORNER_BAND_PX) // 2 + 1] = 0
    found = cv2.goodFeaturesToTrack(
        half, CORNERS, CORNER_QUALITY, CORNER_DISTANCE_PX / 2, mask=mask, useHarrisDetector=True, k=0.04
    )
    # Pixel centres at integers: half-size pixel i covers the full-size pixels 2i and 2i + 1.
    return None if found is None else found.reshape(-1, 1, 2) * 2 + 0.5


def beside(image: np.ndarray, stripe_px: np.ndarray) -> np.ndarray:
    """The wall's colour [rows, RGB] two corner bands beside the line's median."""
    middle = np.nanmedian(stripe_px) if np.isfinite(stripe_px).any() else 0
    column = int(np.clip(middle + 2 * CORNER_BAND_PX, 0, image.shape[1] - 1))
    return image[:, column, ::-1].copy()


def process(video: Path, rig: dict, out: Path) -> tuple[int, float]:
    """Measures a run and writes its products; frames and seconds."""
    begun = time.perf_counter()
    finder, tracker = StripeFinder(), Tracker()
    stripes, colours, shifts = [], [], []
    with ThreadPoolExecutor(1) as other:
        for image in frames(video):
            stripe_px = finder.find(image)
            stripes.append(stripe_px.astype(np.float32))
            colours.append(beside(image, stripe_px))
            shifts.append(other.submit(tracker.track, image, stripe_px))
            if len(shifts) > FRAMES_AHEAD:
                shifts[-FRAMES_AHEAD].result()
        motion = np.array([shift.result() for shift in shifts])
    if not stripes:
        sys.exit(f"{video}: no frame could be read; a video file that OpenCV decodes is expected")
    rate = cv2.VideoCapture(str(video)).get(cv2.CAP_PROP_FPS) or 30.0
    stripes_px = np.array(stripes)
    points_mm = triangulate(stripes_px, rig)  # (5) for a calibrated plane and lens
    write_products(out, rig, rate, stripes_px, points_mm, np.array(colours), motion, carried_scale(motion[:, 2], rate))
    return len(stripes), time.perf_counter() - begun


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("video", type=Path, help="a video with a green line along the image's columns")
    parser.add_argument("--rig", type=Path, required=True, help="rig file (TOML)")
    parser.add_argument("--out", type=Path, required=True, help="folder for the products; it is made")
    arguments = parser.parse_args()
    count, seconds = process(arguments.video, tomllib.loads(arguments.rig.read_text()), arguments.out)
    print(json.dumps({"frames": count, "seconds": seconds, "frames_per_s": count / seconds}))
    return 0


if __name__ == "__main__":
    sys.exit(main())

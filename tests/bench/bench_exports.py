"""What keeping and handing on costs: the archive's size, the exports of a long run's cloud and of a whole long job."""

import json
import shutil
from pathlib import Path

import numpy as np

from bench_long_job import export, long_job
from bench_runs import Bench, Scene, say
from bench_tables import Table, number

FORMATS = ("laz", "pcd", "e57", "ply")
FPS = 30


def long_cloud(short: Path, long: Path, frames: int) -> int:
    """Repeats a run's cloud along the travel until it has as many frames as a long one's; its points."""
    data = short.read_bytes()
    end = data.index(b"end_header\n") + len(b"end_header\n")
    dtype = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3), ("confidence", "<f4"), ("frame", "<i4")])
    points = np.frombuffer(data[end:], dtype)
    own_frames = int(points["frame"].max()) + 1
    way_mm = float(np.ptp(points["xyz"][:, 0])) * 1.01
    times = -(-frames // own_frames)
    total = times * len(points)
    lines = []
    for line in data[:end].decode().split("\n"):
        if line.startswith("element vertex"):
            line = f"element vertex {total}"
        lines.append(line)
    # A comment in the header keeps its length constant.
    head = "\n".join(lines)
    dots = next(line for line in lines if line.startswith("comment ..."))
    head = head.replace(dots, dots[: len(dots) - (len(head) - end)], 1)
    with open(long, "wb") as file:
        file.write(head.encode())
        for index in range(times):
            part = points.copy()
            part["xyz"][:, 0] += index * way_mm
            part["frame"] += index * own_frames
            part.tofile(file)
    return total


def exports(bench: Bench, scene: Scene, minutes: int) -> dict:
    """The archive of a run, and size, time and peak memory of each export of a cloud of so many minutes."""
    run = bench.run(scene)
    products = bench.process(run, bench.recipes[0], few=False)
    manifest = json.loads((products / "manifest.json").read_text())
    seconds = manifest["quality"]["duration_s"]
    archive = {
        "video_mb_a_minute": (run / "video.mp4").stat().st_size / 1e6 / seconds * 60,
        "archive_mb_a_minute": (products / "archive.mcap").stat().st_size / 1e6 / seconds * 60,
        "archive_s": manifest["timings_s"].get("archive", 0.0),
    }
    folder = bench.work / "long"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    points = long_cloud(products / "cloud.ply", folder / "cloud.ply", minutes * 60 * FPS)
    say(f"exporting {points:,} points")
    rows = [export(bench, folder, form, form) for form in FORMATS]
    shutil.rmtree(folder)
    return {"minutes": minutes, "points": points, "archive": archive, "rows": rows, "job": long_job(bench, minutes)}


def exports_table(result: dict) -> Table:
    """Exports of a long run's cloud."""
    points = result["points"]
    rows = [
        [
            row["format"],
            number(row["mb"], 0),
            number(row["seconds"], 1),
            number(points / row["seconds"] / 1e6, 1),
            number(row["peak_mb"], 0),
        ]
        for row in result["rows"]
    ]
    archive = result["archive"]
    note = (
        f"{points:,} points, as {result['minutes']} minutes at {FPS} frames/s have. The archive of the run takes "
        f"{number(archive['archive_mb_a_minute'], 0)} MB a minute, its video {number(archive['video_mb_a_minute'], 0)} MB."
    )
    header = ["format", "MB", "s", "million points/s", "peak memory, MB"]
    return Table("Exports of a long run's cloud", header, rows, note)

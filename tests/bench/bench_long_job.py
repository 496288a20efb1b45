"""What a whole job of half an hour costs to make, keep and hand on: through a server, every export that there is."""

import json
import shutil
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

from bench_runs import Bench, BenchError, call, say, tree_memory_bytes
from bench_tables import Table, number

FPS = 30
SIZE = "640x360"
"""Picture of the long job, px: its length is what the exports must bear, not the size of its frames."""
DRIVE_S = 60
"""The video is this drive again and again: the motion is lost where it begins anew, and the map grows on."""
POLL_S = 0.1

EXPORTS = (
    ("mcap", "mcap", ()),
    ("mcap, every 2nd frame", "mcap", ("--every", "2")),
    ("mcap without frames", "mcap", ("--without-frames",)),
    ("mcap, 10 m of the way", "mcap", ("--from-mm", "10000", "--to-mm", "20000")),
    ("ply", "ply", ()),
    ("laz", "laz", ()),
    ("pcd", "pcd", ()),
    ("e57", "e57", ()),
    ("mesh (glb)", "glb", ()),
    ("section across (csv)", "csv", ("--at-mm", "300")),
    ("section along (csv)", "csv", ("--line", "0,0,50000,0")),
    ("map (tiff)", "tiff", ()),
    ("recording (rrd)", "rrd", ()),
)

PEAK = """
import resource, subprocess, sys
code = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL).returncode
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e3)
sys.exit(code)
"""


def export(bench: Bench, source: str | Path, name: str, form: str, options: tuple = ()) -> dict:
    """Size in MB, wall time in s and peak memory in MB of one export."""
    out = bench.work / f"out.{form}"
    begun = time.perf_counter()
    command = [sys.executable, "-c", PEAK, bench.stria, "export", source, "--format", form, "--out", out, *options]
    report = call(command, f"export as {name}")
    seconds, size_mb = time.perf_counter() - begun, out.stat().st_size / 1e6
    out.unlink()
    return {"format": name, "seconds": seconds, "mb": size_mb, "peak_mb": float(report.strip().split("\n")[-1])}


def long_job(bench: Bench, minutes: int) -> dict:
    """A job of so many minutes through a server of its own, and the exports of what it made."""
    run = bench.work / f"drive-{DRIVE_S}s"
    if not (run / "truth" / "trajectory.csv").exists():
        say(f"simulating {DRIVE_S} s of {SIZE}")
        command = [bench.stria, "simulate", "wall", "--out", run, "--size", SIZE, "--fps", FPS, "--seconds", DRIVE_S]
        call(command, "simulating a drive")
    video = run / f"again-{minutes}min.mp4"
    if not video.exists():
        part = video.with_suffix(".part.mp4")
        loop = ["ffmpeg", "-v", "error", "-y", "-stream_loop", "-1", "-i", run / "video.mp4"]
        call([*loop, "-t", minutes * 60, "-c", "copy", part], "ffmpeg")
        part.rename(video)
    data = bench.work / "long-job"
    shutil.rmtree(data, ignore_errors=True)
    command = [bench.stria, "serve", "--listen", "127.0.0.1:0", "--data", data, "--workers", "1"]
    with open(bench.work / "serve.log", "w") as log:
        server = subprocess.Popen(
            [str(part) for part in [*command, "--without-authentication"]], stdout=subprocess.PIPE, stderr=log, text=True
        )
        try:
            return through(bench, server, video, run / "rig.toml", minutes)
        finally:
            server.terminate()
            server.wait()
            shutil.rmtree(data, ignore_errors=True)


def through(bench: Bench, server: subprocess.Popen, video: Path, rig: Path, minutes: int) -> dict:
    """Sends the video, waits for its job, and exports."""
    url = server.stdout.readline().split()[-1].rstrip("/")
    call([bench.stria, "send", video, "--server", url, "--asset", "Bench", "--rig", rig], "sending the long run")
    job = json_of(f"{url}/api/jobs")["items"][0]["id"]
    say(f"measuring {minutes} minutes of {SIZE}")
    job_bytes = 0
    while (state := json_of(f"{url}/api/jobs/{job}"))["state"] in ("queued", "running"):
        job_bytes = max(job_bytes, tree_memory_bytes(server.pid) - figure(server.pid, "VmRSS"))
        time.sleep(POLL_S)
    if state["state"] != "done":
        raise BenchError(f"the long job is {state['state']}: {state.get('error')}")
    manifest = json_of(f"{url}/api/jobs/{job}/products/manifest.json")
    say("exporting what the long job made")
    rows = [export(bench, job, *each[:2], (*each[2], "--server", url)) for each in EXPORTS]
    return {
        "minutes": minutes,
        "frames": manifest["quality"]["frames"],
        "points": manifest["quality"]["points"],
        "map_px": [manifest["depth_map"]["width_px"], manifest["depth_map"]["height_px"]],
        "video_mb": video.stat().st_size / 1e6,
        "job_peak_mb": job_bytes / 1e6,
        "server_peak_mb": figure(server.pid, "VmHWM") / 1e6,
        "rows": rows,
    }


def json_of(url: str) -> dict:
    """What the server answers."""
    with urllib.request.urlopen(url, timeout=60) as answer:
        return json.load(answer)


def figure(pid: int, name: str) -> int:
    """A figure of /proc/PID/status, bytes."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith(f"{name}:")), 0)


def long_job_table(job: dict) -> Table:
    """Exports of a whole long job."""
    rows = [[row["format"], number(row["mb"], 1), number(row["seconds"], 1), number(row["peak_mb"], 0)] for row in job["rows"]]
    width, height = job["map_px"]
    note = (
        f"{job['minutes']} minutes of {SIZE} at {FPS} frames/s ({number(job['video_mb'], 0)} MB): {job['frames']:,} frames, "
        f"{job['points']:,} points, a map of {width:,} x {height:,} px. Its own process took {number(job['job_peak_mb'], 0)} MB "
        f"of memory at most, the server that sent everything {number(job['server_peak_mb'], 0)} MB."
    )
    return Table("Exports of a whole long job", ["export", "MB", "s", "peak memory, MB"], rows, note)

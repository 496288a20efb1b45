"""A live run at 1280 x 720 px and 30 frames/s: what is lost, how late people see it, and what memory the server takes.

usage: live.py [MINUTES]     (1 when nothing is said; the robot walks to and fro over the same wall)

Latency: from sending a frame to the moment at which a recording segment that holds its profile can be fetched.
"""

import json
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from pathlib import Path

import numpy as np
from rerun.experimental import RrdReader

ROOT = Path(__file__).resolve().parents[2]
STRIA = ROOT / "target/release/stria"
SENDER = ROOT / "tests/live/sender.py"
FPS, SIZE, SECONDS = 30, "1280x720", 10
# The job's last products must be there so long after the last frame.
END_S = 600


def simulate(folder):
    """A wall as JPEG images: there and back, again and again, `minutes` long."""
    subprocess.run(
        [STRIA, "simulate", "wall", "--seconds", str(SECONDS), "--fps", str(FPS), "--size", SIZE, "--out", folder / "run"],
        check=True, stdout=subprocess.DEVNULL,
    )
    once = folder / "once"
    once.mkdir()
    subprocess.run(
        ["ffmpeg", "-loglevel", "error", "-i", folder / "run/video.mp4", "-q:v", "3", once / "%05d.jpg"], check=True
    )
    return sorted(once.glob("*.jpg")), folder / "run/rig.toml"


def repeat(images, frames, folder):
    folder.mkdir()
    there_and_back = images + images[-2:0:-1]
    for seq in range(frames):
        (folder / f"{seq:07d}.jpg").symlink_to(there_and_back[seq % len(there_and_back)])
    return folder


def json_of(url):
    with urllib.request.urlopen(url, timeout=30) as answer:
        return json.load(answer)


def memory_mb(pid, name):
    """A figure of /proc/PID/status."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith(name):
            return int(line.split()[1]) / 1024
    return 0.0


def listen(url, job, seen):
    """When each recording segment was announced."""
    with urllib.request.urlopen(f"{url}/api/jobs/{job}/events", timeout=3600) as events:
        event = None
        for line in events:
            line = line.decode().strip()
            if line.startswith("event:"):
                event = line[6:].strip()
            elif line.startswith("data:") and event == "segment":
                seen.append((json.loads(line[5:])["number"], time.time()))


def newest_profile(path):
    """The newest frame whose profile a segment holds; -1 where it holds none."""
    newest = -1
    for chunk in RrdReader(str(path)).stream():
        if str(chunk.entity_path).lstrip("/") not in ("world/newest", "world/surface") or chunk.is_static:
            continue
        batch = chunk.to_record_batch()
        newest = max(newest, int(np.max(batch.column("frame").to_numpy(zero_copy_only=False))))
    return newest


def main():
    minutes = float(sys.argv[1]) if len(sys.argv) > 1 else 1.0
    frames = int(minutes * 60 * FPS)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        images, rig = simulate(folder)
        walk = repeat(images, frames, folder / "walk")
        server = subprocess.Popen(
            [STRIA, "serve", "--listen", "127.0.0.1:0", "--data", folder / "data", "--workers", "1", "--without-authentication"],
            stdout=subprocess.PIPE, text=True,
        )
        try:
            measure(server, walk, rig, frames, folder)
        finally:
            server.terminate()
            server.wait()


def measure(server, walk, rig, frames, folder):
    url = server.stdout.readline().split()[-1].rstrip("/")
    sender = subprocess.Popen(
        [sys.executable, SENDER, url.replace("http", "ws", 1) + "/api/live/bench", "Bench", rig, walk, str(FPS)],
        stdout=subprocess.PIPE, text=True,
    )
    job = json.loads(sender.stdout.readline())["job"]
    seen, sent, closed = [], {}, {}
    threading.Thread(target=listen, args=(url, job, seen), daemon=True).start()
    server_mb = []
    for line in sender.stdout:
        said = json.loads(line)
        if "sent" in said:
            sent[said["sent"]] = said["at"]
            if said["sent"] % (10 * FPS) == 0:
                server_mb.append(memory_mb(server.pid, "VmRSS"))
        elif said.get("type") == "closed":
            closed = said
    deadline = time.monotonic() + END_S
    while (state := json_of(f"{url}/api/jobs/{job}"))["state"] in ("queued", "running"):
        if time.monotonic() > deadline:
            sys.exit(f"the job has not ended {END_S} s after the last frame: {state}")
        time.sleep(0.2)
    time.sleep(1)
    latencies, shown = [], -1
    for number, at in seen:
        path = folder / "segment.rrd"
        urllib.request.urlretrieve(f"{url}/api/jobs/{job}/recording/{number}", path)
        newest = newest_profile(path)
        latencies += [at - sent[seq] for seq in range(shown + 1, newest + 1) if seq in sent]
        shown = max(shown, newest)
    late = np.array(latencies)
    print(f"frames sent          {frames}, received {closed.get('frames')}, never received {closed.get('missing')}")
    print(f"frames processed     {state['frames']} ({state['state']}), profiles shown up to frame {shown}")
    print(f"latency to segment   median {np.median(late):.2f} s, 95 % under {np.quantile(late, 0.95):.2f} s")
    print(f"recording segments   {len(seen)}")
    print(f"server's memory      {server_mb[0]:.0f} MB at first, {server_mb[-1]:.0f} MB at last, "
          f"peak {memory_mb(server.pid, 'VmHWM'):.0f} MB")


main()

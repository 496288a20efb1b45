"""What the bench starts and watches: simulated runs, long videos, `stria process` and its memory."""

import json
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

FEW = "depth,cloud,trajectory"
"""The product groups of the speed comparison without the presentable products."""
DONE = (0, 3)
"""Exit codes of `stria process` for done, and done with warnings."""
POLL_S = 0.05
LOOP_FRAMES = 120
"""Frames of the run that the long videos go forth and back over."""


class BenchError(Exception):
    """What a person must mend before the bench can go on."""


@dataclass(frozen=True)
class Scene:
    """A simulated run of the bench; always full HD."""

    name: str
    seconds: int
    fps: int
    seed: int


SCENES = (
    Scene("wall", 8, 30, 11),
    Scene("pipe", 8, 60, 12),
    Scene("pipe-steady", 4, 60, 12),
    Scene("step-gauge", 3, 30, 13),
    Scene("stop", 8, 30, 14),
    Scene("lens", 3, 30, 15),
    Scene("distractor", 3, 30, 16),
    Scene("white", 2, 30, 17),
    Scene("black", 2, 30, 18),
    Scene("low-light", 2, 30, 19),
    Scene("no-laser", 2, 30, 20),
)


def say(text: str) -> None:
    """A line of progress."""
    print(f"[{time.strftime('%H:%M:%S')}] {text}", file=sys.stderr, flush=True)


def call(command: list, what: str, good: tuple = (0,)) -> str:
    """Runs a command to its end; its standard output."""
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True, check=False)
    if done.returncode not in good:
        end = "\n".join(done.stderr.strip().splitlines()[-5:])
        raise BenchError(f"{what} ended with code {done.returncode}:\n{' '.join(map(str, command))}\n{end}")
    return done.stdout


class Bench:
    """The binary under test and the folder that the bench works in."""

    def __init__(self, stria: Path, work: Path):
        if not stria.exists():
            raise BenchError(f"{stria} is missing: `make build` builds it, or name another one with --stria")
        if shutil.which("ffmpeg") is None:
            raise BenchError("ffmpeg is missing: `make setup` installs it (Debian package ffmpeg)")
        self.stria, self.work = stria, work
        work.mkdir(parents=True, exist_ok=True)
        self.version = call([stria, "--version"], "stria --version").strip()
        listed = call([stria, "process", "--help"], "stria process --help").split("Built-in recipes:")
        self.recipes = listed[1].split("(")[0].replace(",", " ").split() if len(listed) > 1 else []

    def run(self, scene: Scene) -> Path:
        """The folder of a simulated run, made when it is not there yet."""
        folder = self.work / f"{scene.name}-{scene.seconds}s-{scene.fps}fps-seed{scene.seed}"
        if not (folder / "truth" / "trajectory.csv").exists():
            say(f"simulating {scene.name}: {scene.seconds * scene.fps} frames of 1920x1080")
            command = [self.stria, "simulate", scene.name, "--out", folder, "--size", "1920x1080"]
            command += ["--seconds", scene.seconds, "--fps", scene.fps, "--seed", scene.seed]
            call(command, f"simulating {scene.name}")
        return folder

    def long_video(self, run: Path, seconds: int, straight: bool) -> Path:
        """A video of `seconds` at 30 frames/s made of a run: forth and back over its first frames, so that the
        picture never jumps; or `straight`, the same frames again and again, so that the map grows on."""
        kind = "straight" if straight else "forth-and-back"
        loop, long = self.work / f"{run.name}-{kind}.mp4", self.work / f"{run.name}-{kind}-{seconds}s.mp4"
        encode = ["-an", "-c:v", "libx264", "-preset", "fast", "-crf", "18", "-bf", "0", "-pix_fmt", "yuv420p"]
        cut = f"trim=end_frame={LOOP_FRAMES},setpts=PTS-STARTPTS"
        back = f"[0:v]{cut},split[a][b];[b]reverse[c];[a][c]concat=n=2[v]"
        if not long.exists():
            say(f"making {long.name}")
            ffmpeg = ["ffmpeg", "-v", "error", "-y"]
            graph = f"[0:v]{cut}[v]" if straight else back
            part = long.with_suffix(".part.mp4")
            if not loop.exists():
                source = ["-i", run / "video.mp4", "-filter_complex", graph, "-map", "[v]"]
                call([*ffmpeg, *source, *encode, part], "ffmpeg")
                part.rename(loop)
            call([*ffmpeg, "-stream_loop", "-1", "-i", loop, "-t", seconds, "-c", "copy", part], "ffmpeg")
            part.rename(long)
        return long

    def process_command(self, video: Path, rig: Path, method: str, out: Path, few: bool) -> list:
        """The command line of one processing."""
        command = [self.stria, "process", video, "--rig", rig, "--recipe", method, "--out", out]
        return command + (["--only", FEW] if few else [])

    def process(self, run: Path, method: str, few: bool, *more: str | Path, video: Path | None = None) -> Path:
        """Processes a run, or another video of its rig, with `more` on the command line; its product folder."""
        out = self.work / "products" / f"{run.name}-{method}{'-few' if few else ''}"
        shutil.rmtree(out, ignore_errors=True)
        command = [*self.process_command(video or run / "video.mp4", run / "rig.toml", method, out, few), *more]
        call(command, f"`{method}` on {run.name}", DONE)
        return out

    def peak_memory(self, video: Path, rig: Path, method: str) -> dict:
        """Processes a video into all products; frames, wall time in s and peak memory in MB."""
        out = self.work / "products" / f"memory-{method}"
        shutil.rmtree(out, ignore_errors=True)
        command = self.process_command(video, rig, method, out, few=False)
        begun = time.perf_counter()
        with open(self.work / "memory.log", "w+") as log:
            child = subprocess.Popen([str(part) for part in command], stdout=log, stderr=log)
            peak_bytes = 0
            try:
                while child.poll() is None:
                    peak_bytes = max(peak_bytes, tree_memory_bytes(child.pid))
                    time.sleep(POLL_S)
            finally:
                if child.poll() is None:
                    child.terminate()
                    child.wait()
            seconds = time.perf_counter() - begun
            log.seek(0)
            if child.returncode not in DONE:
                raise BenchError(f"`{method}` on {video.name} ended with {child.returncode}:\n{log.read()[-2000:]}")
        manifest = json.loads((out / "manifest.json").read_text())
        figures = {
            "frames": manifest["quality"]["frames"],
            "seconds": seconds,
            "peak_mb": peak_bytes / 1e6,
            "map_px": [manifest["depth_map"]["width_px"], manifest["depth_map"]["height_px"]],
        }
        shutil.rmtree(out)
        return figures


def tree_memory_bytes(pid: int) -> int:
    """Resident memory of a process and all its descendants."""
    total = 0
    try:
        for line in Path(f"/proc/{pid}/status").read_text().splitlines():
            if line.startswith("VmRSS:"):
                total += int(line.split()[1]) * 1024
        for task in Path(f"/proc/{pid}/task").iterdir():
            for child in (task / "children").read_text().split():
                total += tree_memory_bytes(int(child))
    except (FileNotFoundError, ProcessLookupError, PermissionError):
        pass  # It has ended in the meantime.
    return total

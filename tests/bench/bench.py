"""The bench: speed, memory and accuracy of this build on this machine, in one run.

    make bench                                              builds first, then runs everything
    bench.py --quick                                        shorter videos for the memory, 10 s and 60 s
    bench.py --skip memory --methods paper --scenes wall    a part of it

Simulates full HD runs with truth (kept in the work folder: the next run is quick), then prints as text and writes to
WORK/bench.md (tables ready for the README) and WORK/bench.json (every figure):
- speed: frames/s of bare decoding, of each method with few and with all products, and of the yardstick (the publication
  in plain Python and OpenCV), in interleaved rounds; the same of `metric` on a minute of video; and the time per stage;
- memory: peak for 1 and for 10 minutes of video;
- accuracy: both methods over all scenes against their truth;
- exports: the archive's size; time, size and memory of a full HD run's cloud of 30 minutes in each format, and of every
  export of a whole job of 30 minutes through a server.
"""

import argparse
import contextlib
import json
import os
import resource
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

try:
    import cv2
    import numpy as np

    from accuracy import evaluate
    from run_data import read_products, read_run
except ImportError as missing:
    sys.exit(f"{missing}: the bench needs tests/requirements.txt; `make setup` installs it into target/python")

from bench_exports import exports, exports_table
from bench_long_job import long_job_table
from bench_runs import SCENES, Bench, BenchError, Scene, call, say
from bench_tables import (
    JITTER_SCENES,
    Table,
    accuracy_tables,
    long_speed_table,
    memory_table,
    speed_table,
    stages_table,
)

ROOT = Path(__file__).resolve().parents[2]
SPEED_SCENES = ("pipe", "wall")
LONG_S = 60
MEMORY_SCENE = "wall"
BUSY_SHARE = 0.1
"""Other programs that take more of the processor than this are mentioned."""
PARTS = ("speed", "memory", "accuracy", "exports")


class Clock:
    """Times in s of what runs under a name, round by round; of the processor, what all cores together spent."""

    def __init__(self) -> None:
        self.all_s: dict[str, list[float]] = {}
        self.cpu_s: dict[str, list[float]] = {}

    @contextlib.contextmanager
    def times(self, name: str) -> Iterator[None]:
        begun, cpu_before_s = time.perf_counter(), children_cpu_s()
        yield
        self.all_s.setdefault(name, []).append(time.perf_counter() - begun)
        self.cpu_s.setdefault(name, []).append(children_cpu_s() - cpu_before_s)

    def said(self) -> dict:
        """Every wall time, and the medians of wall and processor times."""
        return {
            "all_s": self.all_s,
            "median_s": {name: statistics.median(times) for name, times in self.all_s.items()},
            "cpu_s": {name: statistics.median(times) for name, times in self.cpu_s.items()},
        }


def speed(bench: Bench, scenes: list[Scene], methods: list[str], rounds: int) -> dict:
    """Times in s of everything on each scene, round by round: name → {frames, all_s, median_s, cpu_s, timings_s}."""
    results = {}
    for scene in scenes:
        run, clock = bench.run(scene), Clock()
        timings_s: dict[str, dict] = {}
        for k in range(rounds):
            say(f"speed on {scene.name}, round {k + 1} of {rounds}")
            with clock.times("decoding"):
                decode(run / "video.mp4")
            for method in methods:
                for few, kind in ((True, "few"), (False, "all")):
                    with clock.times(f"{method}, {kind}"):
                        out = bench.process(run, method, few)
                    timings_s[method] = json.loads((out / "manifest.json").read_text())["timings_s"]
                    shutil.rmtree(out)
            clock.all_s.setdefault("yardstick", []).append(yardstick_s(bench, run))
        frames = len(np.load(run / "truth" / "stripes.npy", mmap_mode="r"))
        results[scene.name] = {"frames": frames, **clock.said(), "timings_s": timings_s}
    return results


def long_speed(bench: Bench, scenes: list[Scene], rounds: int) -> dict:
    """As speed(), on a minute of video of each scene, without what takes minutes for it."""
    results = {}
    for scene in scenes:
        run, clock = bench.run(scene), Clock()
        video = bench.long_video(run, LONG_S, straight=False)
        for k in range(rounds):
            say(f"speed on {LONG_S} s of {scene.name}, round {k + 1} of {rounds}")
            with clock.times("decoding"):
                decode(video)
            for few, kind in ((True, "few"), (False, "all")):
                with clock.times(f"metric, {kind}"):
                    out = bench.process(run, "metric", few, video=video)
                frames = json.loads((out / "manifest.json").read_text())["quality"]["frames"]
                shutil.rmtree(out)
        results[scene.name] = {"frames": frames, **clock.said()}
    return results


def decode(video: Path) -> None:
    """Decodes all of a video and keeps nothing."""
    call(["ffmpeg", "-v", "error", "-i", video, "-f", "null", "-"], "ffmpeg")


def children_cpu_s() -> float:
    """Processor time of all processes that this one has started and that have ended, s."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def yardstick_s(bench: Bench, run: Path) -> float:
    """Wall time of the yardstick, as it says itself: without the start of Python."""
    out = bench.work / "products" / f"{run.name}-yardstick"
    script = Path(__file__).with_name("yardstick.py")
    said = call([sys.executable, script, run / "video.mp4", "--rig", run / "rig.toml", "--out", out], "the yardstick")
    shutil.rmtree(out)
    return json.loads(said)["seconds"]


def memory(bench: Bench, scene: Scene, methods: list[str], lengths_s: list[int], straight: bool) -> list[dict]:
    """Peak memory of each method for videos of these lengths."""
    run = bench.run(scene)
    results = []
    for video_s in lengths_s:
        video = bench.long_video(run, video_s, straight)
        for method in methods:
            say(f"memory of `{method}` on {video_s} s of video")
            measured = bench.peak_memory(video, run / "rig.toml", method)
            results.append({"method": method, "video_s": video_s, **measured})
    return results


def accuracy(bench: Bench, scenes: list[Scene], methods: list[str]) -> list[dict]:
    """Every figure of every scene and method; a processing that fails is noted and passed by."""
    results = []
    for scene in scenes:
        run = bench.run(scene)
        truth = read_run(run)
        for method in methods:
            say(f"accuracy of `{method}` on {scene.name}")
            result: dict = {"scene": scene.name, "method": method}
            try:
                out = bench.process(run, method, True, "--set", "stripe.keep=true")
                result["figures"] = evaluate(truth, read_products(out))
                shutil.rmtree(out)
                # The publication's way has no place for a pose.
                if scene.name in JITTER_SCENES and method != "paper":
                    out = bench.process(run, method, True, "--poses", run / "truth" / "trajectory.csv")
                    result["figures"]["jitter_true_poses_mm"] = evaluate(truth, read_products(out))["jitter_mm"]
                    shutil.rmtree(out)
            except BenchError as error:
                say(str(error))
                result["error"] = str(error)
            results.append(result)
    return results


def machine(bench: Bench) -> dict:
    """What the figures belong to."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    models = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    pages, size = os.sysconf("SC_PHYS_PAGES"), os.sysconf("SC_PAGE_SIZE")
    cores = len(os.sched_getaffinity(0))
    ffmpeg = subprocess.run(["ffmpeg", "-version"], capture_output=True, text=True, check=True).stdout.split()[2]
    return {
        "processor": models[0] if models else "unknown",
        "cores": cores,
        "memory_gb": round(pages * size / 1e9, 1),
        "software": bench.version,
        "ffmpeg": ffmpeg,
        "opencv_of_the_yardstick": cv2.__version__,
    }


def busy_share(over_s: float = 2.0) -> float:
    """Share of all cores that other programs take, 0 to 1."""

    def ticks() -> tuple[int, int]:
        fields = [int(field) for field in Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:9]]
        return sum(fields), fields[3] + fields[4]  # all; idle and waiting for a disk

    before = ticks()
    time.sleep(over_s)
    every, idle = (after - earlier for after, earlier in zip(ticks(), before, strict=True))
    return 1 - idle / max(every, 1)


def report(work: Path, results: dict, straight: bool) -> list[Table]:
    """Writes bench.json and bench.md from what there is so far; the tables."""
    tables: list[Table] = []
    if results.get("speed"):
        tables.append(speed_table(results["speed"]))
        if results.get("long_speed"):
            tables.append(long_speed_table(results["long_speed"], LONG_S))
        tables.append(stages_table(results["speed"]))
    if results.get("memory"):
        tables.append(memory_table(results["memory"], straight))
    if results.get("exports"):
        tables += [exports_table(results["exports"]), long_job_table(results["exports"]["job"])]
    if results.get("accuracy"):
        tables += accuracy_tables(results["accuracy"])
    (work / "bench.json").write_text(json.dumps(results, indent=2))
    head = "Measured by `make bench`: {processor}, {cores} cores, {memory_gb} GB, {software}."
    head = head.format(**results["machine"])
    notes = "".join(f"\n{note}" for note in results["notes"])
    (work / "bench.md").write_text("\n".join([head + notes + "\n", *(table.markdown() for table in tables)]))
    return tables


def chosen(text: str, known: tuple, what: str) -> list[str]:
    """A comma-separated choice among `known`."""
    names = [name.strip() for name in text.split(",") if name.strip()]
    for name in names:
        if name not in known:
            raise BenchError(f"there is no {what} '{name}': expected some of {', '.join(known)}, separated by commas")
    return names


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = ",".join(scene.name for scene in SCENES)
    parser.add_argument("--stria", type=Path, default=ROOT / "target/release/stria", help="the binary to measure")
    parser.add_argument("--work", type=Path, default=ROOT / "target/bench", help="where runs and results are kept")
    parser.add_argument("--fresh", action="store_true", help="forget kept runs and long videos")
    parser.add_argument("--methods", default="paper,metric", help="recipes to measure (default: %(default)s)")
    parser.add_argument("--scenes", default=names, help="scenes of the accuracy table (default: %(default)s)")
    parser.add_argument("--skip", default="", metavar="PART,...", help=f"leave out some of {', '.join(PARTS)}")
    parser.add_argument("--rounds", type=int, default=3, help="rounds of the speed comparison (default: %(default)s)")
    parser.add_argument("--quick", action="store_true", help="memory for 10 s and 60 s instead of 1 and 10 min")
    parser.add_argument(
        "--straight", action="store_true", help="long videos repeat the drive forwards: jumps, and a map that grows on"
    )
    return parser.parse_args()


def main() -> None:
    """Runs the parts and prints their tables."""
    options = arguments()
    skip = chosen(options.skip, PARTS, "part")
    by_name = {scene.name: scene for scene in SCENES}
    scenes = [by_name[name] for name in chosen(options.scenes, tuple(by_name), "scene")]
    if options.fresh:
        shutil.rmtree(options.work, ignore_errors=True)
    bench = Bench(options.stria, options.work)
    wanted = [name.strip() for name in options.methods.split(",") if name.strip()]
    methods = [method for method in wanted if method in bench.recipes]
    notes = [f"Not measured: this build has no recipe `{method}`." for method in wanted if method not in methods]
    if not methods:
        raise BenchError(f"none of the recipes {', '.join(wanted)}: {bench.version} has {', '.join(bench.recipes)}")
    lengths_s = [10, 60] if options.quick else [60, 600]
    if options.quick and "memory" not in skip:
        notes.append("Quick run: memory for 10 s and 60 s of video instead of 1 and 10 minutes.")
    if (busy := busy_share()) > BUSY_SHARE:
        notes.append(f"Other programs took {100 * busy:.0f} % of the processor when the bench began.")
    results: dict = {"machine": machine(bench), "notes": notes}
    if "speed" not in skip:
        results["speed"] = speed(bench, [by_name[name] for name in SPEED_SCENES], methods, options.rounds)
        report(options.work, results, options.straight)
        if "metric" in methods:
            results["long_speed"] = long_speed(bench, [by_name[name] for name in SPEED_SCENES], options.rounds)
            report(options.work, results, options.straight)
    if "accuracy" not in skip:
        results["accuracy"] = accuracy(bench, scenes, methods)
        report(options.work, results, options.straight)
    if "memory" not in skip:
        results["memory"] = memory(bench, by_name[MEMORY_SCENE], methods, lengths_s, options.straight)
        report(options.work, results, options.straight)
    if "exports" not in skip:
        results["exports"] = exports(bench, by_name[MEMORY_SCENE], 3 if options.quick else 30)
    tables = report(options.work, results, options.straight)
    print("{processor}, {cores} cores, {memory_gb} GB, {software}, FFmpeg {ffmpeg}".format(**results["machine"]))
    print("\n".join(["", *notes, *(table.text() for table in tables)]))
    say(f"written: {options.work / 'bench.md'}, {options.work / 'bench.json'}")
    if any("error" in result for result in results.get("accuracy", [])):
        sys.exit(1)


if __name__ == "__main__":
    try:
        main()
    except BenchError as error:
        sys.exit(f"bench: {error}")
    except KeyboardInterrupt:
        sys.exit(130)

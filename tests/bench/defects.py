"""What the search for defects finds on simulated runs whose features are known, and what two runs show of a change.

    defects.py [--quick | --many] [--stria FILE] [--work FOLDER]

Simulates runs (other seeds than the tests'), processes them and judges `defects.json`, `change.json` and the pipe's section
against the truth. A feature counts where its whole disc could be measured: the share of the disc that the true measurable
line passed (`truth/measurable.npy`) is at least MEASURABLE, and the map does not end within it. Depth is the feature's own
height above the surface about it, area the whole disc out to its rim. Prints tables; the first ones feature by feature.
"""

import argparse
import json
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench_runs import Bench, BenchError, call, say
from bench_tables import Table, number
from coverage import CELL_MM, measurable_cells
from run_data import read_run

ROOT = Path(__file__).resolve().parents[2]
MEASURABLE = 0.9
NEAR_MM = 650.0
"""A surface nearer than this is held to the bar of 450 mm."""
BARS = {"near": (1.0, 10.0), "far": (3.0, 20.0)}
"""Least height and radius of a feature that must be found, mm."""
DONE = (0, 3)


@dataclass(frozen=True)
class Scene:
    """A simulated run: its name in the tables, and what `stria simulate` is told."""

    name: str
    scene: str
    options: str

    def folder(self) -> str:
        return f"{self.scene}-{self.options.replace('--', '').replace(' ', '-')}"


SCENES = (
    Scene("wall", "wall", "--seconds 8 --seed 101"),
    Scene("wall, another", "wall", "--seconds 8 --seed 83"),
    Scene("wall, gait", "wall", "--seconds 8 --seed 87 --motion gait"),
    Scene("wall, 1920x1080", "wall", "--seconds 5 --seed 13 --size 1920x1080"),
    Scene("wall, 640x360", "wall", "--seconds 8 --seed 81 --size 640x360"),
    Scene("pipe, gait", "pipe", "--seconds 6 --fps 60 --seed 107"),
    Scene("pipe, rail, 1920x1080", "pipe-steady", "--seconds 5 --seed 22 --fps 30 --size 1920x1080"),
    Scene("sound wall", "sound", "--seconds 6 --seed 109"),
    Scene("sound wall, gait", "sound", "--seconds 6 --seed 32 --motion gait"),
    Scene("oval pipe, gait", "pipe-oval", "--seconds 4 --fps 60 --seed 41"),
    Scene("oval pipe, rail", "pipe-oval", "--seconds 4 --motion steady --seed 42"),
)
MANY = (
    ("wall, 1280x720", tuple(Scene(f"wall {s}", "wall", f"--seconds 8 --seed {s}") for s in range(201, 207))),
    ("wall, 640x360", tuple(Scene(f"wall {s}", "wall", f"--seconds 8 --seed {s} --size 640x360") for s in range(301, 307))),
    ("wall, 1920x1080", tuple(Scene(f"wall {s}", "wall", f"--seconds 5 --seed {s} --size 1920x1080") for s in range(401, 405))),
    ("pipe, gait, 1280x720", tuple(Scene(f"pipe {s}", "pipe", f"--seconds 6 --fps 60 --seed {s}") for s in range(501, 505))),
    ("pipe, gait, 640x360", tuple(Scene(f"pipe {s}", "pipe", f"--seconds 6 --fps 60 --seed {s} --size 640x360") for s in (601, 602))),
    ("pipe, red laser; rail", (
        Scene("pipe, red laser", "pipe", "--laser red --seconds 5 --fps 60 --seed 912"),
        Scene("pipe, rail", "pipe-steady", "--seconds 5 --fps 60 --seed 911"),
    )),
    ("other walls and lasers", (
        Scene("stops and goes back", "wall", "--motion stop --seconds 8 --seed 902"),
        Scene("gait", "wall", "--motion gait --seconds 8 --seed 913"),
        Scene("gait, 640x360", "wall", "--motion gait --size 640x360 --seconds 8 --seed 901"),
        Scene("lens", "lens", "--seconds 6 --seed 903"),
        Scene("red, lying", "wall", "--laser red --line horizontal --seconds 6 --seed 906"),
        Scene("blue", "wall", "--laser blue --seconds 6 --seed 907"),
        Scene("white", "white", "--seconds 5 --seed 908"),
        Scene("black", "black", "--seconds 5 --seed 909"),
        Scene("low light", "low-light", "--seconds 5 --seed 910"),
    )),
    ("lamps and paint, 1280x720", tuple(
        Scene(f"lamps and paint {s}", "distractor", f"--seconds 6 --seed {s}") for s in (904, 905, *range(921, 925))
    )),
    ("lamps and paint, 640x360", tuple(
        Scene(f"lamps and paint {s}", "distractor", f"--seconds 6 --seed {s} --size 640x360")
        for s in (914, *range(925, 929), *range(931, 937))
    )),
)
"""More runs of a kind, judged together: what a dozen features cannot tell."""
QUICK = ("wall", "pipe, gait", "sound wall")
AGED = (
    Scene("first", "wall", "--seconds 4 --seed 61 --wall-seed 7"),
    Scene("again, gait", "wall", "--seconds 4 --seed 64 --wall-seed 7 --motion gait"),
    Scene("later", "wall", "--seconds 4 --seed 63 --wall-seed 7 --later"),
)


def made(bench: Bench, scene: Scene) -> tuple[Path, Path]:
    """The run's folder and that of its products, made when they are not there yet (the products always)."""
    run = bench.work / scene.folder()
    if not (run / "truth" / "surface.json").exists():
        say(f"simulating {scene.name}")
        shutil.rmtree(run, ignore_errors=True)
        call([bench.stria, "simulate", scene.scene, "--out", run, *scene.options.split()], f"simulating {scene.name}")
    out = bench.work / "products" / run.name
    shutil.rmtree(out, ignore_errors=True)
    say(f"processing {scene.name}")
    video, rig = run / "video.mp4", run / "rig.toml"
    call([bench.stria, "process", video, "--rig", rig, "--out", out, "--only", "depth,defects"], scene.name, DONE)
    return run, out


def read(path: Path) -> dict:
    return json.loads(path.read_text())


def measurable_share(feature: dict, cells: np.ndarray, origin_mm: tuple[float, float]) -> float:
    """The share of a feature's disc that a measurable line passed."""
    x = origin_mm[0] + CELL_MM * (np.arange(cells.shape[1]) + 0.5)
    y = origin_mm[1] + CELL_MM * (np.arange(cells.shape[0]) + 0.5)
    disc = (x[None, :] - feature["x"]) ** 2 + (y[:, None] - feature["y"]) ** 2 < feature["r"] ** 2
    whole = np.pi * feature["r"] ** 2 / CELL_MM**2
    return float(cells[disc].sum() / whole)


def judged(run: Path, out: Path) -> dict:
    """Every feature with what was found of it, and what was found besides."""
    listed, manifest = read(out / "defects.json"), read(out / "manifest.json")
    features = [f for f in read(run / "truth" / "surface.json")["features"] if f["kind"] == "bump"]
    cells, origin_mm = measurable_cells(read_run(run))
    place = manifest["depth_map"]
    x_from, x_to = place["x0_mm"], place["x0_mm"] + place["mm_per_px"] * place["width_px"]
    least = BARS["near" if manifest["resolution"]["distance_mm"] < NEAR_MM else "far"]
    used, rows = set(), []
    for feature in sorted(features, key=lambda f: -f["r"]):
        if not x_from + feature["r"] < feature["x"] < x_to - feature["r"]:
            continue
        share = measurable_share(feature, cells, origin_mm)
        near = [
            (np.hypot(d["x_mm"] - feature["x"], d["y_mm"] - feature["y"]), i)
            for i, d in enumerate(listed["defects"])
            if i not in used and d["depth_mm"] * feature["height"] > 0
        ]
        off_mm, best = min(near, default=(np.inf, -1))
        found = listed["defects"][best] if off_mm < max(0.6 * feature["r"], 6.0) else None
        if found:
            used.add(best)
        due = abs(feature["height"]) >= least[0] and feature["r"] >= least[1] and share >= MEASURABLE
        rows.append({"feature": feature, "share": share, "due": due, "found": found, "off_mm": off_mm})
    others = [d for i, d in enumerate(listed["defects"]) if i not in used]
    # Part of a feature that the map cuts, or that lies across a gap, is no false finding.
    false = [d for d in others if all(np.hypot(d["x_mm"] - f["x"], d["y_mm"] - f["y"]) > f["r"] + 10 for f in features)]
    return {"rows": rows, "false": false, "length_mm": x_to - x_from, "list": listed, "manifest": manifest}


def errors(row: dict) -> tuple[float, float, float, float]:
    """Depth in mm, the same in deviations as stated, area as a share, place in mm."""
    feature, found = row["feature"], row["found"]
    depth_mm = abs(found["depth_mm"]) - abs(feature["height"])
    area = found["area_mm2"] / (np.pi * feature["r"] ** 2) - 1.0
    return depth_mm, depth_mm / found["depth_sd_mm"], area, row["off_mm"]


def good(row: dict) -> tuple[bool, bool, bool]:
    """Depth within 10 % or 0.3 mm, area within 15 %, place within 5 mm."""
    depth_mm, _, area, off_mm = errors(row)
    return abs(depth_mm) <= max(0.3, 0.1 * abs(row["feature"]["height"])), abs(area) <= 0.15, off_mm <= 5.0


def feature_table(name: str, result: dict) -> Table:
    rows = []
    for row in sorted(result["rows"], key=lambda r: r["feature"]["x"]):
        if not row["due"]:
            continue
        feature = row["feature"]
        cells = [f"{feature['x']:.0f}, {feature['y']:.0f}", number(feature["height"], 2), number(feature["r"], 1)]
        if row["found"]:
            depth_mm, sds, area, off_mm = errors(row)
            fine = " ".join(word for word, ok in zip(("depth", "area", "place"), good(row), strict=True) if not ok)
            cells += [number(depth_mm, 2), number(sds, 1), f"{100 * area:+.0f}", number(off_mm, 1), fine]
        else:
            cells += ["–", "–", "–", "–", "missed"]
        rows.append(cells)
    header = ["x, y in mm", "height, mm", "radius, mm", "depth off, mm", "in deviations", "area off, %", "place off, mm", "beyond"]
    return Table(f"{name}: features that must be found", header, rows)


def summary_row(name: str, result: dict) -> list[str]:
    due = [row for row in result["rows"] if row["due"]]
    found = [row for row in due if row["found"]]
    held = [good(row) for row in found]
    depth = [abs(errors(row)[0]) for row in found]
    sds = [abs(errors(row)[1]) for row in found]

    def of(count: int, all_of: list) -> str:
        return f"{count} of {len(all_of)}" if all_of else "–"

    return [
        name,
        of(len(found), due),
        of(sum(h[0] for h in held), held),
        of(sum(h[1] for h in held), held),
        of(sum(h[2] for h in held), held),
        number(float(np.median(depth)), 2) if depth else "–",
        number(max(depth), 2) if depth else "–",
        of(sum(s <= 2 for s in sds), sds),
        f"{len(result['false'])} in {result['length_mm'] / 1000:.1f} m",
        number(result["list"]["detection_limit_mm"], 2),
        number(1000 * result["manifest"]["timings_s"].get("defects", 0.0) / result["manifest"]["quality"]["frames"], 2),
    ]


def many_row(name: str, results: list[dict]) -> list[str]:
    """What was found of all features of several runs."""
    due = [row for result in results for row in result["rows"] if row["due"]]
    found = [row for row in due if row["found"]]
    held = [good(row) for row in found]
    off = [errors(row)[0] for row in found]
    false = sum(len(result["false"]) for result in results)
    length_m = sum(result["length_mm"] for result in results) / 1000
    counts = [str(sum(h[i] for h in held)) for i in range(3)]
    return [name, str(len(due)), str(len(found)), *counts, number(float(np.std(off)), 2), f"{false} in {length_m:.1f} m"]


MANY_SUMMARY = ["runs", "features", "found", "depth within", "area within", "place within", "depth off, deviation, mm", "false"]
SUMMARY = [
    "run", "found", "depth", "area", "place", "depth off, median mm", "largest, mm", "within 2 deviations", "false",
    "limit at 20 mm, mm", "ms a frame",
]


def pipe_row(name: str, result: dict) -> list[str] | None:
    shape = result["list"]["reference"]
    if shape["kind"] != "cylinder":
        return None
    true = 1.0 if name.startswith("oval") else 0.0
    return [
        name,
        number(shape["radius_mm"], 2),
        number(shape["mean_radius_mm"], 2),
        number(shape["ovality_percent"] - true, 2),
        number(shape["ovality_sd_percent"], 2),
    ]


def changes(bench: Bench) -> Table:
    """What two runs along one wall, and a third one later, show of each other."""
    folders = {scene.name: made(bench, scene) for scene in AGED}
    heights = {n: {(f["x"], f["y"]): f["height"] for f in read(run / "truth/surface.json")["features"] if f["kind"] == "bump"}
               for n, (run, _) in folders.items()}
    rows = []
    for a, b in (("first", "again, gait"), ("first", "later"), ("again, gait", "later")):
        out = bench.work / "products" / f"{a} - {b}".replace(", ", "-").replace(" ", "")
        shutil.rmtree(out, ignore_errors=True)
        call([bench.stria, "compare", folders[a][1], folders[b][1], "--out", out], "compare")
        claimed = read(out / "change.json")["changes"]
        true = {at: h - heights[a].get(at, 0.0) for at, h in heights[b].items() if h != heights[a].get(at, 0.0)}
        met = 0
        for at, delta in true.items():
            near = [c for c in claimed if np.hypot(c["x_mm"] - at[0], c["y_mm"] - at[1]) < 15.0]
            met += len(near)
            found = near[0] if near else None
            said = [found["state"], number(found["delta_depth_mm"] - delta, 2), number(found["delta_sd_mm"], 2)] if found else ["missed", "–", "–"]
            rows.append([f"{a} → {b}", number(delta, 1), *said])
        rows.append([f"{a} → {b}", "0.0", f"{len(claimed) - met} false", "–", "–"])
    return Table("Change between runs", ["runs", "true change, mm", "claimed as", "off, mm", "deviation as stated, mm"], rows)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="three scenes, no change between runs")
    parser.add_argument("--many", action="store_true", help=f"{sum(len(scenes) for _, scenes in MANY)} more runs, judged together by kind and size, instead")
    parser.add_argument("--stria", type=Path, default=ROOT / "target/release/stria")
    parser.add_argument("--work", type=Path, default=ROOT / "target/bench/defects", help="where runs are kept for the next time")
    asked = parser.parse_args()
    try:
        bench = Bench(asked.stria, asked.work)
        if asked.many:
            rows = [many_row(name, [judged(*made(bench, scene)) for scene in scenes]) for name, scenes in MANY]
            print(Table("Defects over many runs", MANY_SUMMARY, rows).text())
            return 0
        results = {s.name: judged(*made(bench, s)) for s in SCENES if not asked.quick or s.name in QUICK}
        tables = [feature_table(name, result) for name, result in results.items() if any(r["due"] for r in result["rows"])]
        tables.append(Table("Defects", SUMMARY, [summary_row(name, result) for name, result in results.items()]))
        pipes = [row for name, result in results.items() if (row := pipe_row(name, result))]
        tables.append(Table("Pipe sections", ["run", "radius, mm", "mean radius, mm", "ovality off, %", "deviation as stated, %"], pipes,
                            "The pipes' mean radius is 300 mm; 'radius' is that of the crown that was seen."))
        if not asked.quick:
            tables.append(changes(bench))
    except BenchError as error:
        print(error, file=sys.stderr)
        return 1
    for table in tables:
        print(table.text())
    (asked.work / "defects.md").write_text("\n".join(table.markdown() for table in tables[-3:]))
    return 0


if __name__ == "__main__":
    sys.exit(main())

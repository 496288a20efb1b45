"""Accuracy of a product folder against the truth of its run.

    accuracy.py RUN_DIR PRODUCTS_DIR [--json]

RUN_DIR holds rig.toml and truth/ (as `stria simulate` writes them), PRODUCTS_DIR what `stria process` made of the
run's video. Stripe errors need `--set stripe.keep=true`. Prints what applies to the run: stripe, cloud, steps,
travel, poses, standstill, revisited places, coverage, jitter. Both worlds begin with the camera at frame 0, so they
are compared as they are; only the cloud and the poses go through one rigid alignment, found on the cloud.
"""

import argparse
import json
import sys
from pathlib import Path

import numpy as np

import measures
from coverage import coverage
from run_data import Products, Run, read_products, read_run
from step_gauge import step_heights
from surface_error import Alignment, TrueSurface, align

GROUPS = {
    "stripe": "stripe_",
    "cloud": "cloud_",
    "alignment": "align_",
    "steps (cloud)": "step_cloud",
    "steps (map)": "step_map",
    "travel": ("travel_", "path_"),
    "poses": ("position_", "rotation_", "frames_", "drift_"),
    "shift": ("dx_", "dy_"),
    "standstill": "still_",
    "revisited": "revisit_",
    "map": ("coverage_", "depth_", "jitter_", "map_"),
}


def evaluate(run: Run, products: Products) -> dict:
    """Every figure that applies, by name; units are the names' ends."""
    figures: dict = {}
    surface = TrueSurface(run.surface_z_mm, run.surface)
    alignment = Alignment(np.eye(3), np.zeros(3))
    if products.stripes_px is not None:
        figures |= measures.stripe_error(run, products.stripes_px)
    points_mm, frame = products.points_mm, products.point_frame
    if points_mm is not None and frame is not None:
        finite = np.isfinite(points_mm).all(axis=1)
        points_mm, frame = points_mm[finite], frame[finite]
        figures["cloud_points"] = len(points_mm)
    if points_mm is not None and frame is not None and len(points_mm) > 100:
        alignment = align(points_mm, surface)
        figures |= measures.cloud_error(points_mm, surface, alignment)
        figures |= step_heights(run, points_mm, "cloud")
        figures |= measures.revisit(run, points_mm, frame, surface, alignment)
    if products.trajectory is not None:
        figures |= measures.travel(run, products.trajectory)
        figures |= measures.pose_error(run, products.trajectory, alignment)
        figures |= measures.standstill(run, products.trajectory)
        figures |= measures.drift(run, products.trajectory, products.manifest.get("quality", {}).get("drift"))
    if place := products.manifest.get("depth_map"):
        figures |= {"map_width_mm": place["width_px"] * place["mm_per_px"]}
        figures |= {"map_height_mm": place["height_px"] * place["mm_per_px"]}
    if products.depth is not None:
        # A map that strays far beyond the surface would only cost memory.
        depth = products.depth.cut(*surface.extent_mm())
        figures |= coverage(run, depth)
        figures |= measures.jitter(depth, surface)
        row, column = np.nonzero(np.isfinite(depth.z_mm))
        on_map = np.column_stack([depth.x_mm[column], depth.y_mm[row], depth.z_mm[row, column]])
        figures |= step_heights(run, on_map, "map")
    return figures


def lines(figures: dict) -> list[str]:
    """The figures as text, one group a line."""

    def group_of(name: str) -> str:
        if name.startswith("step_"):
            return "steps (cloud)" if "_cloud_" in name else "steps (map)"
        return next((group for group, starts in GROUPS.items() if name.startswith(starts)), "other")

    def show(name: str, value: float | int | None) -> str:
        for group in ("stripe_", "cloud_", "align_", "still_", "revisit_"):
            name = name.removeprefix(group)
        for unit, sign in (("_percent", " %"), ("_px", " px"), ("_mm", " mm"), ("_deg", "°")):
            if name.endswith(unit):
                name, text = name.removesuffix(unit), "-" if value is None else f"{value:.3f}{sign}"
                return f"{name.replace('_', ' ')} {text}"
        return f"{name.replace('_', ' ')} {value}"

    grouped: dict[str, list[str]] = {group: [] for group in (*GROUPS, "other")}
    for name, value in figures.items():
        grouped[group_of(name)].append(show(name, value))
    return [f"{group:14} {' · '.join(texts)}" for group, texts in grouped.items() if texts]


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="run folder with rig.toml and truth/")
    parser.add_argument("products", type=Path, help="product folder")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of text")
    arguments = parser.parse_args()
    for path, needs in ((arguments.run / "truth", "truth/"), (arguments.products / "manifest.json", "manifest.json")):
        if not path.exists():
            print(f"{path} is missing: {path.parent} is no folder with {needs}", file=sys.stderr)
            return 2
    figures = evaluate(read_run(arguments.run), read_products(arguments.products))
    print(json.dumps(figures) if arguments.json else "\n".join(lines(figures)))
    return 0


if __name__ == "__main__":
    sys.exit(main())

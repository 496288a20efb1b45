"""The bench's results as tables: aligned text for the terminal, Markdown for the README."""

import statistics
from dataclasses import dataclass

STAGE_ORDER = ("decoding", "stripe", "triangulation", "motion", "surface", "maps", "recording", "archive", "products")


@dataclass
class Table:
    """A titled table of ready texts; the first column is left-aligned, the others right."""

    title: str
    header: list[str]
    rows: list[list[str]]
    note: str = ""

    def text(self) -> str:
        """For the terminal."""
        every = [self.header, *self.rows]
        widths = [max(len(row[i]) for row in every) for i in range(len(self.header))]
        lines = [
            "  ".join(cell.rjust(width) if i else cell.ljust(width) for i, (cell, width) in enumerate(zip(row, widths)))
            for row in every
        ]
        lines.insert(1, "-" * len(lines[0]))
        return "\n".join([self.title, "", *lines, *(["", self.note] if self.note else []), ""])

    def markdown(self) -> str:
        """For the README."""
        lines = ["| " + " | ".join(row) + " |" for row in [self.header, *self.rows]]
        lines.insert(1, "|---" + "|---:" * (len(self.header) - 1) + "|")
        return "\n".join([f"**{self.title}**", "", *lines, *(["", self.note] if self.note else []), ""])


def number(value: float | None, digits: int) -> str:
    """A figure, or a dash where it does not apply."""
    # Adding zero to the rounded value turns −0 into 0.
    return "–" if value is None else f"{round(value, digits) + 0.0:,.{digits}f}"


def ratio(all_s: dict, name: str, to: str) -> float:
    """How much faster one thing is than another: the median over the rounds, so that other load on the machine, which
    comes and goes, counts for both."""
    return statistics.median(other / own for own, other in zip(all_s[name], all_s[to], strict=True))


def long_speed_table(speed: dict, video_s: int) -> Table:
    """Frames/s on a minute of video, where start and end no longer count."""
    rows = []
    for scene, result in speed.items():
        for name, seconds in result["median_s"].items():
            cpu_ms = 1000 * result["cpu_s"][name] / result["frames"]
            share = ratio(result["all_s"], name, "decoding")
            rows.append([f"{scene}: {name}", number(result["frames"] / seconds, 1), number(cpu_ms, 2), number(share, 3)])
    header = ["what", "frames/s", "CPU, ms a frame", "of bare decoding"]
    note = f"Videos of {video_s} s, forth and back over 4 s of the drives above; as above otherwise."
    return Table("Speed over a minute", header, rows, note)


def speed_table(speed: dict) -> Table:
    """Frames/s and the ratios to bare decoding and to the yardstick."""
    rows = []
    for scene, result in speed.items():
        fps = {name: result["frames"] / seconds for name, seconds in result["median_s"].items()}
        for name, value in fps.items():
            times = result["frames"] / max(result["all_s"][name]), result["frames"] / min(result["all_s"][name])
            rows.append([
                f"{scene}: {name}",
                number(value, 1),
                f"{times[0]:.0f}–{times[1]:.0f}",
                number(None if name not in result["cpu_s"] else 1000 * result["cpu_s"][name] / result["frames"], 2),
                number(ratio(result["all_s"], name, "decoding"), 3),
                number(ratio(result["all_s"], name, "yardstick"), 2),
            ])
    frames = ", ".join(f"{result['frames']} frames of {scene}" for scene, result in speed.items())
    rounds = max(len(times) for result in speed.values() for times in result["all_s"].values())
    return Table(
        f"Speed at 1920 × 1080 ({frames})",
        ["what", "frames/s", "slowest–fastest", "CPU, ms a frame", "of bare decoding", "of the yardstick"],
        rows,
        f"Medians of {rounds} interleaved rounds, ratios taken within a round. Decoding: `ffmpeg -f null -`. "
        "Few: depth, cloud, trajectory; all: all products. Yardstick: the publication in vectorised Python and "
        "OpenCV, without the start of Python. CPU: of all cores together.",
    )


def stages_table(speed: dict) -> Table:
    """Time per stage and frame of each scene and method, all products."""
    columns = [(scene, method) for scene, result in speed.items() for method in result["timings_s"]]
    stages = {stage for scene, method in columns for stage in speed[scene]["timings_s"][method]}
    order = {stage: i for i, stage in enumerate(STAGE_ORDER)}
    rows = []
    for stage in sorted(stages, key=lambda s: (order.get(s, len(order)), s)):
        cells = []
        for scene, method in columns:
            seconds = speed[scene]["timings_s"][method].get(stage)
            cells.append(number(None if seconds is None else 1000 * seconds / speed[scene]["frames"], 2))
        rows.append([stage, *cells])
    note = "Stages run side by side: their sum may exceed the time that a frame takes."
    header = ["stage", *(f"{scene}: {method}" for scene, method in columns)]
    return Table("Time per stage, all products, ms a frame", header, rows, note)


def memory_table(memory: list[dict], straight: bool) -> Table:
    """Peak memory over video length."""
    rows = []
    for m in memory:
        rate = number(m["frames"] / m["seconds"], 1)
        rows.append([m["method"], f"{m['video_s']:,} s", f"{m['frames']:,}", number(m["peak_mb"], 0), rate])
    way = (
        "The video repeats one drive of 4 s: the picture jumps at each repetition and the map grows on."
        if straight
        else "The video goes forth and back over 4 s of a drive: the picture never jumps, the map stays small."
    )
    header = ["method", "video", "frames", "peak memory, MB", "frames/s"]
    note = f"All products; resident memory of the process and its children. {way}"
    return Table("Peak memory at 1920 × 1080, 30 frames/s", header, rows, note)


JITTER_SCENES = ("pipe", "pipe-steady")
"""The same pipe from a walking robot and from a rail."""
SURFACE_COLUMNS = (
    ("found, %", "stripe_found_percent", 1),
    ("false, %", "stripe_false_percent", 2),
    ("median, px", "stripe_median_px", 2),
    ("p95, px", "stripe_p95_px", 2),
    ("bias, px", "stripe_bias_px", 2),
    ("points", "cloud_points", 0),
    ("cloud RMSE, mm", "cloud_rmse_mm", 2),
    ("p95, mm", "cloud_p95_mm", 2),
    ("coverage, %", "coverage_percent", 1),
    ("travel, %", "travel_error_percent", 2),
)
POSE_COLUMNS = (
    ("position RMS, mm", "position_rms_mm", 2),
    ("rotation RMS, °", "rotation_rms_deg", 3),
    ("path, %", "path_error_percent", 2),
    ("drift stated, mm", "drift_x_mm", 2),
    ("end off, stated σ", "drift_sigmas", 1),
    ("dx bias, px", "dx_bias_px", 3),
    ("dx RMS, px", "dx_rms_px", 3),
    ("frames lost", "frames_without_shift", 0),
    ("map stripes, mm", "jitter_mm", 4),
)
STANDSTILL_COLUMNS = (
    ("x creep, mm", "still_spread_x_mm", 3),
    ("y, mm", "still_spread_y_mm", 3),
    ("z, mm", "still_spread_z_mm", 3),
    ("cells seen again", "revisit_cells", 0),
    ("median dz, mm", "revisit_median_mm", 3),
    ("p95, mm", "revisit_p95_mm", 3),
)


def figures_table(title: str, columns: tuple, results: list[dict], note: str = "") -> Table:
    """A row for every scene and method, a column for every figure of `columns` (head, key, digits)."""
    rows = [
        [result["scene"], result["method"], *(number(result["figures"].get(key), digits) for _, key, digits in columns)]
        for result in results
    ]
    return Table(title, ["scene", "method", *(head for head, *_ in columns)], rows, note)


def accuracy_tables(accuracy: list[dict]) -> list[Table]:
    """All tables of the accuracy over the simulated scenes."""
    good = [result for result in accuracy if "figures" in result]
    tables = [
        figures_table(
            "Stripe and surface over the simulated scenes",
            SURFACE_COLUMNS,
            good,
            "Found: of the measurable rows. False: rows with an answer where there is no line within 3 px, of all "
            "rows. Cloud: distance from the true surface after one rigid alignment. Coverage: of the measurable "
            "surface, on a grid of 2 mm. Travel: distance at the end of the run against the true one.",
        ),
        figures_table(
            "Poses and jitter over the simulated scenes",
            POSE_COLUMNS,
            good,
            "Drift stated: the standard deviation of the last place along the travel, as the manifest has it; end off: the "
            "last place against the truth, the worst of three directions. Map stripes: mean step from one column of the "
            "depth map to the next that the surface does not have.",
        ),
    ]
    tables += step_table(good)
    stops = [result for result in good if "still_spread_x_mm" in result["figures"]]
    if stops:
        tables.append(figures_table(
            "Standstill and places seen again",
            STANDSTILL_COLUMNS,
            stops,
            "Creep: the largest spread of the pose while the camera stands. dz: between passes, in cells of 2 mm.",
        ))
    tables += jitter_ratio(good)
    failed = [result for result in accuracy if "error" in result]
    if failed:
        rows = [[r["scene"], r["method"], r["error"].splitlines()[-1][:120]] for r in failed]
        tables.append(Table("Failed", ["scene", "method", "why"], rows))
    return tables


def step_table(good: list[dict]) -> list[Table]:
    """The step gauge's heights, from the cloud and from the map."""
    steps = {key for result in good for key in result["figures"] if key.startswith("step_")}
    heights = sorted({float(key.split("_")[1]) for key in steps})
    rows = []
    for result in good:
        for kind in ("cloud", "map"):
            errors = [result["figures"].get(f"step_{height:g}_{kind}_error_mm") for height in heights]
            if any(error is not None for error in errors):
                rows.append([result["method"], kind, *(number(error, 3) for error in errors)])
    header = ["method", "from the", *(f"{height:g} mm" for height in heights)]
    title = "Step gauge at 450 mm: error of each step's height, mm"
    return [Table(title, header, rows)] if rows else []


def jitter_ratio(good: list[dict]) -> list[Table]:
    """The gait's stripes in the map against the rail's."""
    figures = {(result["scene"], result["method"]): result["figures"] for result in good}
    rows = []
    for method in dict.fromkeys(result["method"] for result in good):
        for kind, key in ((method, "jitter_mm"), (f"{method}, true poses", "jitter_true_poses_mm")):
            gait, steady = (figures.get((scene, method), {}).get(key) for scene in JITTER_SCENES)
            if gait and steady:
                rows.append([kind, number(gait, 4), number(steady, 4), number(gait / steady, 2)])
    header = ["method", "gait, mm", "rail, mm", "ratio"]
    note = "True poses: the run's own stripes placed by the true trajectory, so that no error of the motion is in the map."
    title = "Stripes in the map of the pipe: a walking robot against a rail"
    return [Table(title, header, rows, note)] if rows else []

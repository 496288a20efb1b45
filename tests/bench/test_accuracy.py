"""The evaluation itself: known errors give known figures. Runs with plain Python; prints what it checked."""

import numpy as np

from coverage import coverage
from geometry import angle_deg, rotation, rotation_of_vector, triangulate, undistort
from measures import cloud_error, jitter, revisit, standstill, stripe_error, travel
from run_data import DepthMap, Run, Trajectory
from step_gauge import step_heights
from surface_error import Alignment, TrueSurface, align

RIG = {
    "camera": {"width_px": 640, "height_px": 360, "fx_px": 500.0, "fy_px": 500.0, "cx_px": 319.5, "cy_px": 179.5},
    "laser": {"plane_normal": [1.0, 0.0, 0.0], "plane_offset_mm": 100.0},
}
NOTHING = Alignment(np.eye(3), np.zeros(3))
X_MM, Y_MM = np.meshgrid(np.arange(0, 401.0), np.arange(-150, 151.0))
GRID = {"x0_mm": 0.0, "y0_mm": -150.0, "step_mm": 1.0, "features": []}
WAVES_MM = 500 + 8 * np.sin(X_MM / 30) * np.cos(Y_MM / 25) + 5 * np.sin(Y_MM / 40)


def trajectory(x_mm: np.ndarray) -> Trajectory:
    """A path along x without turns."""
    place = np.column_stack([x_mm, 0 * x_mm, 0 * x_mm])
    shift = np.column_stack([-np.diff(x_mm, prepend=x_mm[0]), 0 * x_mm])
    return Trajectory(np.arange(len(x_mm)), place, np.zeros((len(x_mm), 3)), shift)


def run(x_mm: np.ndarray, surface_z_mm: np.ndarray = WAVES_MM, **surface: object) -> Run:
    """A run whose line lies at 200 px off the middle in every row (a plane at 250 mm)."""
    stripes = np.full((len(x_mm), 360), 319.5 + 200.0)
    return Run(RIG, stripes, np.ones_like(stripes, bool), trajectory(x_mm), surface_z_mm, GRID | surface)


def cloud(count: int, seed: int) -> np.ndarray:
    """Points [n, 3] on the waves."""
    generator = np.random.default_rng(seed)
    x, y = generator.uniform(40, 360, count), generator.uniform(-110, 110, count)
    return np.column_stack([x, y, TrueSurface(WAVES_MM, GRID).at(x, y)[0]])


def test_geometry() -> None:
    turn = rotation(3.0, -2.0, 5.0)
    assert np.allclose(turn[0] @ turn[0].T, np.eye(3)) and abs(angle_deg(rotation(0, 0, 7.0))[0] - 7) < 1e-9
    assert np.allclose(rotation(10, 0, 0)[0], rotation_of_vector(np.radians([0, 0, 10])))
    point = triangulate(np.full((1, 1), 519.5), RIG)[0, 0]
    assert np.allclose(point, [100, -179.5 * 250 / 500, 250])
    camera = RIG["camera"] | {"distortion": [-0.28, 0.10, 0.001, -0.0005, 0.0]}
    x, y = 0.45, -0.3
    r2, (k1, k2, p1, p2, _) = x * x + y * y, camera["distortion"]
    radial = 1 + k1 * r2 + k2 * r2 * r2
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    assert np.allclose(undistort(np.array(u * 500 + 319.5), np.array(v * 500 + 179.5), camera), (x, y), atol=1e-9)


def test_alignment_finds_a_known_motion() -> None:
    points, turn = cloud(40_000, 1), rotation(0.4, -0.3, 0.5)[0]
    middle = points.mean(axis=0)
    moved = (points - middle) @ turn.T + middle + [1.5, -1.0, 2.0]
    found = align(moved, TrueSurface(WAVES_MM, GRID))
    assert np.abs(found.apply(moved) - points).max() < 0.02
    figures = cloud_error(moved, TrueSurface(WAVES_MM, GRID), found)
    assert figures["cloud_rmse_mm"] < 0.01 and abs(figures["align_turn_deg"] - angle_deg(turn[None])[0]) < 0.01


def test_noise_of_a_plane_is_its_rmse() -> None:
    generator = np.random.default_rng(2)
    plane = TrueSurface(np.full(X_MM.shape, 500.0), GRID)
    points = generator.uniform((10, -140, 0), (390, 140, 0), (50_000, 3))
    points[:, 2] = 500 + generator.normal(0, 0.3, 50_000)
    figures = cloud_error(points, plane, align(points, plane))
    assert abs(figures["cloud_rmse_mm"] - 0.3) < 0.005 and abs(figures["cloud_p95_mm"] - 0.588) < 0.01
    # A plane says nothing about x, y and the turn in itself: those stay.
    assert figures["align_shift_mm"] < 0.02


def test_stripes() -> None:
    true = run(np.arange(4.0))
    true.stripes_px[:, :90], true.measurable[:, :180] = np.nan, False
    found = true.stripes_px + 0.25
    found[:, 180:198] = np.nan
    found[0, 300:] += 10
    found[1, :9] = 77
    figures = stripe_error(true, found)
    assert abs(figures["stripe_found_percent"] - 90) < 1e-9 and figures["stripe_false_rows"] == 60 + 9
    assert figures["stripe_median_px"] == 0.25 and figures["stripe_bias_px"] == 0.25


def test_travel_standstill_and_revisit() -> None:
    way = np.concatenate([np.arange(0, 100, 2.0), np.full(20, 100.0), np.arange(100, 50, -2.0)])
    true, found = run(way), trajectory(way * 1.01)
    assert abs(travel(true, found)["travel_error_percent"] - 1) < 1e-9
    found.position_mm[60, 1] += 0.4
    assert abs(standstill(true, found)["still_spread_y_mm"] - 0.4) < 1e-9
    points = np.concatenate([cloud(20_000, 3), cloud(20_000, 4) + [0, 0, 0.5]])
    frame = np.repeat([10, 80], 20_000)
    surface = TrueSurface(WAVES_MM, GRID)
    figures = revisit(true, points, frame, surface, NOTHING)
    assert abs(figures["revisit_median_mm"] - 0.5) < 0.03
    assert revisit(run(np.arange(50.0)), points, frame, surface, NOTHING) == {}


def test_steps() -> None:
    feature = {"kind": "step", "height": 5.0, "y": 0.0, "half": 15.0, "x_period": 150.0, "x_on": 100.0}
    block = (np.abs(Y_MM) <= 15) & ((X_MM - 40) % 150 < 100)
    gauge = run(np.arange(3.0), np.where(block, 445.0, 450.0), features=[feature])
    # A measured plate that leans and is 0.1 mm too low on its blocks.
    points = np.column_stack([X_MM.ravel(), Y_MM.ravel(), np.where(block, 445.1, 450.0).ravel() + 0.01 * X_MM.ravel()])
    assert abs(step_heights(gauge, points, "cloud")["step_5_cloud_error_mm"] + 0.1) < 0.01


def test_map() -> None:
    true = run(np.arange(0, 200, 5.0))
    x, y = np.arange(90, 310.0), np.arange(-100, 101.0)
    depth = DepthMap(TrueSurface(WAVES_MM, GRID).at(*np.meshgrid(x, y))[0], x, y, 1.0)
    assert jitter(depth, TrueSurface(WAVES_MM, GRID))["jitter_mm"] < 1e-9
    depth.z_mm[:, ::2] += 0.2
    assert abs(jitter(depth, TrueSurface(WAVES_MM, GRID))["jitter_mm"] - 0.2) < 1e-9
    assert coverage(true, depth)["coverage_percent"] == 100
    # The measurable stretch reaches from x = 100 to 295 mm: half of it taken away.
    depth.z_mm[:, x > 197] = np.nan
    assert abs(coverage(true, depth)["coverage_percent"] - 50) < 1


if __name__ == "__main__":
    for name, test in list(globals().items()):
        if name.startswith("test_"):
            test()
            print(f"{name} holds")

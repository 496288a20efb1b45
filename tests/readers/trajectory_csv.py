"""trajectory.csv by Python's own csv."""

import csv

from expected import FOLDER

COLUMNS = (
    "frame,time_s,dx_px,dy_px,scale,x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw_deg,rows_found,tracked,residual_px"
)
with open(FOLDER / "trajectory.csv", newline="") as file:
    reader = csv.DictReader(file)
    rows = list(reader)
assert ",".join(reader.fieldnames) == COLUMNS, reader.fieldnames
first, second = rows
assert [name for name, value in first.items() if value == ""] == [
    "dx_px", "dy_px", "scale", "x_mm", "y_mm", "z_mm", "roll_deg", "pitch_deg", "yaw_deg", "residual_px",
]
assert first["rows_found"] == "720" and first["tracked"] == "0"
expected = [1, 1 / 30, -13.125, 0.5, 1.00025, 6.625, -0.25, 1.5, 0.5, -1.25, 2.0, 719, 97, 0.0625]
for (name, value), truth in zip(second.items(), expected, strict=True):
    assert abs(float(value) - truth) < 1e-4, (name, value)

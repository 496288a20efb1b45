"""Reads RRD files with rerun's own SDK and prints what is in them as one JSON object.

usage: rrd.py FILE... : each file is also checked by `rerun rrd verify`; the stores of all files are added up.
"""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
from rerun.experimental import RrdReader


def verify(files):
    rerun = Path(sys.executable).with_name("rerun")
    result = subprocess.run([rerun, "rrd", "verify", *files], capture_output=True, text=True)
    return {"ok": result.returncode == 0, "output": (result.stdout + result.stderr)[-2000:]}


def numbers(column):
    """The innermost numbers of a (nested) list column, or None where it holds something else."""
    values = column
    while pa.types.is_list(values.type) or pa.types.is_fixed_size_list(values.type):
        values = values.flatten()
    if not (pa.types.is_floating(values.type) or pa.types.is_integer(values.type)):
        return None
    return np.asarray(values.to_numpy(zero_copy_only=False), dtype=np.float64)


def times(column):
    values = column.cast(pa.int64()) if pa.types.is_duration(column.type) else column
    return np.asarray(values.to_numpy(zero_copy_only=False), dtype=np.int64)


def add_chunk(entities, chunk):
    path = str(chunk.entity_path).lstrip("/")
    entity = entities.setdefault(
        path, {"chunks": 0, "rows": 0, "static": 0, "components": {}, "frames": [None, None], "time_ns": [None, None]}
    )
    entity["chunks"] += 1
    entity["static" if chunk.is_static else "rows"] += chunk.num_rows
    batch = chunk.to_record_batch()
    for field, column in zip(batch.schema, batch.columns):
        kind = (field.metadata or {}).get(b"rerun:kind", b"").decode()
        if kind == "index":
            key = {"frame": "frames", "time": "time_ns"}.get(field.name)
            if key:
                t = times(column)
                low, high = entity[key]
                entity[key] = [
                    int(t.min()) if low is None else min(low, int(t.min())),
                    int(t.max()) if high is None else max(high, int(t.max())),
                ]
        elif kind == "data":
            component = entity["components"].setdefault(field.name, {"values": 0, "sum": 0.0, "min": None, "max": None})
            values = numbers(column)
            if values is None:
                component["text"] = str(column[0].as_py())[:4000]
                component["values"] += len(column)
                continue
            component["values"] += int(values.size)
            finite = values[np.isfinite(values)]
            if finite.size:
                component["sum"] += float(finite.sum())
                low, high = component["min"], component["max"]
                component["min"] = float(finite.min()) if low is None else min(low, float(finite.min()))
                component["max"] = float(finite.max()) if high is None else max(high, float(finite.max()))


def main(files):
    stores, entities, blueprints, bytes_ = set(), {}, {}, 0
    for file in files:
        bytes_ += Path(file).stat().st_size
        reader = RrdReader(file)
        for entry in reader.recordings():
            stores.add((entry.application_id, entry.recording_id))
            for chunk in reader.stream(store=entry):
                add_chunk(entities, chunk)
        for entry in reader.blueprints():
            for chunk in reader.stream(store=entry):
                add_chunk(blueprints, chunk)
    print(
        json.dumps(
            {
                "verify": verify(files),
                "stores": sorted(stores),
                "bytes": bytes_,
                "entities": entities,
                "blueprint": sorted(blueprints),
            }
        )
    )


main(sys.argv[1:])

"""An upload on loopback beside a plain copy of the same file to the same disk, in one run.

usage: upload.py [MB]     (1000 when nothing is said)

The copy is read and written as `cp` does it, then synced; the upload is one tus PATCH by curl, which the server syncs and
hashes. What counts is the ratio of the two, taken in turns, and that the server's memory does not grow with the file.
"""

import base64
import os
import statistics
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
STRIA = ROOT / "target/release/stria"
ROUNDS = 5
TUS = {"Tus-Resumable": "1.0.0"}


def metadata(**fields):
    return ",".join(f"{name} {base64.b64encode(value.encode()).decode()}" for name, value in fields.items())


def peak_mb(pid):
    status = Path(f"/proc/{pid}/status").read_text()
    return int(next(line for line in status.splitlines() if line.startswith("VmHWM")).split()[1]) / 1024


def copy_s(source, folder):
    begun = time.perf_counter()
    subprocess.run(["cp", "--reflink=never", source, folder / "copy"], check=True)
    descriptor = os.open(folder / "copy", os.O_RDONLY)
    os.fsync(descriptor)
    os.close(descriptor)
    spent = time.perf_counter() - begun
    (folder / "copy").unlink()
    return spent


def upload_s(url, source, rig):
    size = source.stat().st_size
    # One byte short: what is measured is the transfer; the last byte would begin a job.
    fields = metadata(filename="bench.mp4", asset="Bench", rig=rig)
    create = urllib.request.Request(
        f"{url}/api/uploads", method="POST", headers=TUS | {"Upload-Length": str(size + 1), "Upload-Metadata": fields}
    )
    with urllib.request.urlopen(create) as answer:
        place = url + answer.headers["Location"]
    begun = time.perf_counter()
    subprocess.run(
        ["curl", "--silent", "--show-error", "--fail", "-X", "PATCH", "-T", source, place, "-H", "Tus-Resumable: 1.0.0",
         "-H", "Upload-Offset: 0", "-H", "Content-Type: application/offset+octet-stream", "-H", "Expect:"],
        check=True,
    )
    spent = time.perf_counter() - begun
    urllib.request.urlopen(urllib.request.Request(place, method="DELETE", headers=TUS)).close()
    return spent


def main():
    size_mb = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    with tempfile.TemporaryDirectory(dir=ROOT / "target") as name:
        folder = Path(name)
        subprocess.run(
            [STRIA, "simulate", "wall", "--seconds", "0.2", "--size", "160x120", "--out", folder / "run"],
            check=True, stdout=subprocess.DEVNULL,
        )
        rig = (folder / "run/rig.toml").read_text()
        source = folder / "source"
        with source.open("wb") as file:
            for _ in range(size_mb):
                file.write(os.urandom(1_000_000))
        server = subprocess.Popen(
            [STRIA, "serve", "--listen", "127.0.0.1:0", "--data", folder / "data", "--workers", "0", "--without-authentication"],
            stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
        )
        try:
            url = server.stdout.readline().split()[-1].rstrip("/")
            before = peak_mb(server.pid)
            pairs = [(copy_s(source, folder), upload_s(url, source, rig)) for _ in range(ROUNDS)]
            after = peak_mb(server.pid)
        finally:
            server.terminate()
            server.wait()
    for copied, sent in pairs:
        print(f"copy {size_mb / copied:7.0f} MB/s   upload {size_mb / sent:7.0f} MB/s   ratio {copied / sent:.2f}")
    ratio = statistics.median(copied / sent for copied, sent in pairs)
    print(f"median ratio {ratio:.2f}; the server's memory {before:.0f} MB before, at most {after:.0f} MB in all")


main()

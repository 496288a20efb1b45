"""Stria's queue beside graphile_worker on the same PostgreSQL, in turns, in one run.

usage: bench_queue.py     (`make bench-queue` installs what it needs)

A job here does nothing: it is claimed and ended. What counts is the ratio of the two. Then Stria's lists, claims and counts
beside 10,000 and 1,000,000 jobs, on SQLite and PostgreSQL. A PostgreSQL of its own is started on a free port, with its usual
settings, and is gone afterwards.
"""

import json
import os
import pwd
import shutil
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
ROUNDS = 3
ROWS = [
    ("enqueued one by one, jobs/s", "enqueue_per_s", "enqueue_per_s"),
    ("claimed and ended, 4 at once, jobs/s", "jobs_per_s", "jobs_per_s"),
    ("from enqueue to start, idle worker of the server itself, median ms", "start_ms", "start_ms"),
    ("the same, p95 ms", "start_p95_ms", "start_p95_ms"),
    ("from enqueue to start, idle worker in another process, median ms", "start_apart_ms", "start_ms"),
    ("the same, p95 ms", "start_apart_p95_ms", "start_p95_ms"),
]


class Postgres:
    """Debian's PostgreSQL in a folder of its own."""

    def __init__(self):
        versions = sorted(Path("/usr/lib/postgresql").glob("*/bin"), key=lambda path: float(path.parent.name))
        if not versions:
            sys.exit("PostgreSQL is missing: `make setup` installs it")
        self.programs = versions[-1]
        self.folder = Path(tempfile.mkdtemp(prefix="stria-bench-"))
        self.user = {}
        if os.getuid() == 0:
            postgres = pwd.getpwnam("postgres")
            os.chown(self.folder, postgres.pw_uid, postgres.pw_gid)
            self.user = {"user": postgres.pw_uid, "group": postgres.pw_gid, "extra_groups": []}
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.run("initdb", "-D", self.folder / "data", "-U", "stria", "-A", "trust", "-E", "UTF8")
        self.process = subprocess.Popen(
            [self.programs / "postgres", "-D", self.folder / "data", "-p", str(self.port), "-k", self.folder,
             "-c", "listen_addresses=127.0.0.1"],
            cwd=self.folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, **self.user)
        for _ in range(200):
            if subprocess.run([self.programs / "pg_isready", "-h", "127.0.0.1", "-p", str(self.port)],
                              stdout=subprocess.DEVNULL).returncode == 0:
                return
            time.sleep(0.1)
        sys.exit("PostgreSQL does not answer")

    def run(self, program, *arguments):
        subprocess.run([self.programs / program, *arguments], cwd=self.folder, check=True,
                       stdout=subprocess.DEVNULL, **self.user)

    def database(self, name):
        self.run("createdb", "-h", "127.0.0.1", "-p", str(self.port), "-U", "stria", name)
        return f"postgres://stria@127.0.0.1:{self.port}/{name}"

    def stop(self):
        self.process.terminate()
        self.process.wait()
        shutil.rmtree(self.folder, ignore_errors=True)


def printed(command, variables, folder):
    done = subprocess.run(command, cwd=folder, env={**os.environ, **variables}, capture_output=True, text=True)
    if done.returncode != 0:
        sys.exit(f"{command[0]} failed:\n{done.stdout}\n{done.stderr}")
    return done.stdout


def figures(command, variables, folder):
    return json.loads(printed(command, variables, folder).split("FIGURES ", 1)[1].splitlines()[0])


def stria_bench(name, url):
    """Runs one of the benches inside the server's own tests."""
    return ["cargo", "test", "--release", "--locked", "--workspace", "--bin", "stria", "--", "--ignored", "--exact",
            "--nocapture", name], {"STRIA_BENCH_DATABASE": url}, ROOT


def main():
    if not (ROOT / "tests/bench/queue/node_modules").exists():
        sys.exit("graphile_worker is missing: `make bench-queue` installs it")
    postgres = Postgres()
    stria, other = [], []
    try:
        for number in range(ROUNDS):
            url = postgres.database(f"stria{number}")
            stria.append(figures(*stria_bench("queue::rate::rate", url)))
            url = postgres.database(f"other{number}")
            other.append(figures(["node", "queue.mjs"], {"DATABASE_URL": url}, ROOT / "tests/bench/queue"))
        scale = printed(*stria_bench("queue::scale::scale", postgres.database("scale")))
    finally:
        postgres.stop()
    print("| what | Stria | graphile_worker | ratio | slowest–fastest |\n|---|---:|---:|---:|---:|")
    for words, own, theirs in ROWS:
        ratios = [mine[own] / their[theirs] for mine, their in zip(stria, other)]
        middle = [statistics.median(round_[name] for round_ in rounds) for rounds, name in [(stria, own), (other, theirs)]]
        print(f"| {words} | {middle[0]:,.1f} | {middle[1]:,.1f} | {statistics.median(ratios):.2f} "
              f"| {min(ratios):.2f}–{max(ratios):.2f} |")
    print(f"\nMedians of {ROUNDS} rounds taken in turns, ratios taken within a round.\n")
    print("\n".join(line for line in scale.splitlines() if line.startswith("|")))


if __name__ == "__main__":
    main()

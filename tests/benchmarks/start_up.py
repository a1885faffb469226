"""How long pcfix takes to start: a process's CPU time, user and system, least of several.

Imports, help, and a correction of the sample scene of 20,000 points: once kernels are kept, and
with ``--cold`` the first time, in an empty folder for them, which takes a minute.

    python -m tests.benchmarks.start_up [--runs 5] [--cold]
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

SCENE = Path(__file__).parents[2] / "samples" / "scene"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=5, help="of each, of which the least counts")
    parser.add_argument("--cold", action="store_true", help="the first correction too")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        correct = [
            "-m", "pcfix", "correct", SCENE / "cloud.laz", Path(folder, "out.laz"),
            "--cameras", SCENE / "cameras.csv", "--water", "0.37", "--overwrite", "--quiet",
        ]  # fmt: skip
        if arguments.cold:
            show("first correction", took(correct, NUMBA_CACHE_DIR=str(Path(folder, "kernels"))))
        for title, words in (
            ("python -c pass", ["-c", "pass"]),
            ("import pcfix", ["-c", "import pcfix"]),
            ("import pcfix.flow.correct", ["-c", "import pcfix.flow.correct"]),
            ("pcfix --help", ["-m", "pcfix", "--help"]),
            ("correction, snell", [*correct, "--method", "snell"]),
            ("correction", correct),
        ):
            took(words)  # kernels and bytecode are kept by now
            show(title, *(took(words) for _ in range(arguments.runs)))


def took(words, **variables):
    """Return CPU and wall time of a process, seconds."""
    leave = ("PYTHONDONTWRITEBYTECODE",)
    own = {name: value for name, value in os.environ.items() if name not in leave}
    before, started = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    command = [sys.executable, *map(str, words)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env=own | variables)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return cpu, time.perf_counter() - started


def show(title, *times):
    cpu, wall = map(min, zip(*times, strict=True))
    print(f"{title:<28}{cpu:8.2f} s CPU{wall:8.2f} s", flush=True)


if __name__ == "__main__":
    main()

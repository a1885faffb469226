"""Tiles on a Dask cluster of this machine."""

import json
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import pytest

import pcfix
from tests.utils.program import run_pcfix
from tests.utils.tiles import SCENE, cut, finished, records

CAMERAS = SCENE / "cameras.csv"
GIVEN = {"cameras": CAMERAS, "water": 0.37, "method": "snell"}


def started(folder, program, *words):
    """Start a program of dask that ends with the tests."""
    with (folder / f"{program}.log").open("a") as log:
        return subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.dask_{program}", "--no-dashboard", *words],
            stdout=log, stderr=log, cwd=folder,
        )  # fmt: skip


def worker(folder, *words):
    return started(
        folder, "worker", "--scheduler-file", "scheduler.json", "--no-nanny", "--nthreads=1", *words
    )


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory):
    """Return the folder and the address of a scheduler without workers."""
    pytest.importorskip("distributed")
    folder = tmp_path_factory.mktemp("cluster")
    process = started(folder, "scheduler", "--port=0", "--scheduler-file", "scheduler.json")
    file, until = folder / "scheduler.json", time.monotonic() + 60
    while not file.exists() and time.monotonic() < until:
        time.sleep(0.1)
    time.sleep(0.2)
    yield folder, json.loads(file.read_text())["address"]
    process.kill()
    process.wait()


@pytest.fixture(scope="module")
def cloud(tmp_path_factory):
    return cut(tmp_path_factory.mktemp("cloud") / "tiles", 12)


def test_refused(scheduler, cloud, tmp_path, monkeypatch):
    monkeypatch.setattr("pcfix.flow.runner.WAIT_S", 1)
    folder, address = scheduler
    words = ("label", cloud[0], tmp_path / "out", "--water", "0.37", "--scheduler")
    with socket.socket() as deaf:
        deaf.bind(("127.0.0.1", 0))
        silent = run_pcfix(*words, f"tcp://127.0.0.1:{deaf.getsockname()[1]}")
    assert silent.code == "cluster.no_answer"
    assert run_pcfix(*words, "x://host").code == "cluster.no_answer"
    assert run_pcfix(*words, address).code == "cluster.no_workers"
    monkeypatch.undo()
    (folder / "older.py").write_text("import pcfix.version\npcfix.version.__version__ = '0.0.1'\n")
    older = worker(folder, "--preload", "older.py")
    try:
        done = run_pcfix(*words, address)
        assert done.code == "tiles.failed"
        assert "this worker has pcfix 0.0.1" in done.error.values["failed"][0]
    finally:
        older.kill()
        older.wait()
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert run_pcfix(*words, address).code == "library.missing"
    assert not list((tmp_path / "out").glob("*.laz"))


@pytest.fixture
def workers(scheduler):
    found = [worker(scheduler[0]) for _ in range(2)]
    time.sleep(5)  # both are to share the work
    yield found
    for one in found:
        one.kill()
        one.wait()


def test_killed_worker(scheduler, workers, cloud, tmp_path):
    before = {}

    def kill_one(done, total):
        if done >= total // 3 and not before:
            workers[0].send_signal(signal.SIGKILL)
            before.update(finished(tmp_path / "out"))

    many = pcfix.correct_file(
        cloud[0], tmp_path / "out", scheduler=scheduler[1], progress=kill_one, **GIVEN
    )
    assert workers[0].wait() == -signal.SIGKILL
    assert len(before) >= 4
    assert before.items() <= finished(tmp_path / "out").items()
    one = pcfix.correct_file(cloud[1], tmp_path / "merged.las", **GIVEN)
    outputs = sorted((tmp_path / "out").glob("tile*.laz"))
    assert np.array_equal(records(*outputs), records(tmp_path / "merged.las"))
    assert (many.points, many.rays, many.shift_z_m) == (one.points, one.rays, one.shift_z_m)
    assert not list((tmp_path / "out").glob(".*.part*"))


@pytest.mark.usefixtures("workers")
def test_other_commands(scheduler, cloud, tmp_path, monkeypatch):
    merged = tmp_path / "merged"
    merged.mkdir()
    pcfix.label_file(cloud[1], merged / "labelled.las", water=0.37)
    pcfix.clean_file(cloud[1], merged / "clean.las")
    pcfix.run(cloud[1], merged / "run", **GIVEN)
    monkeypatch.setattr("pcfix.flow.runner.in_processes", None)  # nothing is done on this machine
    given = {"scheduler": scheduler[1]}
    pcfix.label_file(cloud[0], tmp_path / "labelled", water=0.37, **given)
    pcfix.clean_file(cloud[0], tmp_path / "clean", **given)
    pcfix.run(cloud[0], tmp_path / "run", **given, **GIVEN)
    for name in ("labelled", "clean", "run/corrected", "run/cleaned"):
        found = tmp_path / name
        one = merged / found.relative_to(tmp_path)
        suffix = ".laz" if "run" in one.parts else ".las"
        tiles = sorted(found.glob("tile*.laz"))
        assert np.array_equal(records(*tiles), records(one.with_suffix(suffix))), found.name

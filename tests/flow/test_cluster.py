"""Tiles on a Dask cluster, and from an object store, both on this machine."""

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


def test_a_cluster_that_cannot_work_is_refused(scheduler, cloud, tmp_path, monkeypatch):
    monkeypatch.setattr("pcfix.flow.cluster.WAIT_S", 1)
    folder, address = scheduler
    words = ("label", cloud[0], tmp_path / "out", "--water", "0.37", "--scheduler")
    with socket.socket() as deaf:
        deaf.bind(("127.0.0.1", 0))
        silent = run_pcfix(*words, f"tcp://127.0.0.1:{deaf.getsockname()[1]}")
    assert silent.returncode == 1
    assert "does not answer within 1 s" in silent.stderr
    assert "unknown address scheme 'x'" in run_pcfix(*words, "x://host").stderr
    assert "has no workers; start some with 'dask worker" in run_pcfix(*words, address).stderr
    monkeypatch.undo()
    (folder / "older.py").write_text("import pcfix.version\npcfix.version.__version__ = '0.0.1'\n")
    older = worker(folder, "--preload", "older.py")
    try:
        done = run_pcfix(*words, address)
        assert done.returncode == 1
        assert f"has pcfix 0.0.1, here it is {pcfix.__version__}" in done.stderr
    finally:
        older.kill()
        older.wait()
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert "[cluster]'" in run_pcfix(*words, address).stderr
    assert not list((tmp_path / "out").glob("*.laz"))


def test_a_worker_that_is_killed_costs_only_its_tiles(scheduler, cloud, tmp_path):
    folder, address = scheduler
    workers = [worker(folder), worker(folder)]
    time.sleep(5)  # both are to share the work
    before = {}

    def kill_one(done, total):
        if done >= total // 3 and not before:
            workers[0].send_signal(signal.SIGKILL)
            before.update(finished(tmp_path / "out"))

    try:
        many = pcfix.correct_file(
            cloud[0], tmp_path / "out", scheduler=address, progress=kill_one, **GIVEN
        )
    finally:
        for one in workers:
            one.kill()
            one.wait()
    assert workers[0].returncode == -signal.SIGKILL
    assert len(before) >= 4
    assert before.items() <= finished(tmp_path / "out").items()
    one = pcfix.correct_file(cloud[1], tmp_path / "merged.las", **GIVEN)
    outputs = sorted((tmp_path / "out").glob("tile*.laz"))
    assert np.array_equal(records(*outputs), records(tmp_path / "merged.las"))
    assert (many.points, many.rays, many.shift_z_m) == (one.points, one.rays, one.shift_z_m)
    assert not list((tmp_path / "out").glob(".*.part*"))
    assert pcfix.correct_file(cloud[0], tmp_path / "out", scheduler="gone", **GIVEN) == many


def test_cleaning_on_a_cluster_gives_the_same_bytes(scheduler, cloud, tmp_path, monkeypatch):
    here = pcfix.clean_file(cloud[0], tmp_path / "here")
    folder, address = scheduler
    workers = [worker(folder), worker(folder)]
    monkeypatch.setattr("pcfix.flow.tiles.in_processes", None)  # nothing is done on this machine
    try:
        there = pcfix.clean_file(cloud[0], tmp_path / "there", scheduler=address)
    finally:
        for one in workers:
            one.kill()
            one.wait()
    assert there.noise == here.noise
    for path in cloud[0].iterdir():
        cleaned = [tmp_path / name / path.name for name in ("here", "there")]
        assert cleaned[0].read_bytes() == cleaned[1].read_bytes()


@pytest.fixture
def bucket(monkeypatch):
    """Return the address of a bucket of a server on this machine."""
    pytest.importorskip("s3fs")
    pytest.importorskip("upath")
    server = pytest.importorskip("moto.server").ThreadedMotoServer(port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "testing")
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
    import s3fs

    s3fs.S3FileSystem.clear_instance_cache()
    store = s3fs.S3FileSystem()
    store.mkdir("clouds")
    yield store
    s3fs.S3FileSystem.clear_instance_cache()
    server.stop()


def test_tiles_in_an_object_store_are_read_as_files(bucket, cloud, tmp_path):
    folder, _ = cut(tmp_path / "tiles", 2)
    for path in folder.iterdir():
        bucket.put(str(path), f"clouds/bay/{path.name}")
    pcfix.correct_file(folder, tmp_path / "local", **GIVEN)
    pcfix.correct_file("s3://clouds/bay", tmp_path / "remote", jobs=1, **GIVEN)
    for path in folder.iterdir():
        here, there = (records(tmp_path / name / path.name) for name in ("local", "remote"))
        assert np.array_equal(here, there)
    one = pcfix.label_file("s3://clouds/bay/tile0.laz", tmp_path / "one.laz", water=0.37)
    assert one.points == 10_000
    many = pcfix.label_file("s3://clouds/bay/tile*.laz", tmp_path / "labels", water=0.37)
    assert many.points == 20_000
    done = run_pcfix("label", "s3://clouds/none.laz", tmp_path / "x.laz", "--water", "0")
    assert done.stderr == "pcfix: s3://clouds/none.laz: there is no such file.\n"
    done = run_pcfix("label", "nowhere://clouds/a.laz", tmp_path / "x.laz", "--water", "0")
    assert "cannot be read" in done.stderr

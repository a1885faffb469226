"""Whatever ends a command, no input is touched and nothing lies half-written under its name."""

import os
import random
import signal
import time
from contextlib import suppress
from pathlib import Path

import laspy
import pytest

import pcfix
from pcfix.io.atomic import temporary_output
from tests.utils.codes import refused
from tests.utils.zygote import Zygote

SCENE = Path(__file__).parents[2] / "samples" / "scene"
LONGEST_S = 0.3
"""After which a signal is sent at the latest; a command has ended by then, or nearly."""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("inputs")
    cloud = laspy.read(SCENE / "cloud.laz")
    cloud.points = cloud.points[::8].copy()
    cloud.write(folder / "cloud.laz")
    for name in ("cameras.csv", "sensor.csv"):
        (folder / name).write_bytes((SCENE / name).read_bytes())
    return folder


@pytest.fixture(scope="module")
def commands(inputs):
    """Arguments but for the output folder, and the files that are written there."""
    cameras = ["--cameras", f"{inputs}/cameras.csv", "--sensor", f"{inputs}/sensor.csv"]
    more = ["--water", "0.37", "--overwrite", "--jobs", "1", "--quiet"]
    corrected = ["correct", f"{inputs}/cloud.laz", "OUT/corrected.laz", *cameras, *more]
    return {
        "correct": ([*corrected, "--method", "snell"], ["corrected.laz"]),
        "correct with summary": (
            [*corrected[:2], "OUT/other.las", *corrected[3:], "--summary", "OUT/other.json"],
            ["other.las", "other.json"],
        ),
        "label": (
            ["label", f"{inputs}/cloud.laz", "OUT/labelled.laz", *more, "--summary", "OUT/l.json"],
            ["labelled.laz", "l.json"],
        ),
    }


@pytest.fixture(scope="module")
def zygote(commands, tmp_path_factory):
    out = tmp_path_factory.mktemp("loaded")
    with Zygote(
        out / "log.txt", *(at(arguments, out) for arguments, _ in commands.values())
    ) as found:
        yield found


@pytest.fixture(scope="module")
def whole(commands, zygote, tmp_path_factory):
    """What the commands leave when nothing happens, by the name of the file."""
    out = tmp_path_factory.mktemp("whole")
    for arguments, _ in commands.values():
        zygote.start(at(arguments, out))
        assert zygote.wait() == 0, zygote.said
    return {path.name: path.read_bytes() for path in out.iterdir()}


def at(arguments, out):
    return [word.replace("OUT", str(out)) for word in arguments]


def state(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def is_whole(name, content, whole):
    """Clouds are the same to the byte; a summary differs in its seconds and folders."""
    return content.rstrip().endswith(b"}") if name.endswith("json") else content == whole[name]


@pytest.mark.parametrize(
    "seed", [1, *(pytest.param(s, marks=pytest.mark.nightly) for s in range(2, 18))]
)
def test_kills(seed, inputs, commands, whole, zygote, tmp_path):
    random_moment = random.Random(seed)
    before, ended, hidden = state(inputs), [], set()
    for number in range(60):
        name = random_moment.choice(list(commands))
        arguments, files = commands[name]
        signal_sent = random_moment.choice([signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
        delay_s = LONGEST_S * random_moment.uniform(0.0, 1.0) ** 2
        process = zygote.start(at(arguments, tmp_path))
        time.sleep(delay_s)
        with suppress(ProcessLookupError):  # it has ended
            os.kill(process, signal_sent)
        code = zygote.wait()
        case = f"kill {number}: {name}, {signal_sent.name} after {delay_s:.3f} s, code {code}"
        ended.append(code)
        assert code in (0, -signal_sent, 128 + signal_sent), f"{case}: {zygote.said}"
        left = sorted(path.name for path in tmp_path.iterdir())
        earlier, hidden = hidden, {one for one in left if one.startswith(".")}
        most = 2 if code == -signal.SIGKILL else 0  # a cloud and its summary
        assert len(hidden - earlier) <= most, case
        if code == 0:  # it removed what was left of its own files
            assert not [one for one in hidden for file in files if one.startswith(f".{file}.")], (
                case
            )
        for one in set(left) - hidden:
            assert is_whole(one, (tmp_path / one).read_bytes(), whole), f"{case}: {one}"
        if code == 0:
            assert set(files) <= set(left), case
    assert state(inputs) == before
    assert sum(code != 0 for code in ended) >= 20  # most were stopped in their work


def test_leftover_goes_with_the_next_run(inputs, commands, zygote, tmp_path):
    arguments, files = commands["correct"]
    for _ in range(50):
        process = zygote.start(at(arguments, tmp_path))
        while Path(f"/proc/{process}").exists() and not any(tmp_path.glob(".*.part.laz")):
            time.sleep(0.001)
        with suppress(ProcessLookupError):
            os.kill(process, signal.SIGKILL)
        if zygote.wait() == -signal.SIGKILL and any(tmp_path.glob(".*.part.laz")):
            break
    assert [path.name.startswith(".corrected.laz.") for path in tmp_path.iterdir()] == [True]
    zygote.start(at(arguments, tmp_path))
    assert zygote.wait() == 0
    assert [path.name for path in tmp_path.iterdir()] == files


def test_other_outputs_of_the_folder_stay(tmp_path):
    with temporary_output(tmp_path / "one.txt") as one:
        one.write_text("one")
        with temporary_output(tmp_path / "one") as other:
            other.write_text("other")
        assert one.read_text() == "one"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["one", "one.txt"]


@pytest.mark.parametrize("name", ["correct_file", "label_file", "clean_file"])
def test_no_cloud_without_its_summary(name, inputs, tmp_path, monkeypatch):
    def full(options, summary):
        raise pcfix.InputError("output.disk_full", f"{options.summary}: the disk is full.")

    given = {"summary": tmp_path / "s.json"}
    if name == "correct_file":
        given |= {"cameras": inputs / "cameras.csv", "sensor": inputs / "sensor.csv"}
    if name != "clean_file":
        given |= {"water": 0.37}
    monkeypatch.setattr("pcfix.flow.runner.write_summary", full)
    with refused("output.disk_full"):
        getattr(pcfix, name)(inputs / "cloud.laz", tmp_path / "out.laz", **given)
    assert list(tmp_path.iterdir()) == []


def test_mode_of_a_replaced_file(inputs, tmp_path):
    target = tmp_path / "labelled.las"
    target.write_bytes(b"")
    target.chmod(0o640)
    pcfix.label_file(inputs / "cloud.laz", target, water=0.37, overwrite=True)
    assert target.stat().st_mode & 0o777 == 0o640
    assert target.stat().st_size > 2500 * 30

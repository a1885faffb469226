"""Whatever ends a command, no input is touched and nothing lies half-written under its name."""

import random
import signal
import subprocess
import sys
import time

import pytest

import pcfix
from pcfix.io.files import temporary_output
from tests.utils.codes import refused

# After its first file a command gets a signal at the latest; it has ended by then, or nearly.
LONGEST_S = 0.1


@pytest.fixture(scope="module")
def commands(inputs):
    """Arguments but for the output folder, and the files that are written there."""
    cloud, cameras = f"{inputs}/cloud.laz", f"--cameras {inputs}/cameras.csv"
    more = "--water 0.37 --overwrite --jobs 1 --quiet"
    words = {
        f"correct {cloud} OUT/a.laz {cameras} {more} --method snell": ["a.laz"],
        f"correct {cloud} OUT/b.las {cameras} {more} --summary OUT/b.json": ["b.las", "b.json"],
        f"label {cloud} OUT/c.laz {more} --summary OUT/c.json": ["c.laz", "c.json"],
    }
    return [(line.split(), files) for line, files in words.items()]


def start(arguments, out):
    words = [word.replace("OUT", str(out)) for word in arguments]
    return subprocess.Popen(
        [sys.executable, "-m", "pcfix", *words], stderr=subprocess.PIPE, text=True
    )


@pytest.fixture(scope="module")
def whole(commands, tmp_path_factory):
    """What the commands leave when nothing happens, by the name of the file."""
    out = tmp_path_factory.mktemp("whole")
    for arguments, _ in commands:
        _, printed = (process := start(arguments, out)).communicate()
        assert process.returncode == 0, printed
    return {path.name: path.read_bytes() for path in out.iterdir()}


def state(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def is_whole(name, content, whole):
    """Clouds are the same to the byte; a summary differs in its seconds and folders."""
    return content.rstrip().endswith(b"}") if name.endswith("json") else content == whole[name]


def hidden_in(out):
    return {path.name for path in out.glob(".*")}


def killed(arguments, out, signal_sent, delay_s):
    """Stop a command some time after it began to write; return its exit code and what it said."""
    before, process = hidden_in(out), start(arguments, out)
    while process.poll() is None and not hidden_in(out) - before:
        time.sleep(0.001)
    time.sleep(delay_s)
    process.send_signal(signal_sent)
    printed = process.communicate()[1]
    return process.returncode, printed


@pytest.mark.parametrize(
    "seed", [1, *(pytest.param(s, marks=pytest.mark.nightly) for s in range(2, 18))]
)
def test_kills(seed, inputs, commands, whole, tmp_path):
    random_moment = random.Random(seed)
    before, ended, hidden = state(inputs), [], set()
    for number in range(12):
        arguments, files = random_moment.choice(commands)
        signal_sent = random_moment.choice([signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
        delay_s = LONGEST_S * random_moment.uniform(0.0, 1.0) ** 2
        code, printed = killed(arguments, tmp_path, signal_sent, delay_s)
        case = f"kill {number}: {files[0]}, {signal_sent.name} after {delay_s:.3f} s, code {code}"
        ended.append(code)
        assert code in (0, -signal_sent, 128 + signal_sent), f"{case}: {printed}"
        earlier, hidden = hidden, hidden_in(tmp_path)
        most = 2 if code == -signal.SIGKILL else 0  # a cloud and its summary
        assert len(hidden - earlier) <= most, case
        for path in tmp_path.iterdir():
            if path.name not in hidden:
                assert is_whole(path.name, path.read_bytes(), whole), f"{case}: {path.name}"
        if code == 0:  # it removed what was left of its own files
            assert not [one for one in hidden for file in files if one.startswith(f".{file}.")]
            assert all((tmp_path / file).is_file() for file in files), case
    assert state(inputs) == before
    assert sum(code != 0 for code in ended) >= 4  # some were stopped in their work


def test_leftover_goes_with_the_next_run(commands, tmp_path):
    arguments, files = commands[0]
    while killed(arguments, tmp_path, signal.SIGKILL, 0.0)[0] != -signal.SIGKILL:
        pass
    assert [path.name.startswith(".a.laz.") for path in tmp_path.iterdir()] == [True]
    assert start(arguments, tmp_path).wait() == 0
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

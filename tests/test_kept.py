"""Kernels are compiled once, and by one process; where a package cannot be written too."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from pcfix import kept

if TYPE_CHECKING:
    from collections.abc import Iterator

PACKAGE = Path(kept.__file__).parent

PROGRAM = """
import sys
from pathlib import Path
from pcfix import ahead, kept
closed, ready, go = sys.argv[1:4]
plain = kept.is_writable
# root writes wherever it likes: what is closed is said here
kept.is_writable = lambda folder: (not closed or closed not in str(folder)) and plain(folder)
ahead.announce.append(lambda: print("compiles"))
import numpy as np
from pcfix.lens import formulas
table = np.zeros(40)
table[formulas.LARGEST_RADIUS] = 3.0
if ready != "-":
    Path(ready).touch()
    while not Path(go).exists():
        pass
print(formulas.largest_radius(table))
"""


def start(package: Path, home: Path, closed: str = "", ready: str = "-", go: str = "-"):
    home.mkdir(exist_ok=True)
    keys = ("NUMBA_CACHE_DIR",)
    own = {key: value for key, value in os.environ.items() if key not in keys}
    own |= {"PYTHONPATH": str(package.parent), "XDG_CACHE_HOME": str(home), "TMPDIR": str(home)}
    return subprocess.Popen(
        [sys.executable, "-c", PROGRAM, closed, ready, go],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=own,
        cwd=package.parent,
    )  # fmt: skip


def said(process) -> tuple[str, str]:
    out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    return out, err


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A copy without any kernels."""
    leave = shutil.ignore_patterns("__pycache__")
    return Path(shutil.copytree(PACKAGE, tmp_path / "site" / "pcfix", ignore=leave))


@pytest.fixture
def fresh() -> Iterator[None]:
    for one in (kept.is_writable, kept.private_folder):
        one.cache_clear()
    yield
    for one in (kept.is_writable, kept.private_folder):
        one.cache_clear()


def test_what_was_kept_in_a_package_is_used_where_it_cannot_be_written(package, tmp_path):
    home = tmp_path / "home"
    first = said(start(package, home))
    assert "compiles" in first[0]
    for path in package.rglob("*.py"):
        os.utime(path, (1, 1))  # an image's layers keep whole seconds, or none at all
    closed = str(package)
    assert said(start(package, home, closed)) == (first[0].replace("compiles\n", ""), "")
    # its parts and numbers are in a kernel too, however far away
    for changed in ("formulas", "../parts", "../model"):
        source = package / "lens" / f"{changed}.py"
        source.write_text(source.read_text("utf-8") + "\n# changed\n", "utf-8")
        assert "compiles" in said(start(package, home, closed))[0]
    folder = home / "pcfix-kernels"
    assert folder.stat().st_mode & 0o777 == 0o700
    assert "compiles" not in said(start(package, home, closed))[0]


def test_where_nothing_can_be_written_that_is_said_once(package, tmp_path):
    out, err = said(start(package, tmp_path / "home", str(tmp_path)))
    assert "compiles" in out
    assert err.count("PcfixWarning: Kernels are compiled each time anew") == 1


@pytest.mark.skipif(sys.platform == "win32", reason="no flock")
def test_two_processes_compile_one_after_the_other(package, tmp_path):
    go = tmp_path / "go"
    both = [
        start(package, tmp_path / "home", "", str(tmp_path / name), str(go)) for name in ("a", "b")
    ]
    while not all((tmp_path / name).exists() or both[0].poll() for name in ("a", "b")):
        pass
    go.touch()
    (one, one_err), (other, other_err) = map(said, both)
    assert (one + other).count("compiles") == 1
    assert one.splitlines()[-1] == other.splitlines()[-1]
    assert (one_err + other_err).count("waiting for it") <= 1


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="no modes")
def test_a_folder_that_others_may_write_is_not_used(fresh, tmp_path, monkeypatch):
    """Whoever can put a kernel there can have it run."""
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(kept.tempfile, "tempdir", str(tmp_path))
    open_to_all = tmp_path / "cache" / "pcfix-kernels"
    open_to_all.mkdir(parents=True)
    open_to_all.chmod(0o777)
    found = kept.private_folder()
    assert found == tmp_path / f"pcfix-{os.getuid()}"
    assert found.stat().st_mode & 0o777 == 0o700
    (tmp_path / "elsewhere").mkdir(mode=0o700)
    found.rmdir()
    found.symlink_to(tmp_path / "elsewhere")
    kept.private_folder.cache_clear()
    with pytest.warns(kept.PcfixWarning, match="each time anew"):
        assert kept.private_folder() is None

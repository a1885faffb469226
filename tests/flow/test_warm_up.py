"""`pcfix warm-up` compiles what the commands need, once."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import get_args

import pytest

import pcfix
from pcfix.errors import SettingError
from pcfix.flow import warm_up
from pcfix.options.correct import Method
from pcfix.options.handover import WARMED, WarmUpOptions

PACKAGE = Path(pcfix.__file__).parent
SCENE = PACKAGE.parent / "samples" / "scene"

PROGRAM = """
import sys
from pcfix import ahead, kept
closed, limited, *words = sys.argv[1:]
plain = kept.is_writable
# root writes wherever it likes: what is closed is said here
kept.is_writable = lambda folder: (not closed or closed not in str(folder)) and plain(folder)
ahead.announce.append(lambda: print("compiles"))
from pcfix.cli import main
if limited:
    import numpy as np
    from pcfix.flow import warm_up
    from pcfix.lens import formulas
    table = np.zeros(40)
    table[formulas.LARGEST_RADIUS] = 3.0
    warm_up.steps = lambda *given: [lambda: formulas.largest_radius(table)]
main(words)
"""


def said(package: Path, *words: str, closed: str = "", limited: str = "limited") -> str:
    home = package.parent.parent
    own = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    own |= {"PYTHONPATH": str(package.parent), "XDG_CACHE_HOME": str(home), "TMPDIR": str(home)}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, closed, limited, *words],
        capture_output=True, text=True, check=False, cwd=home, env=own,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A copy without any kernels."""
    leave = shutil.ignore_patterns("__pycache__")
    return Path(shutil.copytree(PACKAGE, tmp_path / "site" / "pcfix", ignore=leave))


def test_it_says_what_it_compiled_and_when_nothing_was_to_be_done(package):
    first = said(package, "warm-up")
    assert "compiles" in first
    assert "1 kernel compiled in" in first
    assert f"kept in {package}\n" in first
    again = said(package, "warm-up", closed=str(package))
    assert again.startswith(f"nothing was to be done: the kernels are kept in {package} (")


@pytest.mark.nightly
def test_afterwards_no_command_compiles_where_the_package_cannot_be_written(package):
    assert "compiles" in said(package, "warm-up", limited="")
    out, scene = package.parent.parent, [f"--cameras={SCENE / 'cameras.csv'}", "--water=0.37"]
    cloud, lidar, made = SCENE / "cloud.laz", SCENE / "lidar.laz", out / "corrected.laz"
    for words in (
        ("correct", cloud, made, *scene),
        *(
            ("correct", cloud, made, *scene, "--overwrite", f"--method={method}")
            for method in ("snell", "consistent", "shan", "murase", "butler")
        ),
        ("clean", made, out / "cleaned.laz"),
        ("dsm", made, out / "bed.tif"),
        ("compare", made, lidar),
    ):
        assert "compiles" not in said(package, *map(str, words), closed=str(package), limited="")


def test_every_method_and_command_is_run(tmp_path):
    methods = {given.get("method", "auto") for _, given in warm_up.CORRECTIONS}
    assert methods == set(get_args(Method)) - {"regression"}  # which has no kernels
    alone = [len(warm_up.steps((name,), tmp_path)) for name in WARMED]
    scenes = len(warm_up.SCENES)
    assert min(alone) > scenes
    assert len(warm_up.steps(WARMED, tmp_path)) == sum(alone) - scenes * (len(WARMED) - 1)


def test_commands_it_does_not_know():
    with pytest.raises(SettingError, match=r"commands .*adjust.* must be of correct, clean, dsm"):
        WarmUpOptions(commands="correct,adjust")


def test_where_no_kernel_can_be_kept(monkeypatch):
    monkeypatch.setattr(warm_up, "roots", tuple)
    with pytest.raises(SettingError, match=r"Kernels cannot be kept: .* set NUMBA_CACHE_DIR"):
        warm_up.warm_up(WarmUpOptions())

"""A second process that compiles kernels changes nothing, whatever becomes of it."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest

from tests.utils.nightly import mostly_nightly

if TYPE_CHECKING:
    from pathlib import Path

linux = pytest.mark.skipif(sys.platform != "linux", reason="only Linux forks")

PROGRAM = """
import os, sys
import numpy as np
from pcfix import ahead
from pcfix.lens import formulas

way = sys.argv[1]
kernels = [f"pcfix.lens.formulas.{name}" for name in ("_largest_radius", "angle")]
assert not any(map(ahead.is_kept, kernels))
parent = os.getpid()

def first():
    assert os.getpid() != parent
    if way == "killed":
        os.abort()
    if way == "error":
        raise ValueError("loud")
    print("this is heard by nobody")
    formulas.largest_radius(table)

table = np.zeros(40)
table[formulas.LARGEST_RADIUS] = 3.0
rehearsals = (
    ahead.Rehearsal(kernels[:1], first),
    ahead.Rehearsal(kernels[1:], lambda: formulas.angle(table, 0.5)),
)
with ahead.compiling_ahead(rehearsals, 1 if way == "alone" else 2):
    print(formulas.largest_radius(table), formulas.angle(table, 0.5))
assert ahead._team is None
assert all(map(ahead.is_kept, kernels))
"""


def said(way: str, cache: Path) -> str:
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, way],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"NUMBA_CACHE_DIR": str(cache)},
    )
    assert done.stderr == ""
    return done.stdout


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> str:
    return said("alone", tmp_path_factory.mktemp("alone"))


@linux
@pytest.mark.parametrize("way", mostly_nightly(["two", "error", "killed"], "killed"))
def test_it_says_nothing_and_changes_nothing(way: str, alone: str, tmp_path: Path) -> None:
    assert said(way, tmp_path / way) == alone


def test_compiling_is_announced_once(monkeypatch):
    import numba

    from pcfix import ahead, parts  # noqa: F401  # which listens to numba

    said = []
    monkeypatch.setattr(ahead, "announce", [lambda: said.append("compiling")])
    for function in (numba.njit(lambda x: x + 1), numba.njit(lambda x: x + 2)):
        function(1)
        function(2)
    assert said == ["compiling"]

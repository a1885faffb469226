"""How kernels are compiled changes nothing of the results."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numba

from pcfix.parts import TRIED

if TYPE_CHECKING:
    from pytest import TempPathFactory

CORRECT = """
import sys
import numba
if sys.argv[1] == "apart":
    numba.__version__ = "0.0.0"
import numpy as np, pcfix, pcfix.parts
assert (sys.argv[1] == "linked") == pcfix.parts._are_linked
if sys.argv[1] == "apart":  # what numba keeps by itself is not used after a change of other files
    assert numba.config.CACHE_DIR == str(pcfix.kept.folder_of_numba())
across, along = np.meshgrid(np.linspace(-40, 40, 3), np.linspace(-40, 40, 3))
centres = np.column_stack([across.ravel(), along.ravel(), np.full(9, 100.0)])
lens = pcfix.Lens(3000.0, 4000.0, 3000.0, 2010.0, 1490.0)
cameras = pcfix.Cameras(
    tuple("abcdefghi"), centres, np.tile(np.diag([1.0, -1.0, -1.0]), (9, 1, 1)), (lens,) * 9
)
from pcfix.options.correct import ScienceOptions
from pcfix.refract.batch import Batch, Survey
from pcfix.refract.shan import shan
from pcfix.water.surface import SurfaceAbove
places = np.random.default_rng(5).uniform([-30, -30, -6], [30, 30, -1], (500, 3))
above = SurfaceAbove(np.zeros(500), np.zeros((500, 2)))
survey = Survey(pcfix.WaterPlane(0.0), cameras, ScienceOptions(method="shan"))
views = pcfix.Views(9 * np.arange(501), np.tile(np.arange(9), 500))
found = shan(Batch(places, above, survey, views))
assert (found.outcome == pcfix.Outcome.CORRECTED).all()
sys.stdout.buffer.write(np.column_stack([found.shift_m, found.ray_miss_m]).tobytes())
"""


def corrected(way: str, cache: Path | None = None) -> bytes:
    done = subprocess.run(
        [sys.executable, "-c", CORRECT, way],
        capture_output=True,
        check=True,
        env=os.environ | ({"NUMBA_CACHE_DIR": str(cache)} if cache else {}),
    )
    return done.stdout


def test_this_numba_was_tried() -> None:
    assert numba.__version__.rpartition(".")[0] in TRIED


def test_parts_give_what_kernels_give(tmp_path_factory: TempPathFactory) -> None:
    linked = corrected("linked")  # with the kernels that all others use
    assert len(linked) == 500 * 4 * 8
    assert linked == corrected("apart", tmp_path_factory.mktemp("apart"))

"""Printed commands work, errors have the right reason, absorbed refraction is detected."""

import json
import shutil
import warnings

import laspy
import numpy as np
import pytest

import pcfix
from pcfix.adjust.diagnosis import Diagnosis, land_sign, neighbours_sign
from pcfix.model import Cameras, Lens, Outcome
from tests.utils.crops import middle_of
from tests.utils.nightly import mostly_nightly
from tests.utils.program import run_pcfix
from tests.utils.shared import needs

BENT, bent = needs("rendered_c_free")
OFFSET_M = (318700.0, 3851200.0, 0.0)
LEVEL_M = 0.37
"""Enough for lines that work; `test_adjust_shared.py` asks how good the block gets."""


@pytest.fixture(scope="module")
def bent_middle(tmp_path_factory):
    return middle_of(BENT, tmp_path_factory.mktemp("bent"))


@bent
def test_local_ply(bent_middle, tmp_path):
    """As of a dense workspace, shifted to the origin, where the cameras are on the map."""
    shutil.copy(bent_middle / "dense.vis", tmp_path)
    las = laspy.read(bent_middle / "cloud.las")
    local = (np.asarray(las.xyz) - OFFSET_M).astype("<f4")
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(local)}\n{axes}end_header\n"
    (tmp_path / "dense.ply").write_bytes(head.encode() + local.tobytes())
    done = run_pcfix(
        "correct", bent_middle / "cloud.las", tmp_path / "out.laz",
        "--cameras", BENT / "cameras.xml", "--water", LEVEL_M,
        "--views", tmp_path / "dense.vis", "--summary", tmp_path / "it.json",
    )  # fmt: skip
    assert (done.returncode, done.code) == (1, "views.other_images")


def nadir():
    """Two cameras 100 m up, 60 m apart, of a wide lens."""
    lens = Lens(500.0, 1000.0, 1000.0, 500.0, 500.0)
    centres = np.array([[-30.0, 0.0, 100.0], [30.0, 0.0, 100.0]])
    return Cameras(("a", "b"), centres, np.tile(np.diag([1.0, -1.0, -1.0]), (2, 1, 1)), (lens,) * 2)


def test_flat_rays():
    """Straight below one of two cameras, between them, and out of all frames."""
    xyz = [[30.0, 0.0, -2.0], [0.0, 0.0, -2.0], [0.0, 500.0, -2.0]]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = pcfix.correct_points(xyz, nadir(), 0.0, method="snell", max_angle=20.0)
    assert found.outcome.tolist() == [Outcome.FLAT_RAYS, Outcome.CORRECTED, Outcome.NO_CAMERA]


@pytest.mark.parametrize(
    ("share", "sigma", "is_fused", "absorbed"),
    [
        (0.02, 0.03, True, False),
        (0.25, 0.02, True, False),
        (0.86, 0.02, True, True),
        (0.86, 0.02, False, None),  # what is left may be that of a wrong guess at the rays
        (0.25, 0.02, False, False),
        (0.6, 0.05, True, None),
    ],
)
def test_neighbours_sign(share, sigma, is_fused, absorbed):
    assert neighbours_sign(share, sigma, is_fused=is_fused).speaks is absorbed


def test_neighbours_last():
    off = land_sign(np.ones(9), 0.05, "the reference")
    found = Diagnosis((off, neighbours_sign(0.1, 0.01, is_fused=True)))
    assert found.absorbed is True
    bent = Diagnosis((neighbours_sign(0.9, 0.01, is_fused=True),))
    assert bent.sentence("pcfix adjust").startswith("The poses seem to have absorbed")


def told_of(cloud, cameras, tmp_path, *more):
    """Return stdout and stderr of a correction, and its summary."""
    done = run_pcfix(
        "correct", cloud, tmp_path / "out.laz", "--cameras", cameras,
        "--water", LEVEL_M, "--summary", tmp_path / "summary.json", *more,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done, json.loads((tmp_path / "summary.json").read_text())


@bent
@pytest.mark.parametrize("listed", mostly_nightly((False, True), True))
def test_absorbed(bent_middle, tmp_path, listed):
    more = ["--views", bent_middle / "dense.vis"] if listed else []
    done, found = told_of(bent_middle / "cloud.las", BENT / "cameras.xml", tmp_path, *more)
    assert "The poses seem to have absorbed the refraction" in done.stderr
    assert "--gnss GNSS.csv" in done.stderr
    assert "no order is claimed" in done.stdout
    assert found["poses"]["absorbed"] is True
    assert found["uncertainty"]["s44"] is None
    assert found["uncertainty"]["why_no_order"]

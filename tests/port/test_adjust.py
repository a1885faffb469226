"""Images through a housing port, adjusted from files: poses, points and the program."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import pcfix
from pcfix.flow.adjust import adjust_cameras
from pcfix.io.cameras.colmap.writing import write_colmap
from pcfix.kernels import threads
from pcfix.model import TiePoints
from pcfix.port.shapes import DomePort, FlatPort
from tests.utils.adjust_files import EPSG, write_gnss
from tests.utils.port_scenes import simulate_port
from tests.utils.program import run_pcfix

pytestmark = pytest.mark.filterwarnings("default::pcfix.errors.PcfixWarning")

FLAT = FlatPort(0.02, 0.008)
SIGMA_M = 0.005
"""Of the positions, as total stations and frames with scale bars give them under water."""


def write_scene(folder, port):
    """Write a model whose poses are wrong by centimetres, with apparent points."""
    made = simulate_port(port, points=300, noise_px=0.3, seed=4)
    rng = np.random.default_rng(6)
    off = rng.normal(0.0, 0.02, made.cameras.centres.shape)
    cameras = replace(made.cameras, centres=made.cameras.centres + off)
    write_colmap(
        folder / "model", cameras, TiePoints(made.apparent, made.views, made.image_xy), crs=EPSG
    )
    places = made.cameras.centres + rng.normal(0.0, SIGMA_M, off.shape)
    write_gnss(folder / "gnss.csv", cameras.labels, places, np.full(off.shape, SIGMA_M))
    return made


@pytest.mark.parametrize("port", [FLAT, DomePort(0.05, 0.0, 1.49, (0.003, 0.0, 0.004))])
def test_poses_and_bed_come_home(tmp_path, port):
    made = write_scene(tmp_path, port)
    with threads(1):
        found = adjust_cameras(
            tmp_path / "model", water=None, port=port, gnss=tmp_path / "gnss.csv",
            index=made.refractive_index, lens_unknowns=(),
        )  # fmt: skip
    assert found.sigma0 == pytest.approx(1.0, abs=0.1)
    off = found.cameras.centres - made.cameras.centres
    # standard errors of the adjustment itself, which its own tests compare with repeats
    sigma_m = found.precision.centre_sigma_m
    assert np.sqrt((off**2).mean()) < 1.5 * np.sqrt((sigma_m**2).mean()) < 0.02
    # points that two images show from 0.1 m apart are known to decimetres: the median counts
    assert len(found.xyz) == len(made.truth)
    bed = np.median(np.abs(found.xyz - made.truth)[:, 2])
    assert bed < 2.0 * np.median(found.precision.point_sigma_m[:, 2])
    if port is FLAT:  # a dome about the projection centre hardly bends anything
        assert bed < 0.1 * np.median(np.abs(made.apparent - made.truth)[:, 2])


def test_the_program_writes_it(tmp_path):
    made = write_scene(tmp_path, FLAT)
    words = [
        "adjust", "model", "out", "--port", "flat:distance=0.02,thickness=0.008",
        "--gnss", "gnss.csv", "--lens-unknowns", "none", "-q",
    ]  # fmt: skip
    done = run_pcfix(*words, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    read = pcfix.read_cameras(tmp_path / "out" / "colmap")
    off = read.centres - made.cameras.centres
    assert np.sqrt((off**2).mean()) < 0.02  # m: what they were off before
    assert (tmp_path / "out" / "report.html").is_file()

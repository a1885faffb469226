"""Images through a housing port, adjusted from files: poses, points and the program."""

import json
from dataclasses import replace

import numpy as np
import pytest

from pcfix.adjust.block import plain_block
from pcfix.adjust.parameters import Unknowns
from pcfix.adjust.problem import port_of, prepare
from pcfix.adjust.solve import solve
from pcfix.errors import SettingError
from pcfix.flow.adjust import adjust_cameras, correct_words
from pcfix.io.cameras.colmap import write_colmap
from pcfix.model import GnssPositions, TiePoints
from pcfix.options.correct import AdjustOptions
from pcfix.port.housing import DomePort, FlatPort, window_of
from pcfix.port.housing import port_of as port_of_text
from pcfix.report.adjustment import adjustment_text
from pcfix.running import threads
from tests.utils.adjust_files import EPSG, write_gnss
from tests.utils.port_scenes import simulate_port

pytestmark = pytest.mark.filterwarnings("default::pcfix.errors.PcfixWarning")

FLAT, DOME = FlatPort(0.02, 0.008), DomePort(0.05, 0.0, 1.49, (0.003, 0.0, 0.004))
# Of the positions, as total stations and frames with scale bars give them under water.
SIGMA_M = 0.005


def write_scene(folder, port):
    """Write a model whose poses are wrong by centimetres, with apparent points."""
    data = simulate_port(port, points=300, noise_px=0.3, seed=4)
    rng = np.random.default_rng(6)
    off = rng.normal(0.0, 0.02, data.cameras.centres.shape)
    cameras = replace(data.cameras, centres=data.cameras.centres + off, crs=EPSG)
    ties = TiePoints(data.apparent, data.views, data.image_xy)
    write_colmap(folder / "model", cameras, ties)
    places = data.cameras.centres + rng.normal(0.0, SIGMA_M, off.shape)
    write_gnss(folder / "gnss.csv", cameras.labels, places, np.full(off.shape, SIGMA_M))
    return data


def moved(port):
    """Return the port millimetres off, and the unknown that brings it back."""
    if isinstance(port, FlatPort):
        return replace(port, distance_m=0.03), "distance"
    return replace(port, centre_m=(0.0, 0.0, 0.0)), "centre"


@pytest.mark.parametrize("port", [FLAT, DOME])
def test_poses_and_bed(tmp_path, port):
    data = write_scene(tmp_path, port)
    with threads(1):
        found = adjust_cameras(
            tmp_path / "model", water=None, port=port, gnss=tmp_path / "gnss.csv",
            index=data.refractive_index, lens_unknowns=(),
        )  # fmt: skip
    assert found.sigma0 == pytest.approx(1.0, abs=0.1)
    off = found.cameras.centres - data.cameras.centres
    # standard errors of the adjustment itself, which its own tests compare with repeats
    sigma_m = found.precision.centre_sigma_m
    assert np.sqrt((off**2).mean()) < 1.5 * np.sqrt((sigma_m**2).mean()) < 0.02
    # points that two images show from 0.1 m apart are known to decimetres: the median counts
    assert len(found.xyz) == len(data.truth)
    bed = np.median(np.abs(found.xyz - data.truth)[:, 2])
    assert bed < 2.0 * np.median(found.precision.point_sigma_m[:, 2])
    if port is FLAT:  # a dome about the projection centre hardly bends anything
        assert bed < 0.1 * np.median(np.abs(data.apparent - data.truth)[:, 2])


@pytest.mark.parametrize("port", [FLAT, DomePort(0.05, 0.004, 1.49, (0.003, -0.002, 0.006))])
def test_port_from_exact_images(port):
    """Light by Fermat's principle; the start is off by millimetres."""
    data, (start, free) = simulate_port(port, points=200, seed=4), moved(port)
    ties = TiePoints(data.truth, data.views, data.image_xy)
    block = plain_block(data.cameras, ties, None, data.refractive_index)
    sigmas = np.full((len(data.cameras), 3), SIGMA_M)
    block = replace(block, port=start, gnss=GnssPositions(data.cameras.centres, sigmas, None))
    problem, begin = prepare(block, Unknowns(lens=(), surface={free: np.inf}))
    with threads(1):
        found = solve(problem, begin)
    home = port_of(block, found.state.water)
    for numbers, true in zip(window_of(home), window_of(port), strict=True):
        np.testing.assert_allclose(numbers, true, atol=1e-8)  # m
    np.testing.assert_allclose(found.state.xyz + problem.origin, data.truth, atol=1e-5)


@pytest.mark.parametrize("port", [FLAT, DOME])
def test_port_from_noisy_images(tmp_path, port):
    data, (start, free) = write_scene(tmp_path, port), moved(port)
    with threads(1):
        found = adjust_cameras(
            tmp_path / "model", tmp_path / "out", water=None, port=start, free=(free,),
            gnss=tmp_path / "gnss.csv", index=data.refractive_index, lens_unknowns=(),
        )  # fmt: skip
    summary = json.loads((tmp_path / "out" / "adjustment.json").read_text())
    again = port_of_text(summary["port"])  # to 0.1 um
    for numbers, adjusted in zip(window_of(again), window_of(found.port), strict=True):
        np.testing.assert_allclose(numbers, adjusted, atol=1e-7)
    names = ("distance",) if port is FLAT else ("centre_x", "centre_y", "centre_z")
    values = (port.distance_m,) if port is FLAT else port.centre_m
    for name, value in zip(names, values, strict=True):
        row = summary["shared"][name]
        assert abs(row["after"] - value) < 3.5 * row["sigma"]
        assert abs(row["before"] - value) > 0.0 or value == 0.0
    assert f"--port {summary['port']}" in " ".join(adjustment_text(summary).split())
    options = AdjustOptions(port=port, free=(free,))
    words = correct_words(found, "model", tmp_path / "out", options)
    assert words.endswith(f"--port {summary['port']}")


@pytest.mark.parametrize(
    ("free", "port"), [("level", FLAT), ("centre", FLAT), ("distance", DomePort(0.05))]
)
def test_unknowns_refused(free, port, tmp_path):
    write_scene(tmp_path, FLAT)
    given = {"water": None, "gnss": tmp_path / "gnss.csv"}
    with pytest.raises(SettingError):
        adjust_cameras(tmp_path / "model", port=port, free=(free,), **given)

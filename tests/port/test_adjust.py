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
from pcfix.port.light import coefficients
from pcfix.port.shapes import DomePort, FlatPort
from pcfix.port.shapes import port_of as port_of_text
from pcfix.report.adjustment import adjustment_text
from pcfix.running import threads
from tests.utils.adjust_files import EPSG, write_gnss
from tests.utils.port_scenes import simulate_port

pytestmark = pytest.mark.filterwarnings("default::pcfix.errors.PcfixWarning")

FLAT = FlatPort(0.02, 0.008)
SIGMA_M = 0.005
"""Of the positions, as total stations and frames with scale bars give them under water."""


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


@pytest.mark.parametrize("port", [FLAT, DomePort(0.05, 0.0, 1.49, (0.003, 0.0, 0.004))])
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
    data, is_flat = simulate_port(port, points=200, seed=4), isinstance(port, FlatPort)
    start = replace(port, distance_m=0.03) if is_flat else replace(port, centre_m=(0.0, 0.0, 0.0))
    unknowns = Unknowns(lens=(), surface={"distance" if is_flat else "centre": np.inf})
    ties = TiePoints(data.truth, data.views, data.image_xy)
    block = replace(
        plain_block(data.cameras, ties, None, data.refractive_index), port=start,
        gnss=GnssPositions(
            data.cameras.centres, np.full((len(data.cameras), 3), SIGMA_M), None
        ),
    )  # fmt: skip
    problem, begin = prepare(block, unknowns)
    with threads(1):
        found = solve(problem, begin)
    home = port_of(block, found.state.water)
    if is_flat:
        assert home.distance_m == pytest.approx(port.distance_m, abs=1e-8)  # m
    else:
        np.testing.assert_allclose(home.centre_m, port.centre_m, atol=1e-8)
    np.testing.assert_allclose(found.state.xyz + problem.origin, data.truth, atol=1e-5)


@pytest.mark.parametrize(
    ("port", "free"),
    [(FLAT, "distance"), (DomePort(0.05, 0.0, 1.49, (0.003, 0.0, 0.004)), "centre")],
)
def test_port_from_noisy_images(tmp_path, port, free):
    data = write_scene(tmp_path, port)
    is_flat = free == "distance"
    start = replace(port, distance_m=0.03) if is_flat else replace(port, centre_m=(0.0, 0.0, 0.0))
    with threads(1):
        found = adjust_cameras(
            tmp_path / "model", tmp_path / "out", water=None, port=start, free=(free,),
            gnss=tmp_path / "gnss.csv", index=data.refractive_index, lens_unknowns=(),
        )  # fmt: skip
    summary = json.loads((tmp_path / "out" / "adjustment.json").read_text())
    again = port_of_text(summary["port"])  # to 0.1 um
    np.testing.assert_allclose(coefficients(again), coefficients(found.port), atol=1e-7)
    names = ("distance",) if is_flat else ("centre_x", "centre_y", "centre_z")
    true = dict(zip(names, (port.distance_m,) if is_flat else port.centre_m, strict=True))
    for name, value in true.items():
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

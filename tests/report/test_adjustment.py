"""The report of an adjustment: its numbers are those of a calculation by hand."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from pcfix.adjust.block import Block
from pcfix.adjust.parameters import Unknowns
from pcfix.adjust.precision import Precision, SharedUnknown
from pcfix.adjust.result import Adjusted, ControlRow, adjustment_dict, residuals_before
from pcfix.errors import PcfixWarning
from pcfix.model import Cameras, GnssPositions, GroundControl, Lens, WaterPlane
from pcfix.report.adjustment import adjustment_page, adjustment_text
from tests.report.test_report import Elements
from tests.utils.shared import ROOT

FOCAL, HEIGHT, LEVEL = 1000.0, 50.0, 0.5
EAST, NORTH = 320000.0, 3842000.0
# World to camera of a camera that looks straight down, its upper edge in the north.
DOWN = np.diag([1.0, -1.0, -1.0])


def lens(focal=FOCAL):
    return Lens(
        focal=focal, width=1600.0, height=1200.0, principal_x=800.0, principal_y=600.0,
        sensor="S", unit="px",
    )  # fmt: skip


def cameras(focal=FOCAL, shift=(0.0, 0.0, 0.0)):
    centres = np.array([[EAST, NORTH, HEIGHT], [EAST + 10.0, NORTH, HEIGHT],
                        [EAST, NORTH + 12.0, HEIGHT]])  # fmt: skip
    return Cameras(
        ("a.jpg", "b.jpg", "c.jpg"), centres + np.array(shift), np.array([DOWN] * 3),
        (lens(focal),) * 3, "EPSG:25833",
    )  # fmt: skip


AFTER = cameras(1002.0, (0.0, 0.0, 0.3))
# Adjusted centres minus GNSS positions.
OFF_M = np.array([[0.01, 0.02, 0.03], [0.05, -0.02, 0.09], [np.nan] * 3])


def points(m=24):
    """Return m points under the cameras: a third on land, the others down to 3.5 m of depth."""
    rng = np.random.default_rng(3)
    xy = rng.uniform([EAST - 5.0, NORTH - 5.0], [EAST + 15.0, NORTH + 15.0], (m, 2))
    z = np.where(np.arange(m) % 3 == 0, 1.5, np.linspace(0.2, -3.0, m))
    return np.column_stack([xy, z])


def pinhole(xyz, block_cameras):
    """Return the images of each point in all cameras, straight rays, point by point."""
    away = xyz[:, None] - block_cameras.centres
    local = np.einsum("kij,mkj->mki", block_cameras.rotations, away).reshape(-1, 3)
    return [800.0, 600.0] + block_cameras.lenses[0].focal * local[:, :2] / local[:, 2:]


def make_block(xyz, images, before, refractive_index=1.34):
    m, k = len(xyz), 3
    return Block(
        before, xyz, np.arange(m + 1) * k, np.tile(np.arange(k), m), images, np.full(m * k, 0.3),
        np.ones(m, bool), GnssPositions(AFTER.centres - OFF_M, np.full((k, 3), 0.03), None),
        WaterPlane(LEVEL), refractive_index,
    )  # fmt: skip


def surveyed(points, checks=0):
    """Return control points, the last ones of them check points, without marks."""
    none, is_check = np.zeros(0, int), np.arange(points) >= points - checks
    return GroundControl(
        tuple(f"G{i}" for i in range(points)), np.full((points, 3), np.nan),
        np.full((points, 3), 0.001), is_check, is_check, none, none, np.zeros((0, 2)), np.zeros(0),
    )  # fmt: skip


@pytest.fixture
def adjusted(monkeypatch):
    """Return 24 points in three images with residuals of 0.3 on land and 0.4 px under water.

    Before the adjustment these were 1.2 and 2.4 px.
    """
    xyz, before = points(), cameras()
    is_wet = xyz[:, 2] < LEVEL
    residual = np.where(is_wet, 0.4, 0.3).repeat(3)[:, None] * np.array([1.0, -1.0])
    used = np.ones(72, bool)
    used[[1, 40]] = False
    residual[~used] = 30.0
    control = [
        ControlRow("G1", "control", 0.010, -0.020, 0.030, 0.5, 3),
        ControlRow("G2", "control", 0.010, 0.020, -0.050, 0.7, 2),
        ControlRow("C1", "check", -0.040, 0.000, 0.060, 0.8, 3),
    ]
    monkeypatch.setattr(
        "pcfix.adjust.result.residuals_before",
        lambda _: np.where(is_wet, 2.4, 1.2).repeat(3)[:, None] * np.ones(2),
    )
    return Adjusted(
        make_block(xyz, pinhole(xyz, before), before), Unknowns(surface={"level": 0.1}), AFTER,
        WaterPlane(LEVEL + 0.02), 1.34, xyz, residual, used, is_wet, 1.234, 60, "tie points",
        make_precision(len(xyz)), control,
        [PcfixWarning("adjust.lens", "something <decided>")],
    )  # fmt: skip


def make_precision(m):
    pose = np.zeros((3, 6, 6))
    pose[:, range(6), range(6)] = [1e-6, 4e-6, 9e-6, 1e-4, 4e-4, 9e-4]
    pose[1] *= 4.0
    pose[2] *= 9.0
    shared = {
        "f": SharedUnknown(FOCAL, 1002.0, 0.25), "level": SharedUnknown(LEVEL, LEVEL + 0.02, 0.004),
    }  # fmt: skip
    # of every point: 1, 2 and 3 cm
    sigma = np.tile([0.01, 0.02, 0.03], (m, 1))
    correlation = np.array([[1.0, -0.6], [-0.6, 1.0]])
    return Precision(1.234, pose, shared, correlation, sigma)


def test_residuals_on_the_ground(adjusted):
    found = adjustment_dict(adjusted)["residuals"]["land"]["rms_m"]
    land = ~adjusted.is_wet
    away = np.linalg.norm(adjusted.xyz[land, None] - adjusted.cameras.centres, axis=2)
    used = adjusted.used.reshape(-1, 3)[land]
    wanted = np.sqrt(((0.3 * away[used] / 1002.0) ** 2).mean())
    assert found == pytest.approx(wanted, rel=1e-12)


def test_values(adjusted):
    values = adjustment_dict(adjusted)
    json.dumps(values, allow_nan=False)
    reference = (ROOT / "pcfix" / "cli" / "README.md").read_text("utf-8")
    table = reference[reference.index("| key of `adjustment.json`") :].partition("\n\n")[0]
    rows = re.findall(r"^\| (`.*?) \|", table, re.M)
    assert {name.strip("` ") for row in rows for name in row.split(",")} == set(values)
    # standard errors 1, 2, 3 cm of one pose, twice and three times these of the others
    assert values["precision"]["centre_mean_m"] == pytest.approx([0.02, 0.04, 0.06])
    assert values["precision"]["angle_mean_deg"] == pytest.approx(np.degrees([0.002, 0.004, 0.006]))
    assert values["poses"]["moved_rms_m"] == pytest.approx(0.3)
    assert values["poses"]["turned_rms_deg"] == 0.0


def bare(adjusted):
    """Return what is least: no water, nothing beside the images, one step."""
    unknown = np.full((3, 3), np.nan)
    block = replace(adjusted.block, water=None, gnss=GnssPositions(unknown, unknown, None))
    return replace(
        adjusted, block=block, water=None, is_wet=np.zeros(len(adjusted.xyz), bool), control=[],
        notes=[], unknowns=Unknowns(poses="fixed", lens=()),
    )  # fmt: skip


@pytest.mark.parametrize("kind", ["whole", "bare"])
def test_page(adjusted, kind):
    values = adjustment_dict(adjusted if kind == "whole" else bare(adjusted))
    texts = " ".join(Elements(adjustment_page(values)).texts)
    assert not re.search(r"\bnan\b|\bNone\b|\binf\b", texts + adjustment_text(values))
    assert "Adjusted 3 images and 24 points" in texts
    assert ("Something <decided>" in texts) == (kind == "whole")


def test_text(adjusted):
    """Before and after: lens and level with standard errors, residuals, GNSS; what is known."""
    lines = adjustment_text(adjustment_dict(adjusted)).splitlines()
    rows = [re.split(r"  +", line.strip()) for line in lines[1:7]]
    table = {label: numbers for label, *numbers in rows}
    assert table["Focal length (px)"] == ["1000", "1002", "0.25"]
    assert table["Water level (m)"] == ["0.5", "0.52", "0.004"]
    assert table["Residuals on land (px)"] == ["1.200", "0.300"]
    assert table["Residuals under water (px)"] == ["2.400", "0.400"]
    # of differences of 1, 2, 3 and 5, 2, 9 cm
    wanted = np.sqrt((0.01**2 + 0.02**2 + 0.03**2 + 0.05**2 + 0.02**2 + 0.09**2) / 2.0)
    assert float(table["Centres minus GNSS (m)"][1]) == pytest.approx(wanted, abs=5e-4)
    assert "  Bed                           heights known to 0.030 m (standard error, RMS)" in lines


def test_check_points(adjusted):
    """The last point is a check point: none of its three images is used."""
    used = adjusted.used.copy()
    used[-3:] = False
    used[3:6] = False  # a tie point that is left out wholly
    found = replace(adjusted, block=replace(adjusted.block, control=surveyed(2, 1)), used=used)
    values = adjustment_dict(found)
    assert values["points"] == {"all": 22, "land": 8, "water": 14}
    assert values["observations"] == {"used": 64, "excluded": 5}
    assert sum(values["residuals"][key]["points"] for key in ("land", "water")) == 22


def test_residuals_before(adjusted):
    """n = 1: straight rays meet at the truth, whatever the survey says of a control point."""
    truth = points()
    start = truth + np.array([0.3, -0.2, 0.4])
    block = make_block(start, pinhole(truth, cameras()), cameras(), 1.0)
    block.image_xy[40] += 25.0  # the outlier, left out
    control = surveyed(len(truth))
    control.xyz[4] = truth[4] + 1.0
    found = residuals_before(replace(adjusted, block=replace(block, control=control)))
    # observations are exact: what is left is Newton's last step, and coordinates of 4e6 m
    assert np.abs(found[adjusted.used]).max() < 1e-4
    assert found[40] == pytest.approx([25.0, 25.0], abs=1e-4)

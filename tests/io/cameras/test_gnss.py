"""Adjusted centres minus GNSS positions."""

import numpy as np
import pytest
from pyproj import CRS, Transformer

from pcfix.io.cameras.georeference import adjusted_minus_gnss
from pcfix.model import Cameras, GnssPositions
from tests.utils.nightly import mostly_nightly
from tests.utils.reprojection import bring_to, check_file
from tests.utils.shared import needs

pytestmark = pytest.mark.quick_but(
    "test_a_camera_where_the_gnss_put_it",
    "test_differences_are_east_north_up",
    "test_heights_that_cannot_be_compared_leave_the_plan",
)

WHEAT, wheat = needs("cameras", "metashape", "easyidp_wheat_psx")

LON, LAT, H = 139.5405, 35.7380, 130.0
ENU_M = np.array([[1.5, -2.0, 0.5], [0.0, 0.25, -3.0], [np.nan] * 3])


def block(crs, gnss_crs, enu_m=ENU_M, height=H, **more):
    """Return cameras in a CRS and GNSS positions that differ from them by ENU_M."""
    to_ecef = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    lam, phi = np.radians([LON, LAT])
    axes = np.array(
        [
            [-np.sin(lam), np.cos(lam), 0],
            [-np.sin(phi) * np.cos(lam), -np.sin(phi) * np.sin(lam), np.cos(phi)],
            [np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)],
        ]
    )
    origin = np.array(to_ecef.transform(LON, LAT, height))
    adjusted = origin + np.array([[0.0, 0, 0], [5.0, 8.0, 1.0], [9.0, -4.0, 0.0]]) @ axes
    measured = adjusted - enu_m @ axes

    def there(ecef, crs):
        if crs.startswith("ENU"):
            return (ecef - origin) @ axes.T
        target = CRS(crs)
        target = target if len(target.axis_info) == 3 else target.to_3d()
        step = Transformer.from_crs("EPSG:4978", target, always_xy=True)
        return np.column_stack(step.transform(*ecef.T))

    gnss = GnssPositions(there(measured, gnss_crs), np.full((3, 3), np.nan), gnss_crs)
    labels = ("a", "b", "c")
    return Cameras(labels, there(adjusted, crs), crs=crs, gnss=gnss, **more)


ENU = f"ENU:{LAT},{LON},{H}"


@pytest.mark.parametrize("gnss", ["EPSG:4326", "EPSG:4979", "EPSG:4978", "EPSG:32654"])
@pytest.mark.parametrize("crs", mostly_nightly(["EPSG:4978", "EPSG:4979", "EPSG:4326", ENU], ENU))
def test_differences_are_east_north_up(crs, gnss):
    found = adjusted_minus_gnss(block(crs, gnss))
    assert found.enu_m == pytest.approx(ENU_M, abs=2e-4, nan_ok=True)
    assert found.reason == ""


def test_in_the_axes_of_a_map():
    read = block("EPSG:4978", "EPSG:4326", project_crs="EPSG:32654")
    found = adjusted_minus_gnss(bring_to(read, "EPSG:32654"))
    gamma = np.arctan(np.tan(np.radians(LON - 141.0)) * np.sin(np.radians(LAT)))
    east, north = ENU_M[:2, :2].T
    turned = np.column_stack(
        [east * np.cos(gamma) - north * np.sin(gamma), east * np.sin(gamma) + north * np.cos(gamma)]
    )
    assert found.enu_m[:2, :2] == pytest.approx(turned, abs=2e-3)  # scale 0.9997 of 3 m
    assert found.enu_m[:2, 2] == pytest.approx(ENU_M[:2, 2], abs=1e-4)
    assert np.isnan(found.enu_m[2]).all()


@wheat
def test_a_camera_where_the_gnss_put_it():
    truth = check_file(WHEAT)["projection_centres"]
    degrees = np.array([[t["X"], t["Y"], t["Z"]] for t in truth])
    gnss = GnssPositions(degrees, np.full(degrees.shape, np.nan), "EPSG:4326")
    read = Cameras(
        tuple(t["image"] for t in truth),
        np.array([t["ECEF"] for t in truth]),
        crs="EPSG:4978",
        project_crs="EPSG:4326",
        gnss=gnss,
    )
    for found in (read, bring_to(read, "EPSG:32654")):
        assert adjusted_minus_gnss(found).enu_m == pytest.approx(0.0, abs=2e-3)


@pytest.mark.parametrize(
    ("crs", "gnss_crs", "reason"),
    [
        ("EPSG:4978", "EPSG:4326+5773", "without the grid us_nga_egm96_15.tif"),
        ("EPSG:32654+5773", "EPSG:4979", "without the grid us_nga_egm96_15.tif"),
        ("EPSG:32654+5773", "EPSG:4326", "the CRS of the GNSS names no vertical datum"),
        ("EPSG:32654", "EPSG:4326+5773", "the CRS of the cameras names no vertical datum"),
    ],
)
def test_heights_that_cannot_be_compared_leave_the_plan(crs, gnss_crs, reason):
    flat = [text.partition("+")[0] for text in (crs, gnss_crs)]
    as_metres = block(flat[0], flat[1])
    read = Cameras(
        as_metres.labels,
        as_metres.centres,
        crs=crs,
        gnss=GnssPositions(as_metres.gnss.xyz, as_metres.gnss.sigma_m, gnss_crs),
    )
    found = adjusted_minus_gnss(read, "a.xml")
    assert found.reason.startswith("a.xml: ")
    assert reason in found.reason
    assert found.reason.endswith("only plan is compared.")
    assert "--cameras-crs" not in found.reason
    assert np.isnan(found.enu_m[:, 2]).all()
    lengths = np.hypot(*found.enu_m[:2, :2].T)
    assert lengths == pytest.approx(np.hypot(*ENU_M[:2, :2].T), rel=5e-4)


@pytest.mark.parametrize("crs", [None, "local"])
def test_a_local_block_cannot_be_compared(crs):
    gnss = GnssPositions(np.array([[LON, LAT, H]]), np.full((1, 3), np.nan), "EPSG:4326")
    found = adjusted_minus_gnss(Cameras(("a",), np.zeros((1, 3)), crs=crs, gnss=gnss), "a.xml")
    assert np.isnan(found.enu_m).all()
    assert "they are not compared" in found.reason

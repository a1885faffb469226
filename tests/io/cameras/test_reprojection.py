"""Every real sample: object points fall where its images saw them, and cameras are where they were.

What is expected stands in the check.json beside each sample: for some observations the residual
that a right reading leaves (`res_px`), for all of the block its RMS, and for some images centre and
view.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from pyproj import Transformer

from pcfix.io.cameras import read_tie_points
from tests.utils.camera_files import read
from tests.utils.geodesy import axes_at
from tests.utils.reprojection import (
    check_file,
    from_upper_left,
    in_geocentric,
    residuals_px,
    row_of,
    tie_point_residuals_px,
)
from tests.utils.shared import needs

pytestmark = pytest.mark.quick_but("test_sample")


@dataclass(frozen=True)
class Sample:
    """How a sample is read, and how its check.json is to be taken.

    `path` is below the sample's folder. `frame` is the CRS of X, Y, Z where the file itself is
    geocentric. `seen` makes observations those of an image from its upper left corner. `apart_px`
    and `distance_m` are how far we may be from what is expected, which is written with few digits.
    `rms_px` is the same for the RMS of all tie points, where the file has them. `images` of
    check.json are those that can be read, where not all can.
    """

    path: str = ""
    options: dict = field(default_factory=dict)
    frame: str | None = None
    seen: Callable = lambda cameras, observations: observations
    shift_px: float = 0.0
    name_of: Callable = lambda image: image
    distorted: bool = True
    apart_px: float = 0.02
    distance_m: float = 2e-4
    rms_px: float | None = None
    images: tuple = ()


SAMPLES = {
    "metashape/uclm_sorolla": Sample("markers_25830-5782.xml", frame="EPSG:25830"),
    "metashape/micasense_rig": Sample("markers_micasenses_rededge.xml", frame="EPSG:25830"),
    # 1e-8 degrees are 1 mm, seen from 30 m
    "metashape/easyidp_wheat_psx": Sample("wheat_tanashi.psx", frame="EPSG:4326", apart_px=0.1),
    "metashape/dbat_camcal_psz": Sample("c4040z.psz", rms_px=1e-3),
    "metashape/bitbyt3r_local93": Sample("cameras.xml"),
    "metashape_opk/sfmrefract": Sample("trajectory.txt", {"sensor": "io/ioP4P.xml"}),
    "pix4d/ca502_oblique5": Sample("params"),
    "pix4d/lod3_amsterdam": Sample(),
    # pmatrix projects without distortion
    "pix4d/easyidp_pix4d_origin": Sample(distorted=False),
    # the map scales in plan alone (0.9996), which no rotation can: in the corners
    "odm/testerarm_sub0": Sample(apart_px=0.06, rms_px=3e-3),
    "odm/hectorsosa": Sample(),
    "odm/orthority_odm": Sample(distance_m=1e-3),
    "opensfm/berlin": Sample(rms_px=1e-3),
    "colmap/ar_boxes": Sample("bin", rms_px=1e-3),
    "colmap/wesley_dense": Sample(rms_px=1e-3),
    # the calibration of the other image is a polynomial, which no lens holds
    "micmac/li3ds": Sample(
        "Orientation-00.xml", name_of=lambda image: image[12:-4], images=("Orientation-00.xml",)
    ),
    "bundler/kermit": Sample("bundle.out", seen=from_upper_left, rms_px=1e-3),
    "bundler/mve_testerarm": Sample("synth_0.out", name_of=lambda image: image.split(" (")[0]),
    "nvm/testerarm_undistorted": Sample("reconstruction.nvm", rms_px=1e-3),
    # pixels from the centre of the first
    "blocksexchange/paris_doc_example": Sample("Paris2012_one_photo.xml", shift_px=0.5),
}
MARKED = [
    pytest.param(name, marks=needs("cameras", *name.split("/"))[1], id=name) for name in SAMPLES
]
# view_dir_approx of a projected chunk is in the axes of the map, up to 1.7 degrees off: 0.06 for
# views that are nearly vertical.
VIEW_DEG, APPROXIMATE_DEG = 1e-3, 0.1


def centre_and_view(told, cameras, given):
    """Return how far a projection centre (m) and its view or top (degrees) are off."""
    i = row_of(cameras, told.name_of(given["image"]))
    centre = given.get("ECEF") or [given[axis] for axis in "XYZ"]
    apart = np.abs(cameras.centres[i] - centre).max()
    rotation = cameras.rotations[i]
    if told.frame is not None:  # in axes east, north, up
        step = Transformer.from_crs(cameras.crs, "EPSG:4979", always_xy=True)
        rotation = rotation @ axes_at(*step.transform(*cameras.centres[i])[:2]).T
    view = given.get("view_dir", given.get("view_dir_approx"))
    pairs = [(rotation[2], view)]
    if "up_dir_minus_cam_y" in given:
        pairs.append((-rotation[1], given["up_dir_minus_cam_y"]))
    off = [np.arctan2(np.linalg.norm(np.cross(*pair)), np.dot(*pair)) for pair in pairs]
    return apart, np.degrees(max(off))


@pytest.mark.parametrize("name", MARKED)
def test_sample(name):
    told, folder = SAMPLES[name], needs("cameras", *name.split("/"))[0]
    check, path = check_file(folder), folder / told.path
    cameras = read(path, **{key: folder / value for key, value in told.options.items()})
    # observations in the frame of the cameras, from the upper left corner
    listed = check.get("observations", [])
    listed = [{**seen, "image": told.name_of(seen["image"])} for seen in listed]
    if told.frame is not None and listed:
        listed = in_geocentric(listed, told.frame, cameras.crs)
    observations = told.seen(cameras, listed)
    if observations:
        taken = cameras
        if not told.distorted:
            ideal = [replace(lens, radial=(), tangential=()) for lens in cameras.lenses]
            taken = replace(cameras, lenses=tuple(ideal))
        found = residuals_px(taken, observations, shift_px=told.shift_px)
        # without res_px u and v are not measured but projected
        expected = np.array([seen.get("res_px", 0.0) for seen in observations])
        assert found == pytest.approx(expected, abs=told.apart_px)
    if told.rms_px is not None:
        every = tie_point_residuals_px(cameras, read_tie_points(path, cameras))
        assert len(every) == check["n_observations_used_for_rms"]
        rms = np.sqrt(np.mean(np.square(every)))
        assert rms == pytest.approx(check["reprojection_rms_px"], abs=told.rms_px)
    offs = [
        centre_and_view(told, cameras, given)
        for given in check["projection_centres"]
        if not told.images or given["image"] in told.images
    ]
    distance_m, turned_deg = np.max(offs, axis=0)
    assert distance_m < told.distance_m
    rough = "view_dir_approx" in check["projection_centres"][0]
    assert turned_deg < (APPROXIMATE_DEG if rough else VIEW_DEG)


def test_no_sample_is_left_out():
    folder, _ = needs("cameras")
    there = {f"{p.parent.parent.name}/{p.parent.name}" for p in folder.glob("*/*/check.json")}
    assert there <= set(SAMPLES)

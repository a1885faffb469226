"""Judge a camera reader by what it is for: object points must fall where the images saw them."""

import json
from pathlib import PurePath

import numpy as np
from pyproj import CRS, Transformer

from pcfix.io.cameras.georeference import georeference
from pcfix.lens.imaging import project


def bring_to(cameras, cloud_crs, **options):
    """Return cameras in the CRS of a cloud."""
    return georeference(cameras, cloud_crs, **options).cameras(cameras)


def check_file(sample):
    """Return check.json of a sample folder."""
    return json.loads((sample / "check.json").read_text())


def row_of(cameras, image):
    """Return the row of an image, whether or not its label has a file extension."""
    names = list(cameras.labels)
    if image in names:
        return names.index(image)
    stems = [PurePath(name).stem for name in names]
    return stems.index(PurePath(image).stem)


def residuals_px(cameras, observations, *, shift_px=0.0):
    """Return the distance in the image between projection and observation, one per observation.

    `shift_px` is added to the observed u and v, for files whose pixels start at the centre of
    the first pixel (0.5).
    """
    misses = []
    for seen in observations:
        i = row_of(cameras, seen["image"])
        point = np.array([seen["X"], seen["Y"], seen["Z"]])
        ray = cameras.rotations[i] @ (point - cameras.centres[i])
        u, v = project(cameras.lenses[i], ray[None])[0]
        misses.append(np.hypot(u - seen["u"] - shift_px, v - seen["v"] - shift_px))
    return np.array(misses)


def tie_point_residuals_px(cameras, ties):
    """Return the same for every observation of a sparse model whose point has a position."""
    point = np.repeat(np.arange(len(ties.xyz)), np.diff(ties.views.start))
    known = np.isfinite(ties.xyz[point]).all(axis=1)
    misses = []
    for i, (rotation, centre) in enumerate(zip(cameras.rotations, cameras.centres, strict=True)):
        mine = known & (ties.views.camera == i)
        rays = (ties.xyz[point[mine]] - centre) @ rotation.T
        misses.append(np.hypot(*(project(cameras.lenses[i], rays) - ties.image_xy[mine]).T))
    return np.concatenate(misses)


def in_geocentric(observations, crs, geocentric_crs):
    """Return observations with X, Y, Z, ellipsoidal heights in `crs`, in geocentric axes."""
    step = Transformer.from_crs(CRS(crs).to_3d(), geocentric_crs, always_xy=True)
    places = [step.transform(*(seen[axis] for axis in "XYZ")) for seen in observations]
    return [
        {**seen, **dict(zip("XYZ", xyz, strict=True))}
        for seen, xyz in zip(observations, places, strict=True)
    ]


def from_upper_left(cameras, observations):
    """Return observations whose u and v are from the middle of the frame, y up (Bundler)."""
    lenses = [cameras.lenses[row_of(cameras, seen["image"])] for seen in observations]
    return [
        {**seen, "u": lens.width / 2.0 + seen["u"], "v": lens.height / 2.0 - seen["v"]}
        for seen, lens in zip(observations, lenses, strict=True)
    ]

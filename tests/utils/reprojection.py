"""Judge a camera reader by what it is for: object points must fall where the images saw them."""

import json
from pathlib import PurePath

import numpy as np

from pcfix.refract.lens import project


def check_file(sample):
    """Return check.json of a sample folder."""
    return json.loads((sample / "check.json").read_text())


def row_of(cameras, image):
    """Return the row of an image, whether or not its label has a file extension."""
    names = [label for label in cameras.labels]
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

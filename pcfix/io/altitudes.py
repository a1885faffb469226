"""Read how high drones flew above their take-off place, as they recorded it in their images.

DJI's XMP has ``drone-dji:RelativeAltitude`` (metres, by the barometer); Metashape stores it in its
projects, as the property ``DJI/RelativeAltitude`` of each image.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras.metashape.documents import open_chunk
from pcfix.io.labels import match_labels
from pcfix.model import FloatArray
from pcfix.options.declare import File

IMAGES = (".jpg", ".jpeg", ".dng", ".tif", ".tiff")
FOLDERS = ("", "images")
"""Where images lie, relative to the folder of the camera file."""
MOST_IMAGES, HEAD_BYTES = 30, 2**17
_ABOVE = re.compile(rb"RelativeAltitude(?:=[\"']|>)\s*([+-]?\d+(?:\.\d*)?)")


def read_altitudes(cameras: File, labels: Sequence[str]) -> FloatArray:
    """Return how high each image was taken above the take-off place, shape (k,), metres.

    NaN where it is not recorded. At most `MOST_IMAGES` images near the camera file are read.
    """
    altitudes, path, found = np.full(len(labels), np.nan), Path(cameras), {}
    with suppress(OSError, InputError):  # no correction needs them
        if path.suffix.lower() == ".psx":
            chunk = open_chunk(path).document
            names = {camera.get("id"): camera.get("label") for camera in chunk.root.iter("camera")}
            for frame in chunk.root.iterfind("frames/frame"):
                for camera in chunk.follow(frame).root.iter("camera"):
                    for entry in camera.iter("property"):
                        label = names.get(camera.get("camera_id"))
                        if entry.get("name") == "DJI/RelativeAltitude" and label:
                            with suppress(ValueError):
                                found[label] = float(entry.get("value", ""))
        else:
            root = path if path.is_dir() else path.parent
            inside = [one for name in FOLDERS for one in sorted(root.joinpath(name).glob("*"))]
            images = [one for one in inside if one.suffix.lower() in IMAGES and one.is_file()]
            for image in images[:: 1 + len(images) // MOST_IMAGES]:
                with image.open("rb") as stream:
                    if above := _ABOVE.search(stream.read(HEAD_BYTES)):
                        found[image.name] = float(above[1])
        row = match_labels(list(found), labels, one_to_one=False).row
        altitudes[row[row >= 0]] = np.array(list(found.values()))[row >= 0]
    return altitudes

"""OpenSfM: reconstruction.json, and tracks.csv next to it.

The file is a list of reconstructions, each with `cameras`, `shots` and `points`. A shot's
`rotation` (axis times angle, radians) and `translation` take world to camera, x right, y down, z
forward, so the projection centre is -R't. The world is topocentric, metres east, north and up at
`reference_lla`, which is in the reconstruction or in reference_lla.json; `gps_position` is in
the same frame, `gps_dop` its standard deviation in metres. Without a reference the frame is local.
Coordinates too large to be topocentric come from ``export_geocoords --reconstruction``; that file
does not name its CRS.

A line of tracks.csv is image, track, feature, x, y and more that differs between the versions (0
without a header, 1 and 2 with one): scale, colour, segmentation. x and y are image coordinates
divided by the larger side, the origin in the image centre.

Of the interior orientation, `focal`, `focal_x`, `focal_y`, `c_x` and `c_y` are in units of the
larger side too, from the centre of the image. The tangential terms follow OpenCV (p1 with 2 x y in
x). Distortion acts on the projected coordinates, which are angles for the fisheye models.

References: "Reconstruction file" and "Coordinate Systems" in the manual, https://opensfm.org/docs.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pcfix.io.cameras import checks
from pcfix.io.cameras.lenses import LensModel, lens_by_name
from pcfix.io.labels import unnamed
from pcfix.lens.rotations import from_rotation_vectors
from pcfix.model import Cameras, FloatArray, IntArray, Lens, TiePoints

_KEYS = "cameras|shots|points|pano_shots|reference_lla|biases|rig_cameras|rig_instances"
HEAD = re.compile(rf'\[\s*\{{\s*"({_KEYS})"\s*:\s*\{{')
NO_GNSS = 999999.0
"""The gps_dop that OpenSfM writes for an image without a position."""


class Reconstruction(NamedTuple):
    """The largest reconstruction of a file, in the frame of the file.

    `cameras` and their `gnss` are topocentric at `reference`, else local. `reference` is latitude
    and longitude in degrees and the height in metres of the topocentric origin; None if the file
    has none, or the zeros that OpenSfM writes for images without positions.
    """

    path: Path
    cameras: Cameras
    reference: tuple[float, float, float] | None
    points: dict[str, Any]


def read_reconstruction(path: Path) -> Reconstruction:
    """Read the reconstruction with the most images."""
    data = checks.load_json(path)
    with checks.reading(path):
        sets = [entry.get("shots", {}) for entry in data]
        chosen, shots = max(zip(data, sets, strict=True), key=lambda two: len(two[1]))
        others = [name for some in sets if some is not shots for name in some]
        checks.warn_several(path, len(data) if others else 1, len(shots))
        if not shots:
            raise checks.no_pose(path)
        used = dict.fromkeys(shot["camera"] for shot in shots.values())
        lenses = {name: lens(path, name, chosen["cameras"][name]) for name in used}
        turns = np.array([checks.triple(shot["rotation"]) for shot in shots.values()])
        rotations = from_rotation_vectors(turns)
        shifts = np.array([checks.triple(shot["translation"]) for shot in shots.values()])
        places = {}
        for label, shot in shots.items():
            position, dop = shot.get("gps_position"), shot.get("gps_dop")
            if position is not None and dop != NO_GNSS:
                places[label] = position, [np.nan if dop is None else dop] * 3
        origin, beside = chosen.get("reference_lla"), path.with_name("reference_lla.json")
        if origin is None and beside.is_file() and beside.read_bytes()[:100].lstrip()[:1] == b"{":
            origin = checks.load_json(beside)
        reference = None
        if origin is not None:
            lat, lon, alt = (float(origin[key]) for key in ("latitude", "longitude", "altitude"))
            if not (abs(lat) <= 90.0 and abs(lon) <= 360.0 and abs(alt) < np.inf):
                raise checks.damaged(path, f"reference_lla {lat:g}, {lon:g} is no place on earth")
            reference = None if lat == lon == 0.0 else (lat, lon, alt)
        crs = "local" if reference is None else "ENU:" + ",".join(map(repr, reference))
        cameras = Cameras(
            labels=tuple(shots),
            centres=checks.centres(rotations, shifts),
            rotations=rotations,
            lenses=tuple(lenses[shot["camera"]] for shot in shots.values()),
            crs=crs,
            gnss=checks.measured([*shots], places, crs) if reference else None,
            unposed=unnamed(others, shots),
        )
        return Reconstruction(path, cameras, reference, chosen.get("points", {}))


CHUNK_BYTES = 1 << 24


def read_tie_points(reconstruction: Reconstruction) -> TiePoints:
    """Return the points in the frame of the file, and where its images saw them."""
    path, cameras, _, points = reconstruction
    beside = path.with_name("tracks.csv")
    if not points or not beside.is_file():
        why = "it has no points" if not points else "there is no tracks.csv next to it"
        raise checks.no_tie_points(path, why)
    xyz = np.array([point["coordinates"] for point in points.values()], float).reshape(-1, 3)
    camera_of, point_of = (
        {name.encode(errors="replace"): i for i, name in enumerate(names)}
        for names in (cameras.labels, points)
    )
    parts: list[tuple[IntArray, IntArray, FloatArray]] = []
    with checks.reading(beside), beside.open("rb") as stream:
        while block := stream.readlines(CHUNK_BYTES):  # there can be many millions of lines
            lines = [line.split(b"\t", 5) for line in block if line.count(b"\t")]
            point = np.array([point_of.get(fields[1], -1) for fields in lines], dtype=np.int64)
            camera = np.array([camera_of.get(fields[0], -1) for fields in lines], dtype=np.int64)
            values = np.array([fields[3:5] for fields in lines], dtype=float).reshape(-1, 2)
            known = (point >= 0) & (camera >= 0)
            parts.append((point[known], camera[known], values[known]))
    if not parts:
        raise checks.damaged(beside, "it is empty")
    point, camera, xy = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.lexsort((camera, point))
    size = np.array([(lens.width, lens.height) for lens in cameras.lenses or ()])[camera]
    uv = xy * size.max(axis=1, initial=0.0)[:, None] + size / 2.0
    return checks.tie_points(checks.Observations(xyz, point[order], camera[order], uv[order]))


_MODELS = {
    "perspective": LensModel("f k1 k2"),
    "simple_radial": LensModel("fx fy cx cy k1"),
    "radial": LensModel("fx fy cx cy k1 k2"),
    "brown": LensModel("fx fy cx cy k1 k2 k3 p2 p1"),
    "fisheye": LensModel("f k1 k2", "equidistant"),
    "fisheye_opencv": LensModel("fx fy cx cy k1 k2 k3 k4", "equidistant"),
    "fisheye62": LensModel("fx fy cx cy k1 k2 k3 k4 k5 k6 p2 p1", "equidistant"),
    "fisheye624": LensModel("fx fy cx cy k1 k2 k3 k4 k5 k6 p2 p1 s1 s2 s3 s4", "equidistant"),
    "dual": LensModel("f k1 k2 transition", "dual"),
}
"""By names of `lenses`; not every version of OpenSfM knows simple_radial and radial."""
_NAMES = {"f": "focal", "fx": "focal_x", "fy": "focal_y", "cx": "c_x", "cy": "c_y"}
_NAMES |= {"p1": "p2", "p2": "p1", "s1": "s0", "s2": "s1", "s3": "s2", "s4": "s3"}
"""What OpenSfM calls what has another name in `lenses`."""


def lens(path: Path, name: str, camera: dict[str, Any]) -> Lens:
    """Return the lens of an entry of `cameras`."""
    model = str(camera.get("projection_type", "perspective"))
    if model not in _MODELS:
        remedy = f"Remove its images, or use one of {', '.join(_MODELS)}"
        what = f"the projection_type '{model}' of camera {name}"
        raise checks.unsupported(path, what, remedy, model=model, camera=name)

    def value(key: str, default: float = 0.0) -> float:
        return float(camera.get(key, default))

    width, height = value("width"), value("height")
    if not (width and height):
        raise checks.damaged(path, f"the width and height of camera {name} are missing")
    scale = max(width, height)
    given = {one: value(_NAMES.get(one, one)) for one in _MODELS[model].names.split()}
    if "transition" in given:
        given["transition"] = value("transition", 0.5)
    across = float(camera["focal_x" if "focal_x" in camera else "focal"])
    down = value("focal_y", across) if "focal_x" in camera else across
    given |= {"fx": across * scale, "fy": down * scale}
    given |= {"cx": width / 2.0 + value("c_x") * scale, "cy": height / 2.0 + value("c_y") * scale}
    projection = _MODELS[model].projection
    return lens_by_name(given, width, height, projection=projection, sensor=name)

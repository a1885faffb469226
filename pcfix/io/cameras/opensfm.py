"""OpenSfM: reconstruction.json, and tracks.csv next to it.

The file is a list of reconstructions, each with `cameras`, `shots` and `points`. A shot's
`rotation` (axis times angle, radians) and `translation` take world to camera, x right, y down, z
forward, so the projection centre is -R't. The world is topocentric, metres east, north and up at
`reference_lla`, which is in the reconstruction or in reference_lla.json; `gps_position` is in
the same frame, `gps_dop` its standard deviation in metres. Without a reference the frame is local.
Where a shot rides on a rig and has no pose of its own, it is that of the rig camera (rig to
camera) after that of the rig instance (world to rig). Coordinates too large to be topocentric come
from ``export_geocoords --reconstruction``; that file does not name its CRS.

A line of tracks.csv is image, track, feature, x, y and more that differs between the versions (0
without a header, 1 and 2 with one): scale, colour, segmentation. x and y are image coordinates
divided by the larger side, the origin in the image centre.

Of the interior orientation, `focal`, `focal_x`, `focal_y`, `c_x` and `c_y` are in units of the
larger side too, from the centre of the image. The tangential terms follow OpenCV (p1 with 2 x y in
x). Distortion acts on the projected coordinates, which are angles for the fisheye models.

References: "Reconstruction file", "Coordinate Systems" and "Rig Models" in the manual,
https://opensfm.org/docs.
"""

from __future__ import annotations

import re
from pathlib import Path, PurePath
from typing import Any, NamedTuple

import numpy as np

from pcfix.io.cameras import checks
from pcfix.io.cameras.lenses import LensModel, lens_by_name
from pcfix.io.labels import unnamed
from pcfix.io.tables import read_lines
from pcfix.lens.rotations import from_rotation_vectors
from pcfix.model import Cameras, FloatArray, IntArray, Lens, TiePoints

_KEYS = "cameras|shots|points|pano_shots|reference_lla|biases|rig_cameras|rig_instances"
HEAD = re.compile(rf'\[\s*\{{\s*"({_KEYS})"\s*:\s*\{{')
NO_GNSS = 999999.0
"""The gps_dop that OpenSfM writes for an image without a position."""


class Reconstruction(NamedTuple):
    """What the largest reconstruction of a file holds, in the frame of the file.

    `cameras` and their `gnss` are topocentric at `reference`, else local. `reference` is latitude
    and longitude in degrees and the height in metres of the topocentric origin; None where the file
    has none, or the made-up one that OpenSfM gives to images without positions.
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
        chosen, all_shots = max(zip(data, sets, strict=True), key=lambda two: len(two[1]))
        entries, notes = chosen["cameras"], []
        shots = {k: v for k, v in all_shots.items() if not is_panorama(entries[v["camera"]])}
        panoramas = [k for k in all_shots if k not in shots]
        others = [name for some in sets if some is not all_shots for name in some]
        if others:
            notes.append(checks.several(path, len(data), len(all_shots)))
        if panoramas:
            sentence = f"{len(panoramas)} images of spherical cameras are skipped."
            notes.append(checks.note(path, "cameras.panoramas", sentence, images=panoramas))
        if not shots:
            raise checks.no_pose(path)
        lenses = {k: lens(path, k, entries[k]) for k in {shot["camera"] for shot in shots.values()}}
        on_rig = {  # the pose of the rig in the world, then that of the camera on the rig
            label: (instance, chosen.get("rig_cameras", {}).get(str(camera)))
            for instance in chosen.get("rig_instances", {}).values()
            for label, camera in instance.get("rig_camera_ids", {}).items()
        }
        poses = [
            _pose(shot) if "rotation" in shot else _pose(*on_rig.get(label, (shot,)))
            for label, shot in shots.items()
        ]
        rotations, shifts = (np.array(each) for each in zip(*poses, strict=True))
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
        listed = path.with_name("image_list.txt")  # the images that the project was given
        lines = read_lines(listed) if listed.is_file() else []
        given = [PurePath(line.strip().replace("\\", "/")).name for line in lines if line.strip()]
        cameras = Cameras(
            labels=tuple(shots),
            centres=checks.centres(rotations, shifts),
            rotations=rotations,
            lenses=tuple(lenses[shot["camera"]] for shot in shots.values()),
            crs=crs,
            notes=tuple(notes),
            gnss=checks.measured([*shots], places, crs) if reference else None,
            unposed=unnamed([*others, *panoramas, *given], shots),
            source="OpenSfM",
        )
        return Reconstruction(path, cameras, reference, chosen.get("points", {}))


def _pose(*parts: Any) -> tuple[FloatArray, FloatArray]:
    """Return R and t, x_camera = R x + t, of one pose after the other."""
    rotation, shift = np.eye(3), np.zeros(3)
    for part in parts:
        turn = from_rotation_vectors(checks.triple(part["rotation"]))
        rotation, shift = turn @ rotation, turn @ shift + checks.triple(part["translation"])
    return rotation, shift


HEADER = b"OPENSFM_TRACKS_VERSION"
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
            lines = [line.split(b"\t", 5) for line in block if line.strip()]
            lines = lines[1:] if not parts and block[0].startswith(HEADER) else lines
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
    return checks.tie_points(checks.Seen(xyz, point[order], camera[order], uv[order]))


PANORAMAS = frozenset({"equirectangular", "spherical"})

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
_SIZE = re.compile(r" (\d{2,6}) (\d{2,6}) [a-z_]+\d* ")


def is_panorama(camera: dict[str, Any]) -> bool:
    """Whether a camera sees all around, which no plane image with a frame can hold."""
    return str(camera.get("projection_type")) in PANORAMAS


def lens(path: Path, name: str, camera: dict[str, Any]) -> Lens:
    """Return the lens of an entry of `cameras`."""
    model = str(camera.get("projection_type", "perspective"))
    if model not in _MODELS:
        remedy = f"Use one of {', '.join(_MODELS)}"
        what = f"the projection_type '{model}' of camera {name}"
        raise checks.unsupported(path, what, remedy, model=model, camera=name)

    def value(key: str, default: float = 0.0) -> float:
        return float(camera.get(key, default))

    width, height = value("width"), value("height")
    named = _SIZE.search(name)  # the size, in old files
    if not (width and height) and named:
        width, height = float(named[1]), float(named[2])
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

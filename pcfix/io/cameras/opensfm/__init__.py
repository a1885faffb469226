"""OpenSfM: reconstruction.json, and tracks.csv beside it.

The file is a list of reconstructions, each with `cameras`, `shots` and `points`. A shot's
`rotation` (axis times angle, radians) and `translation` take world to camera, x right, y down, z
forward, so the projection centre is -R't. The world is topocentric, metres east, north and up at
`reference_lla`, which stands in the reconstruction or in reference_lla.json; `gps_position` is in
the same frame, `gps_dop` its standard deviation in metres. Without a reference the frame is local.
Where a shot rides on a rig and has no pose of its own, it is that of the rig camera (rig to
camera) after that of the rig instance (world to rig). Coordinates too large to be topocentric come
from ``export_geocoords --reconstruction``; that file does not name its CRS.

A line of tracks.csv is image, track, feature, x, y and more that differs between the versions (0
without a header, 1 and 2 with one): scale, colour, segmentation. x and y are image coordinates
divided by the larger side, the origin in the image centre.

References: "Reconstruction file", "Coordinate Systems" and "Rig Models" in the manual,
https://opensfm.org/docs.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path, PurePath
from typing import IO, Any, NamedTuple

import numpy as np

from pcfix.errors import InputError, NoTiePointsError
from pcfix.io.cameras import tracks
from pcfix.io.cameras.checks import json_number, load_json, mapping, rows, vector
from pcfix.io.cameras.formats import Source
from pcfix.io.cameras.opensfm.models import is_panorama, lens
from pcfix.lens.rotations import from_rotation_vectors
from pcfix.model import Cameras, FloatArray, GnssPositions, IntArray, TiePoints

TOPOCENTRIC_LIMIT_M = 1e5

_KEYS = "cameras|shots|points|pano_shots|reference_lla|biases|rig_cameras|rig_instances"
_HEAD = re.compile(rf'\[\s*\{{\s*"({_KEYS})"\s*:\s*\{{')


def recognises(source: Source) -> bool:
    """Whether a file begins as a list of reconstructions, or a folder holds one by name."""
    if source.path.is_dir():
        return "reconstruction.json" in source.names
    return _HEAD.match(source.text.lstrip()) is not None


def read(source: Source) -> Cameras:
    """Read the poses of the largest reconstruction."""
    cameras = read_reconstruction(_file(source)).cameras
    absolute = np.abs(np.median(cameras.centres[:, :2], axis=0)).max() > TOPOCENTRIC_LIMIT_M
    return replace(cameras, crs=None) if absolute else cameras


def tie_points(source: Source, cameras: Cameras) -> TiePoints:
    """Read points and tracks."""
    return read_tie_points(read_reconstruction(_file(source)))


def _file(source: Source) -> Path:
    return source.path / "reconstruction.json" if source.path.is_dir() else source.path


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
    chosen, others, notes = _largest(path, load_json(path))
    entries = mapping(path, "cameras", chosen.get("cameras"))
    shots, panoramas = _usable(path, chosen["shots"], entries)
    if panoramas:
        notes.append(
            f"{path}: {len(panoramas)} images of all-round cameras (spherical) are left out; pcfix"
            " needs images with a frame."
        )
    names = {shot["camera"] for shot in shots.values()}
    lenses = {name: lens(path, name, entries[name]) for name in names}
    rotations, centres = _poses(path, chosen, shots)
    xyz, sigma = _gnss(path, shots)
    reference = _reference(path, chosen)
    crs = "local" if reference is None else "ENU:" + ",".join(map(repr, reference))
    has_gnss = reference is not None and np.isfinite(xyz).any()
    cameras = Cameras(
        labels=tuple(shots),
        centres=centres,
        rotations=rotations,
        lenses=tuple(lenses[shot["camera"]] for shot in shots.values()),
        crs=crs,
        notes=tuple(notes),
        gnss=GnssPositions(xyz, sigma, crs) if has_gnss else None,
        unposed=left_out(shots, [*others, *panoramas, *_listed(path)]),
        source="OpenSfM",
    )
    return Reconstruction(
        path, cameras, reference, mapping(path, "points", chosen.get("points", {}))
    )


def left_out(labels: Iterable[str], others: Iterable[str]) -> tuple[str, ...]:
    """Return the names among `others` that no label has, with or without the file extension."""
    known = {name for label in labels for name in (label, PurePath(label).stem)}
    names = dict.fromkeys(others)
    return tuple(n for n in names if n not in known and PurePath(n).stem not in known)


def _largest(path: Path, data: Any) -> tuple[dict[str, Any], list[str], list[str]]:
    """Return the largest reconstruction, the images of the others, and what to say of them."""
    if not isinstance(data, list) or not all(isinstance(entry, dict) for entry in data):
        raise InputError(f"{path}: is not a list of reconstructions as OpenSfM writes it.")
    sets = [mapping(path, "shots", entry.get("shots", {})) for entry in data]
    counts = [len(shots) for shots in sets]
    if not any(counts):
        raise InputError(f"{path}: has no images with a pose; run the reconstruction first.")
    best = counts.index(max(counts))
    others = [name for i, shots in enumerate(sets) if i != best for name in shots]
    if not others:
        return data[best], [], []
    note = (
        f"{path}: holds {len(data)} reconstructions that are not connected; the largest, with"
        f" {counts[best]} images, is read, {len(others)} images of the others are left out."
    )
    return data[best], others, [note]


def _usable(
    path: Path, shots: dict[str, Any], cameras: dict[str, Any]
) -> tuple[dict[str, dict[str, Any]], list[str]]:
    """Return the shots whose camera pcfix can use, and the names of those that see all around."""
    usable, panoramas = {}, []
    for label, value in shots.items():
        shot = mapping(path, f"image {label}", value)
        name = shot.get("camera")
        if not isinstance(name, str) or name not in cameras:
            raise InputError(
                f"{path}: image {label}: its camera '{name}' is not among the cameras."
            )
        if is_panorama(mapping(path, f"camera {name}", cameras[name])):
            panoramas.append(label)
        else:
            usable[label] = shot
    if not usable:
        raise InputError(
            f"{path}: all images are of all-round cameras (spherical), which pcfix cannot use;"
            " cut them into perspective images before the reconstruction."
        )
    return usable, panoramas


def _poses(
    path: Path, chosen: dict[str, Any], shots: dict[str, dict[str, Any]]
) -> tuple[FloatArray, FloatArray]:
    """Return rotations and centres; x_camera = R x + t."""
    riders = _riders(path, chosen)
    pairs = [
        _pose(path, f"image {label}", shot)
        if "rotation" in shot or label not in riders
        else _on_rig(path, label, chosen, *riders[label])
        for label, shot in shots.items()
    ]
    rotations, shifts = (np.array(each) for each in zip(*pairs, strict=True))
    return rotations, -np.einsum("kji,kj->ki", rotations, shifts)


def _pose(path: Path, where: str, value: Any) -> tuple[FloatArray, FloatArray]:
    """Return R and t of an entry with an axis-angle rotation."""
    entry = mapping(path, where, value)
    turn = vector(path, f"{where}, rotation", entry.get("rotation"), 3)
    shift = vector(path, f"{where}, translation", entry.get("translation"), 3)
    return from_rotation_vectors(turn), shift


def _riders(path: Path, chosen: dict[str, Any]) -> dict[str, tuple[str, str]]:
    """Return rig instance and rig camera of every image that rides on a rig."""
    riders = {}
    for name, value in mapping(path, "rig_instances", chosen.get("rig_instances", {})).items():
        where = f"rig instance {name}"
        ids = mapping(path, where, value).get("rig_camera_ids", {})
        for label, camera in mapping(path, f"{where}, rig_camera_ids", ids).items():
            riders[label] = (name, str(camera))
    return riders


def _on_rig(
    path: Path, label: str, chosen: dict[str, Any], instance: str, camera: str
) -> tuple[FloatArray, FloatArray]:
    """Return the pose of an image from those of its rig in the world and its camera on the rig."""
    on = mapping(path, "rig_cameras", chosen.get("rig_cameras", {}))
    if camera not in on:
        raise InputError(f"{path}: image {label}: its rig camera '{camera}' is not in the file.")
    rig_r, rig_t = _pose(path, f"rig instance {instance}", chosen["rig_instances"][instance])
    turn, shift = _pose(path, f"rig camera {camera}", on[camera])
    return turn @ rig_r, turn @ rig_t + shift


def _gnss(path: Path, shots: dict[str, dict[str, Any]]) -> tuple[FloatArray, FloatArray]:
    """Return positions and their standard deviation, NaN where an image has none."""
    xyz, sigma = np.full((2, len(shots), 3), np.nan)
    for i, (label, shot) in enumerate(shots.items()):
        dop = shot.get("gps_dop")
        if shot.get("gps_position") is None or dop == NO_GNSS:
            continue
        xyz[i] = vector(path, f"image {label}, gps_position", shot["gps_position"], 3)
        if dop is not None:
            sigma[i] = json_number(path, f"image {label}, gps_dop", dop)
    return xyz, sigma


def _reference(path: Path, chosen: dict[str, Any]) -> tuple[float, float, float] | None:
    """Return latitude, longitude, height of the origin, from the file or the one beside it."""
    entry = chosen.get("reference_lla")
    beside = path.with_name("reference_lla.json")
    if entry is None and beside.is_file() and beside.read_bytes()[:100].lstrip()[:1] == b"{":
        path, entry = beside, load_json(beside)
    if entry is None:
        return None
    entry = mapping(path, "reference_lla", entry)
    keys = ("latitude", "longitude", "altitude")
    lat, lon, alt = rows(path, "reference_lla", [[entry.get(k) for k in keys]], 3)[0]
    if abs(lat) > 90.0 or abs(lon) > 360.0:
        raise InputError(f"{path}: reference_lla: {lat:g}, {lon:g} is no latitude and longitude.")
    return None if lat == lon == 0.0 else (float(lat), float(lon), float(alt))


def _listed(path: Path) -> list[str]:
    """Return the images that the project was given, where it has kept the list."""
    listed = path.with_name("image_list.txt")
    if not listed.is_file():
        return []
    lines = listed.read_text("utf-8", errors="replace").splitlines()
    return [PurePath(line.strip().replace("\\", "/")).name for line in lines if line.strip()]


HEADER = b"OPENSFM_TRACKS_VERSION"
CHUNK_BYTES = 1 << 24


def read_tie_points(reconstruction: Reconstruction) -> TiePoints:
    """Return the points in the frame of the file, and where its images saw them."""
    path, cameras, _, points = reconstruction
    if not points:
        raise NoTiePointsError(f"{path}: has no tie points.")
    beside = path.with_name("tracks.csv")
    if not beside.is_file():
        raise NoTiePointsError(
            f"{path}: there is no tracks.csv beside it, so its tie points have no rays."
        )
    entries = [mapping(path, f"point {k}", v).get("coordinates") for k, v in points.items()]
    xyz = rows(path, "coordinates of a point", entries, 3)
    point, camera, xy = _observations(beside, list(points), cameras.labels)
    order = np.lexsort((camera, point))
    size = np.array([(lens.width, lens.height) for lens in cameras.lenses or ()])[camera]
    uv = xy * size.max(axis=1, initial=0.0)[:, None] + size / 2.0
    return tracks.tie_points(xyz, point[order], camera[order], uv[order])


def _observations(
    path: Path, points: list[str], labels: tuple[str, ...]
) -> tuple[IntArray, IntArray, FloatArray]:
    """Return point row, camera row and normalised x, y of every line that has both."""
    camera_of, point_of = (
        {name.encode(errors="replace"): i for i, name in enumerate(names)}
        for names in (labels, points)
    )
    parts = []
    with path.open("rb") as stream:
        for block in _blocks(stream):
            lines = [line.split(b"\t", 5) for line in block.split(b"\n") if line.strip()]
            short = next((fields for fields in lines if len(fields) < 5), None)
            if short is not None:
                raise InputError(
                    f"{path}: the line beginning '{short[0][:40].decode(errors='replace')}' is cut"
                    " off; copy the file again."
                )
            point = np.array([point_of.get(fields[1], -1) for fields in lines], dtype=np.int64)
            camera = np.array([camera_of.get(fields[0], -1) for fields in lines], dtype=np.int64)
            try:
                values = [float(value) for fields in lines for value in fields[3:5]]
            except ValueError as error:
                raise InputError(
                    f"{path}: x or y of an observation is not a number ({error})."
                ) from error
            if not np.isfinite(values).all():
                raise InputError(f"{path}: x or y of an observation is not finite.")
            keep = (point >= 0) & (camera >= 0)
            parts.append((point[keep], camera[keep], np.array(values).reshape(-1, 2)[keep]))
    if not parts:
        raise InputError(f"{path}: is empty.")
    point, camera, xy = (np.concatenate(column) for column in zip(*parts, strict=True))
    return point, camera, xy


def _blocks(stream: IO[bytes]) -> Iterator[bytes]:
    """Yield whole lines in blocks, without the header."""
    rest = stream.readline()
    if rest.startswith(HEADER):
        rest = b""
    while chunk := stream.read(CHUNK_BYTES):
        whole, newline, tail = (rest + chunk).rpartition(b"\n")
        if newline:
            yield whole
        rest = tail
    if rest.strip():
        yield rest

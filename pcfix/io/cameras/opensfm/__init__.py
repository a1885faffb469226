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
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path, PurePath
from typing import Any, NamedTuple

import numpy as np

from pcfix.io.cameras import checks, tracks
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
    data = checks.load_json(path)
    with checks.reading(path):
        sets = [entry.get("shots", {}) for entry in data]
        counts = [len(shots) for shots in sets]
        if not any(counts):
            raise checks.no_pose(path)
        best = counts.index(max(counts))
        chosen, notes = data[best], []
        others = [name for i, shots in enumerate(sets) if i != best for name in shots]
        if others:
            notes.append(checks.several(path, len(data), counts[best]))
        entries = chosen["cameras"]
        panoramas = [k for k, shot in sets[best].items() if is_panorama(entries[shot["camera"]])]
        shots = {k: shot for k, shot in sets[best].items() if k not in set(panoramas)}
        if panoramas:
            sentence = f"{len(panoramas)} images of all-round cameras are left out."
            notes.append(checks.note(path, "cameras.panoramas", sentence, images=panoramas))
        if not shots:
            raise checks.no_pose(path, "all images are of all-round cameras (spherical)")
        lenses = {k: lens(path, k, entries[k]) for k in {shot["camera"] for shot in shots.values()}}
        rotations, shifts = _poses(chosen, shots)
        xyz, sigma = np.full((2, len(shots), 3), np.nan)
        for i, shot in enumerate(shots.values()):
            dop = shot.get("gps_dop")
            if shot.get("gps_position") is not None and dop != NO_GNSS:
                xyz[i] = checks.triple(shot["gps_position"])
                sigma[i] = np.nan if dop is None else dop
        reference = _reference(path, chosen)
        crs = "local" if reference is None else "ENU:" + ",".join(map(repr, reference))
        has_gnss = reference is not None and np.isfinite(xyz).any()
        listed = path.with_name("image_list.txt")  # the images that the project was given
        lines = checks.read_text(listed).splitlines() if listed.is_file() else []
        given = [PurePath(line.strip().replace("\\", "/")).name for line in lines if line.strip()]
        cameras = Cameras(
            labels=tuple(shots),
            centres=checks.centres(rotations, shifts),
            rotations=rotations,
            lenses=tuple(lenses[shot["camera"]] for shot in shots.values()),
            crs=crs,
            notes=tuple(notes),
            gnss=GnssPositions(xyz, sigma, crs) if has_gnss else None,
            unposed=left_out(shots, [*others, *panoramas, *given]),
            source="OpenSfM",
        )
        return Reconstruction(path, cameras, reference, chosen.get("points", {}))


def left_out(labels: Iterable[str], others: Iterable[str]) -> tuple[str, ...]:
    """Return the names among `others` that no label has, with or without the file extension."""
    known = {name for label in labels for name in (label, PurePath(label).stem)}
    names = dict.fromkeys(others)
    return tuple(n for n in names if n not in known and PurePath(n).stem not in known)


def _poses(chosen: Any, shots: dict[str, Any]) -> tuple[FloatArray, FloatArray]:
    """Return R and t; x_camera = R x + t.

    An image on a rig has the pose of the rig in the world, then that of its camera on the rig.
    """
    riders = {
        label: (instance, chosen.get("rig_cameras", {}).get(str(camera)))
        for instance in chosen.get("rig_instances", {}).values()
        for label, camera in instance.get("rig_camera_ids", {}).items()
    }
    pairs = []
    for label, shot in shots.items():
        if "rotation" in shot or label not in riders:
            pairs.append(_pose(shot))
            continue
        (rig_r, rig_t), (turn, shift) = map(_pose, riders[label])
        pairs.append((turn @ rig_r, turn @ rig_t + shift))
    rotations, shifts = (np.array(each) for each in zip(*pairs, strict=True))
    return rotations, shifts


def _pose(entry: Any) -> tuple[FloatArray, FloatArray]:
    """Return R and t of an entry with an axis-angle rotation."""
    turn = from_rotation_vectors(checks.triple(entry["rotation"]))
    return turn, checks.triple(entry["translation"])


def _reference(path: Path, chosen: Any) -> tuple[float, float, float] | None:
    """Return latitude, longitude, height of the origin, from the file or the one beside it."""
    entry = chosen.get("reference_lla")
    beside = path.with_name("reference_lla.json")
    if entry is None and beside.is_file() and beside.read_bytes()[:100].lstrip()[:1] == b"{":
        path, entry = beside, checks.load_json(beside)
    if entry is None:
        return None
    with checks.reading(path):
        lat, lon, alt = (float(entry[key]) for key in ("latitude", "longitude", "altitude"))
        if not (abs(lat) <= 90.0 and abs(lon) <= 360.0 and abs(alt) < np.inf):
            raise checks.damaged(path, f"reference_lla {lat:g}, {lon:g} is no place on earth")
    return None if lat == lon == 0.0 else (lat, lon, alt)


HEADER = b"OPENSFM_TRACKS_VERSION"
CHUNK_BYTES = 1 << 24


def read_tie_points(reconstruction: Reconstruction) -> TiePoints:
    """Return the points in the frame of the file, and where its images saw them."""
    path, cameras, _, points = reconstruction
    beside = path.with_name("tracks.csv")
    if not points or not beside.is_file():
        why = "it has no points" if not points else "tracks.csv is not beside it"
        raise tracks.no_tie_points(path, why)
    xyz = np.array([point["coordinates"] for point in points.values()], float).reshape(-1, 3)
    with checks.reading(beside):
        point, camera, xy = _observations(beside, list(points), cameras.labels)
    order = np.lexsort((camera, point))
    size = np.array([(lens.width, lens.height) for lens in cameras.lenses or ()])[camera]
    uv = xy * size.max(axis=1, initial=0.0)[:, None] + size / 2.0
    return tracks.tie_points(tracks.Seen(xyz, point[order], camera[order], uv[order]))


def _observations(
    path: Path, points: list[str], labels: tuple[str, ...]
) -> tuple[IntArray, IntArray, FloatArray]:
    """Return point row, camera row and normalised x, y of every line that has both.

    Lines are read in blocks, as there can be many millions.
    """
    camera_of, point_of = (
        {name.encode(errors="replace"): i for i, name in enumerate(names)}
        for names in (labels, points)
    )
    parts: list[tuple[IntArray, IntArray, FloatArray]] = []
    with path.open("rb") as stream:
        while block := stream.readlines(CHUNK_BYTES):
            lines = [line.split(b"\t", 5) for line in block if line.strip()]
            lines = lines[1:] if not parts and block[0].startswith(HEADER) else lines
            point = np.array([point_of.get(fields[1], -1) for fields in lines], dtype=np.int64)
            camera = np.array([camera_of.get(fields[0], -1) for fields in lines], dtype=np.int64)
            values = np.array([fields[3:5] for fields in lines], dtype=float).reshape(-1, 2)
            keep = (point >= 0) & (camera >= 0)
            parts.append((point[keep], camera[keep], values[keep]))
    if not parts:
        raise checks.damaged(path, "it is empty")
    point, camera, xy = (np.concatenate(column) for column in zip(*parts, strict=True))
    return point, camera, xy

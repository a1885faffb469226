"""The poses of a reconstruction.json, in its own frame."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras.opensfm.lenses import is_panorama, lens
from pcfix.io.cameras.opensfm.values import load, mapping, number, rows, vector
from pcfix.lens.rotations import from_rotation_vectors

if TYPE_CHECKING:
    from collections.abc import Iterable

    from pcfix.model import FloatArray, Lens

NO_GNSS = 999999.0
"""The gps_dop that OpenSfM writes for an image without a position."""


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """What the largest reconstruction of a file holds.

    Attributes
    ----------
    path : Path
    labels : tuple of str, length k
    centres, rotations : array, shapes (k, 3) and (k, 3, 3)
        In the frame of the file.
    lenses : tuple of Lens, length k
    gnss_xyz, gnss_sigma_m : array, shape (k, 3)
        Topocentric at `reference`, NaN where there is none.
    reference : tuple of 3 float, or None
        Latitude and longitude in degrees, height in metres of the topocentric origin; None where
        the file has none, or the made-up one that OpenSfM gives to images without positions.
    points : dict
        Tie points as in the file.
    left_out : tuple of str
        Images that are not among `labels`.
    notes : tuple of str
    """

    path: Path
    labels: tuple[str, ...]
    centres: FloatArray
    rotations: FloatArray
    lenses: tuple[Lens, ...]
    gnss_xyz: FloatArray
    gnss_sigma_m: FloatArray
    reference: tuple[float, float, float] | None
    points: dict[str, Any]
    left_out: tuple[str, ...]
    notes: tuple[str, ...]


def read_reconstruction(path: Path) -> Reconstruction:
    """Read the reconstruction with the most images.

    Raises
    ------
    InputError
        If the file is no reconstruction, or an entry is not what it should be.
    """
    chosen, others, notes = _largest(path, load(path))
    cameras = mapping(path, "cameras", chosen.get("cameras"))
    shots, panoramas = _usable(path, chosen["shots"], cameras)
    if panoramas:
        notes.append(
            f"{path}: {len(panoramas)} images of all-round cameras (spherical) are left out; pcfix"
            " needs images with a frame."
        )
    lenses = {
        name: lens(path, name, cameras[name]) for name in {s["camera"] for s in shots.values()}
    }
    rotations, centres = _poses(path, chosen, shots)
    xyz, sigma = _gnss(path, shots)
    labels = tuple(shots)
    return Reconstruction(
        path=path,
        labels=labels,
        centres=centres,
        rotations=rotations,
        lenses=tuple(lenses[shot["camera"]] for shot in shots.values()),
        gnss_xyz=xyz,
        gnss_sigma_m=sigma,
        reference=_reference(path, chosen),
        points=mapping(path, "points", chosen.get("points", {})),
        left_out=left_out(labels, [*others, *panoramas, *_listed(path)]),
        notes=tuple(notes),
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
    pairs = []
    for label, shot in shots.items():
        if "rotation" in shot or label not in riders:
            pairs.append(_pose(path, f"image {label}", shot))
        else:
            pairs.append(_on_rig(path, label, chosen, *riders[label]))
    rotations = np.array([pair[0] for pair in pairs])
    shifts = np.array([pair[1] for pair in pairs])
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
    xyz = np.full((len(shots), 3), np.nan)
    sigma = np.full((len(shots), 3), np.nan)
    for i, (label, shot) in enumerate(shots.items()):
        dop = shot.get("gps_dop")
        if shot.get("gps_position") is None or dop == NO_GNSS:
            continue
        xyz[i] = vector(path, f"image {label}, gps_position", shot["gps_position"], 3)
        if dop is not None:
            sigma[i] = number(path, f"image {label}, gps_dop", dop)
    return xyz, sigma


def _reference(path: Path, chosen: dict[str, Any]) -> tuple[float, float, float] | None:
    """Return latitude, longitude, height of the origin, from the file or the one beside it."""
    entry = chosen.get("reference_lla")
    beside = path.with_name("reference_lla.json")
    if entry is None and beside.is_file() and beside.read_bytes()[:100].lstrip()[:1] == b"{":
        path, entry = beside, load(beside)
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

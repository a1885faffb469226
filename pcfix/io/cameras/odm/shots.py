"""shots.geojson with cameras.json, and images.json: what an OpenDroneMap project often keeps."""

from __future__ import annotations

from pathlib import PurePath
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras import checks
from pcfix.io.cameras.odm.crs import crs_of_place
from pcfix.io.cameras.opensfm.lenses import is_panorama, lens
from pcfix.io.cameras.opensfm.reconstruction import left_out
from pcfix.io.cameras.opensfm.values import load, mapping, number, rows, vector
from pcfix.lens.rotations import from_rotation_vectors
from pcfix.model import Cameras, GnssPositions, Lens

if TYPE_CHECKING:
    from pathlib import Path

    from pcfix.io.cameras.odm.project import Project
    from pcfix.model import FloatArray

SAME_FOCAL = 1e-6


def read_shots(project: Project, path: Path, source: str) -> Cameras:
    """Read the cameras of shots.geojson, in the projected CRS.

    Raises
    ------
    InputError
        If an entry is not what it should be.
    """
    shots = _shots(path)
    labels = tuple(shots)
    turns = [vector(path, f"image {k}, rotation", s.get("rotation"), 3) for k, s in shots.items()]
    lenses, notes = _lenses(project, path, shots)
    gnss, listed = read_images(project.find("images.json"), labels)
    return Cameras(
        labels=labels,
        centres=np.array(list(positions(path).values())),
        rotations=from_rotation_vectors(np.array(turns)),
        lenses=lenses,
        crs=project.crs() or _crs_of_geometry(path, shots),
        notes=notes,
        gnss=gnss,
        unposed=left_out(labels, listed),
        source=source,
    )


def positions(path: Path) -> dict[str, FloatArray]:
    """Return the projection centre of every image of shots.geojson, metres."""
    shots = _shots(path)
    xyz = rows(path, "translation", [shot.get("translation") for shot in shots.values()], 3)
    return dict(zip(shots, xyz, strict=True))


def read_images(
    path: Path | None, labels: tuple[str, ...]
) -> tuple[GnssPositions | None, list[str]]:
    """Return the GNSS positions of images.json per label, and the names of all its images.

    Longitude, latitude, and the altitude as the image states it.
    """
    if path is None:
        return None, []
    entries = load(path)
    if not isinstance(entries, list):
        raise InputError(f"{path}: is not a list of images as OpenDroneMap writes it.")
    images = [mapping(path, f"entry {i + 1}", entry) for i, entry in enumerate(entries)]
    names = [str(image.get("filename")) for image in images]
    by_name = dict(zip(names, images, strict=True))
    xyz, sigma = np.full((2, len(labels), 3), np.nan)
    for i, label in enumerate(labels):
        image = by_name.get(label) or by_name.get(PurePath(label).stem)
        if image is not None and image.get("latitude") is not None:
            xyz[i], sigma[i] = _position(path, label, image)
    if not np.isfinite(xyz).any():
        return None, names
    return GnssPositions(xyz, sigma, "EPSG:4326"), names


def _position(path: Path, label: str, image: dict[str, Any]) -> tuple[list[float], list[float]]:
    keys = ("longitude", "latitude", "altitude", "gps_xy_stddev", "gps_z_stddev")
    values = [
        np.nan if image.get(key) is None else number(path, f"image {label}, {key}", image[key])
        for key in keys
    ]
    return values[:3], [values[3], values[3], values[4]]


def _shots(path: Path) -> dict[str, dict[str, Any]]:
    """Return the properties of every feature by file name, with its `geometry`."""
    features = mapping(path, "the file", load(path)).get("features")
    if not isinstance(features, list) or not features:
        raise InputError(f"{path}: has no features, so no cameras.")
    shots: dict[str, dict[str, Any]] = {}
    for i, value in enumerate(features):
        feature = mapping(path, f"feature {i + 1}", value)
        shot = mapping(path, f"feature {i + 1}, properties", feature.get("properties"))
        name = shot.get("filename")
        if not isinstance(name, str):
            raise InputError(f"{path}: feature {i + 1} has no filename.")
        if name in shots:
            raise InputError(
                f"{path}: feature {i + 1} repeats the filename {name}; give every image a name of"
                " its own, as OpenDroneMap needs."
            )
        shots[name] = {**shot, "geometry": feature.get("geometry")}
    return shots


def _lenses(
    project: Project, path: Path, shots: dict[str, dict[str, Any]]
) -> tuple[tuple[Lens, ...], tuple[str, ...]]:
    """Return the lens of each shot, and a note where cameras.json does not have it."""
    known = _known_lenses(project.find("cameras.json"))
    plain = 0
    lenses = []
    for label, shot in shots.items():
        size = [shot.get(key) for key in ("width", "height", "focal")]
        width, height, focal = vector(
            path, f"image {label}, width, height, focal", size, 3
        ).tolist()
        match = _match(known, str(shot.get("camera")), width, height, focal)
        plain += match is None
        lenses.append(match or _plain(path, label, width, height, focal))
    if not plain:
        return tuple(lenses), ()
    note = (
        f"{path}: cameras.json has no camera of the size and focal length of {plain} images; their"
        " lens is taken as free of distortion."
    )
    return tuple(lenses), (note,)


def _known_lenses(path: Path | None) -> dict[str, Lens]:
    """Return the lenses of cameras.json, none where there is no such file."""
    if path is None:
        return {}
    entries = mapping(path, "the file", load(path))
    cameras = {name: mapping(path, f"camera {name}", entry) for name, entry in entries.items()}
    return {name: lens(path, name, c) for name, c in cameras.items() if not is_panorama(c)}


def _match(
    known: dict[str, Lens], name: str, width: float, height: float, focal: float
) -> Lens | None:
    """Return the lens of the camera a shot names, or else of the only one that is alike."""
    if name in known:
        return known[name]
    fits = [
        found
        for found in known.values()
        if (found.width, found.height) == (width, height)
        and abs((found.focal + found.b1) / max(width, height) - focal) < SAME_FOCAL
    ]
    return fits[0] if len(fits) == 1 else None


def _plain(path: Path, label: str, width: float, height: float, focal: float) -> Lens:
    scale = max(width, height)
    return checks.lens(
        path, f"of image {label}", Lens(focal * scale, width, height, width / 2.0, height / 2.0)
    )


def _crs_of_geometry(path: Path, shots: dict[str, dict[str, Any]]) -> str:
    """Return the UTM zone that takes a shot's longitude and latitude to its translation.

    A project without GNSS has made-up coordinates, which fit no zone.
    """
    label, shot = next(iter(shots.items()))
    geometry = mapping(path, f"image {label}, geometry", shot["geometry"] or {})
    place = geometry.get("coordinates")
    if place is None:
        return "local"
    lon, lat, _ = vector(path, f"image {label}, coordinates", place, 3)
    east, north, _ = vector(path, f"image {label}, translation", shot.get("translation"), 3)
    return crs_of_place(lon, lat, east, north) or "local"

"""The files of an OpenDroneMap project: its CRS, shots.geojson, cameras.json and images.json."""

from __future__ import annotations

from pathlib import Path, PurePath
from typing import Any, NamedTuple

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras import checks
from pcfix.io.cameras.checks import json_number, load_json, mapping, rows, vector
from pcfix.io.cameras.opensfm import left_out
from pcfix.io.cameras.opensfm.models import is_panorama, lens
from pcfix.io.crs import GEOCENTRIC_WGS84, GEOGRAPHIC_WGS84, Topocentric
from pcfix.lens.rotations import from_rotation_vectors
from pcfix.model import Cameras, FloatArray, GnssPositions, Lens

SHOTS = "shots.geojson"
RECONSTRUCTION = "reconstruction.json"
TRANSFORMATION = "geocoords_transformation.txt"
TOPOCENTRIC = "reconstruction.topocentric.json"

_FOLDERS = ("", "opensfm", "odm_georeferencing", "odm_georeferencing_25d", "odm_report")
_LINK_BYTES = 400


class Project(NamedTuple):
    """A project folder and the file in it that has the poses, shots.geojson or a reconstruction."""

    root: Path
    poses: Path | None

    def find(self, name: str) -> Path | None:
        """Return a file of this name beside the poses or in the project's own folders."""
        folders = [self.poses.parent] if self.poses else []
        folders += [self.root / folder for folder in _FOLDERS]
        for folder in folders:
            if (folder / name).is_file():
                return _followed(folder / name, self.root)
        return None

    def crs(self) -> str | None:
        """Return the projected CRS that the project names."""
        for name in ("proj.txt", "coords.txt", "odm_georeferencing_model_geo.txt"):
            path = self.find(name)
            if path is not None:
                return named_crs(path)
        return None


def locate(path: Path) -> Project:
    """Return the project that a file or folder belongs to.

    A file is taken as it is; of a folder its reconstruction, or else its shots.geojson.
    """
    folder = path if path.is_dir() else path.parent
    root = folder
    if root.name == "undistorted":
        root = root.parent
    if root.name in _FOLDERS[1:]:
        root = root.parent
    if not path.is_dir():
        return Project(root, path)
    places = [folder / RECONSTRUCTION, root / "opensfm" / RECONSTRUCTION]
    places += [folder / SHOTS, root / "odm_report" / SHOTS]
    return Project(root, next((place for place in places if place.is_file()), None))


def whole_file(project: Project) -> Path:
    """Return the file with the poses, followed where it is a link kept as text."""
    if project.poses is None:
        raise InputError(f"{project.root}: has neither opensfm/{RECONSTRUCTION} nor {SHOTS}.")
    found = _followed(project.poses, project.root)
    if found is None:
        raise InputError(
            f"{project.poses}: is only a link to '{_link(project.poses)}', which is not in this"
            " project; give the file itself."
        )
    return found


def _followed(path: Path, root: Path) -> Path | None:
    """Return the file that a link kept as text (git does so) leads to, inside the project."""
    link = _link(path)
    if link is None:
        return path
    target = (path.parent / link).resolve()
    if not target.is_file() or not target.is_relative_to(root.resolve()):
        return None
    return None if _link(target) else target


def _link(path: Path) -> str | None:
    """Return the path that a file consists of; None for any other file."""
    if path.stat().st_size > _LINK_BYTES:
        return None
    text = path.read_bytes().decode("utf-8", errors="replace").strip()
    is_path = "/" in text and text.rsplit(".", 1)[-1] == path.suffix[1:]
    return text if is_path and not set(text) & set('{}[]"\n\0') else None


WHOLE_M = 2e-3
"""Newer ODM puts the origin at whole metres; reference_lla is rounded a little."""


def named_crs(path: Path) -> str:
    """Return the CRS in the first line of a file: a PROJ string, EPSG:n or WGS84 UTM 16N."""
    text = path.read_bytes()[:4096].decode("utf-8-sig", errors="replace").strip()
    line = text.splitlines()[0].strip() if text else ""
    crs = checks.utm_as_code(line)
    if not checks.names_crs(crs):
        raise InputError(f"{path}: '{line[:80]}' names no CRS; put its EPSG code there.")
    return crs


def whole_metres(lat: float, lon: float, crs: str | None) -> tuple[str, float, float] | None:
    """Return CRS, easting and northing where a reference is at whole metres of both.

    The CRS is the one named, or else UTM, the zone of the reference or one beside it.
    """
    for candidate in [crs] if crs else _zones(lat, lon):
        east, north = _projected(candidate, lon, lat)
        if np.hypot(east - np.round(east), north - np.round(north)) < WHOLE_M:
            return candidate, float(np.round(east)), float(np.round(north))
    return None


def crs_of_place(
    lon: float, lat: float, east: float, north: float, candidates: list[str] | None = None
) -> str | None:
    """Return the CRS (by default a UTM zone) in which a place has these coordinates, to a metre."""
    for candidate in candidates or _zones(lat, lon):
        if np.hypot(*(_projected(candidate, lon, lat) - np.array([east, north]))) < 1.0:
            return candidate
    return None


def from_topocentric(
    xyz: FloatArray, reference: tuple[float, float, float], crs: str
) -> FloatArray:
    """Return topocentric points in a projected CRS, heights on the ellipsoid, shape (n, 3)."""
    from pyproj import Transformer

    to_degrees = Transformer.from_crs(GEOCENTRIC_WGS84, GEOGRAPHIC_WGS84, always_xy=True)
    geographic = np.column_stack(
        to_degrees.transform(*Topocentric(*reference).to_geocentric(xyz).T)
    )
    return np.column_stack([_projected(crs, *geographic[:, :2].T).T, geographic[:, 2]])


def _zones(lat: float, lon: float) -> list[str]:
    zone = int((lon + 180.0) // 6.0) if np.isfinite(lon) else 0
    first = 32601 if lat >= 0.0 else 32701
    return [f"EPSG:{first + (zone + step) % 60}" for step in (0, -1, 1)]


def _projected(crs: str, lon: float | FloatArray, lat: float | FloatArray) -> FloatArray:
    from pyproj import Transformer

    return np.array(Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(lon, lat))


SAME_FOCAL = 1e-6
GNSS_KEYS = ("longitude", "latitude", "altitude", "gps_xy_stddev", "gps_z_stddev")


def read_shots(project: Project, path: Path) -> Cameras:
    """Read the cameras of shots.geojson, in the projected CRS."""
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
        source="OpenDroneMap",
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
    entries = load_json(path)
    if not isinstance(entries, list):
        raise InputError(f"{path}: is not a list of images as OpenDroneMap writes it.")
    images = [mapping(path, f"entry {i + 1}", entry) for i, entry in enumerate(entries)]
    names = [str(image.get("filename")) for image in images]
    by_name = dict(zip(names, images, strict=True))
    values = np.full((len(labels), len(GNSS_KEYS)), np.nan)
    for i, label in enumerate(labels):
        image = by_name.get(label) or by_name.get(PurePath(label).stem)
        if image is not None and image.get("latitude") is not None:
            for j, key in enumerate(GNSS_KEYS):
                if image.get(key) is not None:
                    values[i, j] = json_number(path, f"image {label}, {key}", image[key])
    if not np.isfinite(values[:, :3]).any():
        return None, names
    return GnssPositions(values[:, :3], values[:, [3, 3, 4]], "EPSG:4326"), names


def _shots(path: Path) -> dict[str, dict[str, Any]]:
    """Return the properties of every feature by file name, with its `geometry`."""
    features = mapping(path, "the file", load_json(path)).get("features")
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
    beside = project.find("cameras.json")
    entries = {} if beside is None else mapping(beside, "the file", load_json(beside))
    known = {
        name: lens(beside, name, camera)
        for name, entry in entries.items()
        if beside and not is_panorama(camera := mapping(beside, f"camera {name}", entry))
    }
    lenses, plain = [], 0
    for label, shot in shots.items():
        size = [shot.get(key) for key in ("width", "height", "focal")]
        size_and_focal = vector(path, f"image {label}, width, height, focal", size, 3)
        width, height, focal = size_and_focal.tolist()
        found = _match(known, str(shot.get("camera")), width, height, focal)
        if found is None:
            plain += 1
            focal_px = focal * max(width, height)
            found = Lens(focal_px, width, height, width / 2.0, height / 2.0)
            checks.lens(path, f"of image {label}", found)
        lenses.append(found)
    note = (
        f"{path}: cameras.json has no camera of the size and focal length of {plain} images; their"
        " lens is taken as free of distortion."
    )
    return tuple(lenses), (note,) if plain else ()


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

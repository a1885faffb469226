"""OpenDroneMap and OpenSfM: a project folder, reconstruction.json or shots.geojson.

*OpenSfM*. The file is a list of reconstructions, each with `cameras`, `shots` and `points`. A
shot's `rotation` (axis times angle, radians) and `translation` take world to camera, x right, y
down, z forward. The world is topocentric, metres east, north and up at `reference_lla`, which is in
the reconstruction or in reference_lla.json; `gps_position` is in the same frame, `gps_dop` its
standard deviation in metres. Without a reference the frame is local. Coordinates too large to be
topocentric come from ``export_geocoords --reconstruction``; that file does not name its CRS.

A line of tracks.csv is image, track, feature, x, y and more that differs between the versions (0
without a header, 1 and 2 with one). x, y, `focal`, `focal_x`, `focal_y`, `c_x` and `c_y` are in
units of the larger side of the image, from its centre. The tangential terms follow OpenCV (p1 with
2 x y in x). Distortion acts on the projected coordinates, which are angles for the fisheye models.

*ODM* reconstructs with OpenSfM and delivers its cloud in a projected CRS, named in proj.txt or in
the first line of coords.txt. Its reconstruction has been in three frames:

- up to 2020 topocentric as OpenSfM writes it, with geocoords_transformation.txt, an affine map
  to the projected CRS of the cloud;
- then with the axes of the projected CRS, minus its coordinates of the reference, which are whole
  metres;
- topocentric again in versions that project the finished cloud point by point, and in
  reconstruction.topocentric.json. If the reference is at whole metres, shots.geojson or the GNSS
  positions (always topocentric) distinguish it from the second.

Poses are returned in the projected CRS, in the third frame topocentric. shots.geojson has per image
`translation`, the projection centre in the projected CRS, `rotation`, axis times angle from the
axes of that CRS to the camera, and size and focal length, by which its lens is found in
cameras.json.

References: "Reconstruction file" and "Coordinate Systems" in the manual of OpenSfM,
https://opensfm.org/docs; "Outputs" in that of ODM, https://docs.opendronemap.org/outputs; the
stages `opensfm` and `odm_report` of https://github.com/OpenDroneMap/ODM.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path, PurePath
from typing import Any, NamedTuple

import numpy as np

from pcfix.io.cameras import checks
from pcfix.io.cameras.checks import AffineFrame, LensModel, Source, damaged, lens_by_name, triple
from pcfix.io.crs import Topocentric
from pcfix.io.tables import read_lines, unnamed
from pcfix.lens.rotations import from_rotation_vectors
from pcfix.model import Cameras, FloatArray, GnssPositions, IntArray, Lens, TiePoints

SHOTS = "shots.geojson"
RECONSTRUCTION = "reconstruction.json"
TRANSFORMATION = "geocoords_transformation.txt"
TOPOCENTRIC = "reconstruction.topocentric.json"
TOPOCENTRIC_LIMIT_M = 1e5
SCALE_TOLERANCE = 0.1
"""Of the squared scale of a map projection, which excludes feet."""
ROUNDING_M = 2e-3
"""Newer ODM puts the origin at whole metres; reference_lla is rounded a little."""
SAME_FOCAL = 1e-6
GNSS_KEYS = ("longitude", "latitude", "altitude", "gps_xy_stddev", "gps_z_stddev")

_FOLDERS = ("opensfm", "odm_georeferencing", "odm_georeferencing_25d", "odm_report")
_OF_CRS = ("proj.txt", "coords.txt", "odm_georeferencing_model_geo.txt")
_NAMES = (SHOTS, TRANSFORMATION, TOPOCENTRIC, "cameras.json", "images.json", *_OF_CRS)
_SHOTS_HEAD = re.compile(
    r'\s*\{.*"features"\s*:\s*\[.*"(translation|rotation|filename)"', re.DOTALL
)
_KEYS = "cameras|shots|points|pano_shots|reference_lla|biases|rig_cameras|rig_instances"
_HEAD = re.compile(rf'\[\s*\{{\s*"({_KEYS})"\s*:\s*\{{')
NO_GNSS = 999999.0
"""The gps_dop that OpenSfM writes for an image without a position."""
Files = dict[str, Path]
"""The existing files of a project by name, and the one with the ``poses``."""


def recognises(source: Source) -> bool:
    """Whether it is shots.geojson or a reconstruction, or a folder with one."""
    files = _files_of(source.path)
    text = Source(files["poses"]).text.lstrip() if "poses" in files else ""
    return bool(_SHOTS_HEAD.match(text) or _HEAD.match(text))


def read(source: Source) -> Cameras:
    """Read the poses, of a folder rather from the reconstruction than from shots.geojson."""
    files = _files_of(source.path)
    if _SHOTS_HEAD.match(Source(files["poses"]).text):
        return _read_shots(files)
    found = read_reconstruction(files["poses"])
    own, placed = found.cameras, _frame(files, found)
    if placed is None:
        middle = np.median(own.centres[:, :2], axis=0)
        return own if np.abs(middle).max() <= TOPOCENTRIC_LIMIT_M else replace(own, crs=None)
    gnss, listed = read_images(files.get("images.json"), own.labels)
    return replace(
        own,
        centres=placed.points(own.centres),
        rotations=placed.rotations(np.asarray(own.rotations)),
        crs=placed.crs,
        project_crs=placed.project_crs,
        gnss=gnss or own.gnss,
        unposed=unnamed([*own.unposed, *listed], own.labels),
    )


def _files_of(path: Path) -> Files:
    """Return the files of the project that a file or folder belongs to.

    The poses of a folder are in its reconstruction, or else in its shots.geojson. Other files are
    next to these, or in the project's own folders.
    """
    folder = path if path.is_dir() else path.parent
    root = folder.parent if folder.name == "undistorted" else folder
    root = root.parent if root.name in _FOLDERS else root
    places = [folder / RECONSTRUCTION, root / "opensfm" / RECONSTRUCTION]
    places += [folder / SHOTS, root / "odm_report" / SHOTS]
    poses = next(filter(Path.is_file, places if path.is_dir() else [path]), None)
    if poses is None:
        return {}
    folders = (poses.parent, root, *(root / name for name in _FOLDERS))
    found = {name: [f / name for f in folders if (f / name).is_file()] for name in _NAMES}
    return {name: there[0] for name, there in found.items() if there} | {"poses": poses}


def _crs_of(files: Files) -> str | None:
    """Return the projected CRS that the project names."""
    return next((named_crs(files[name]) for name in _OF_CRS if name in files), None)


def named_crs(path: Path) -> str:
    """Return the CRS in the first line of a file: a PROJ string, EPSG:n or WGS84 UTM 16N."""
    return checks.crs(path, [*read_lines(path), ""][0])


def _frame(files: Files, found: Reconstruction) -> AffineFrame | None:
    """Decide the frame, see the top of this module for the rules; None for OpenSfM's own."""
    crs, reference = _crs_of(files), found.reference
    located = None if reference is None else _located(*reference[:2], crs)
    if not (located or files.keys() & {*_OF_CRS, SHOTS, TOPOCENTRIC}):
        return None
    unmoved = AffineFrame(np.eye(3), np.zeros(3), found.cameras.crs or "", crs)
    if reference is None or files["poses"].name == TOPOCENTRIC:
        return unmoved
    if path := files.get(TRANSFORMATION):
        with checks.reading(path):
            rows = [row.split()[:4] for row in read_lines(path) if row.strip()]
            matrix = np.array(rows, float).reshape(4, 4)
        turn, shift = matrix[:3, :3], matrix[:3, 3]
        if not (np.abs(turn.T @ turn - np.eye(3)).max() <= SCALE_TOLERANCE):
            raise damaged(path, "it does not turn and shift the reconstruction")
        if named := _located(*reference[:2], crs, shift[:2]):  # else the file is of another origin
            return AffineFrame(turn, shift, named[0])
    if located is None:
        return unmoved
    crs, place = located
    moved = AffineFrame(np.eye(3), np.array([*place, 0.0]), crs)
    # centres of shots.geojson, else the GNSS, which stays topocentric, show whether it was moved:
    # the two readings differ by the meridian convergence and the scale
    own, gnss = found.cameras.centres, found.cameras.gnss
    truth = np.full(own.shape, np.nan)
    if SHOTS in files:
        shots = _shots(files[SHOTS])
        for i, label in enumerate(found.cameras.labels):
            truth[i] = triple(shots[label]["translation"]) if label in shots else np.nan
    elif gnss is not None:
        truth = _from_topocentric(gnss.xyz, reference, crs)
    known = np.isfinite(truth).all(axis=1)
    still_m, moved_m = (
        np.linalg.norm((guess - truth)[known, :2])
        for guess in (_from_topocentric(own, reference, crs), moved.points(own))
    )
    return unmoved._replace(project_crs=crs) if still_m < 0.5 * moved_m else moved


def _located(
    lat: float, lon: float, crs: str | None, place: FloatArray | None = None
) -> tuple[str, FloatArray] | None:
    """Return the CRS in which a place has these coordinates to a metre, and the coordinates.

    Without `place` they are whole metres. The CRS is the one that is named, or else UTM, the zone
    of the place or a neighbouring one.
    """
    zone = int((lon + 180.0) // 6.0) if np.isfinite(lon) else 0
    first = 32601 if lat >= 0.0 else 32701
    zones = [f"EPSG:{first + (zone + step) % 60}" for step in (0, -1, 1)]
    for candidate in [crs] if crs else zones:
        there = _projected(candidate, lon, lat)
        expected, within_m = (np.round(there), ROUNDING_M) if place is None else (place, 1.0)
        if np.linalg.norm(there - expected) < within_m:
            return candidate, expected
    return None


def _from_topocentric(
    xyz: FloatArray, reference: tuple[float, float, float], crs: str
) -> FloatArray:
    """Return topocentric points in a projected CRS, heights on the ellipsoid, shape (n, 3)."""
    degrees = Topocentric(*reference).to_degrees(xyz)
    return np.column_stack([*_projected(crs, *degrees[:, :2].T), degrees[:, 2]])


def _projected(crs: str, lon: float | FloatArray, lat: float | FloatArray) -> FloatArray:
    from pyproj import Transformer

    return np.array(Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(lon, lat))


def _read_shots(files: Files) -> Cameras:
    """Read the cameras of shots.geojson, in the projected CRS.

    A lens is that of the camera that the shot names, or else the only one of this focal length.
    """
    shots, crs = _shots(files["poses"]), _crs_of(files)
    labels, each = tuple(shots), shots.values()
    centres = np.array([triple(shot["translation"]) for shot in each])
    if crs is None and (place := (next(iter(each))["geometry"] or {}).get("coordinates")):
        lon, lat, _ = triple(place).tolist()  # without GNSS its coordinates are arbitrary
        crs, _ = _located(lat, lon, None, centres[0, :2]) or (None, None)
    known = {}
    if lenses_file := files.get("cameras.json"):
        with checks.reading(lenses_file):
            known = {
                k: lens(lenses_file, k, entry) for k, entry in checks.load_json(lenses_file).items()
            }
    lenses, plain = [], 0
    for shot in each:
        width, height = float(shot["width"]), float(shot["height"])
        focal = float(shot["focal"]) * max(width, height)
        near = SAME_FOCAL * focal
        alike = [one for one in known.values() if abs(one.focal + one.b1 - focal) < near]
        found = known.get(str(shot.get("camera"))) or (alike[0] if len(alike) == 1 else None)
        plain += found is None
        lenses.append(found or lens_by_name({"f": focal}, width, height))
    if plain:
        sentence = f"cameras.json has no camera of {plain} images; no distortion is assumed."
        checks.warn(files["poses"], "cameras.no_distortion", sentence, images=plain)
    gnss, listed = read_images(files.get("images.json"), labels)
    return Cameras(
        labels=labels,
        centres=centres,
        rotations=from_rotation_vectors(np.array([triple(shot["rotation"]) for shot in each])),
        lenses=tuple(lenses),
        crs=crs or "local",
        gnss=gnss,
        unposed=unnamed(listed, labels),
    )


def read_images(
    path: Path | None, labels: tuple[str, ...]
) -> tuple[GnssPositions | None, list[str]]:
    """Return the GNSS positions of images.json per label, and the names of all its images.

    Longitude, latitude, and the altitude as the image states it.
    """
    if path is None:
        return None, []
    places = {}
    with checks.reading(path):
        images = {str(image.get("filename")): image for image in checks.load_json(path)}
        for label in labels:
            image = images.get(label) or images.get(PurePath(label).stem) or {}
            if image.get("latitude") is not None:
                values = [np.nan if image.get(k) is None else float(image[k]) for k in GNSS_KEYS]
                places[label] = values[:3], np.where(np.isfinite(values), values, np.nan)[[3, 3, 4]]
    return checks.measured(labels, places, "EPSG:4326"), list(images)


def _shots(path: Path) -> dict[str, dict[str, Any]]:
    """Return the properties of every feature by file name, with its `geometry`."""
    features = checks.load_json(path)["features"]
    shots = {
        str(one["properties"]["filename"]): one["properties"] | {"geometry": one.get("geometry")}
        for one in features
    }
    if not shots or len(shots) < len(features):
        raise damaged(path, f"{len(features)} features have {len(shots)} different filenames")
    return shots


# ---- reconstructions of OpenSfM ----


class Reconstruction(NamedTuple):
    """The largest reconstruction of a file, in the frame of the file.

    `cameras` and their `gnss` are topocentric at `reference`, else local. `reference` is latitude
    and longitude in degrees and the height in metres of the topocentric origin; None if the file
    has none, or the zeros that OpenSfM writes for images without positions.
    """

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
        origin, other = chosen.get("reference_lla"), path.with_name("reference_lla.json")
        if origin is None and other.is_file() and other.read_bytes()[:100].lstrip()[:1] == b"{":
            origin = checks.load_json(other)
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
        return Reconstruction(cameras, reference, chosen.get("points", {}))


CHUNK_BYTES = 1 << 24


def tie_points(source: Source, cameras: Cameras) -> TiePoints:
    """Read points and tracks, in the frame of the poses."""
    files = _files_of(source.path)
    path = files["poses"]
    found = read_reconstruction(path)
    points, placed = found.points, _frame(files, found)
    tracks = path.with_name("tracks.csv")
    if not points or not tracks.is_file():
        why = "it has no points" if not points else "there is no tracks.csv next to it"
        raise checks.no_tie_points(path, why)
    xyz = np.array([point["coordinates"] for point in points.values()], float).reshape(-1, 3)
    xyz = xyz if placed is None else placed.points(xyz)
    camera_of, point_of = (
        {name.encode(errors="replace"): i for i, name in enumerate(names)}
        for names in (cameras.labels, points)
    )
    parts: list[tuple[IntArray, IntArray, FloatArray]] = []
    with checks.reading(tracks), tracks.open("rb") as stream:
        while block := stream.readlines(CHUNK_BYTES):  # there can be many millions of lines
            lines = [line.split(b"\t", 5) for line in block if line.count(b"\t")]
            point = np.array([point_of.get(fields[1], -1) for fields in lines], dtype=np.int64)
            camera = np.array([camera_of.get(fields[0], -1) for fields in lines], dtype=np.int64)
            values = np.array([fields[3:5] for fields in lines], dtype=float).reshape(-1, 2)
            parts.append((point, camera, values))
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
"""By names of `checks`; not every version of OpenSfM knows simple_radial and radial."""
_PARAMETERS = {"f": "focal", "fx": "focal_x", "fy": "focal_y", "cx": "c_x", "cy": "c_y"}
_PARAMETERS |= {"p1": "p2", "p2": "p1", "s1": "s0", "s2": "s1", "s3": "s2", "s4": "s3"}
"""What OpenSfM calls what has another name in `checks`."""
_DEFAULTS = {"transition": 0.5}


def lens(path: Path, name: str, camera: dict[str, Any]) -> Lens:
    """Return the lens of an entry of `cameras`."""
    model = str(camera.get("projection_type", "perspective"))
    if model not in _MODELS:
        remedy = f"Remove its images, or use one of {', '.join(_MODELS)}"
        what = f"the projection_type '{model}' of camera {name}"
        raise checks.unsupported(path, what, remedy, model=model, camera=name)

    def value(key: str, default: Any = 0.0) -> float:
        return float(camera.get(key, default))

    width, height = value("width"), value("height")
    scale = max(width, height)
    given = {
        one: value(_PARAMETERS.get(one, one), _DEFAULTS.get(one, 0.0))
        for one in _MODELS[model].names.split()
    }
    across = value("focal_x", camera.get("focal"))
    down = value("focal_y", across)
    given |= {"fx": across * scale, "fy": down * scale}
    given |= {"cx": width / 2.0 + value("c_x") * scale, "cy": height / 2.0 + value("c_y") * scale}
    projection = _MODELS[model].projection
    return lens_by_name(given, width, height, projection=projection, sensor=name)

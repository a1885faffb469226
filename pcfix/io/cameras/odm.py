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

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from pcfix.io.cameras import checks
from pcfix.io.cameras.checks import AffineFrame, LensModel, Source, damaged, lens_by_name, triple
from pcfix.io.crs import Topocentric, is_topocentric
from pcfix.io.tables import read_lines, unnamed
from pcfix.lens.rotations import from_rotation_vectors
from pcfix.model import Cameras, FloatArray, GnssPositions, Lens, TiePoints

SHOTS = "shots.geojson"
RECONSTRUCTION = "reconstruction.json"
TRANSFORMATION = "geocoords_transformation.txt"
TOPOCENTRIC = "reconstruction.topocentric.json"
GNSS_KEYS = ("longitude", "latitude", "altitude", "gps_xy_stddev", "gps_z_stddev")

_FOLDERS = ("opensfm", "odm_georeferencing", "odm_georeferencing_25d", "odm_report")
_OF_CRS = ("proj.txt", "coords.txt", "odm_georeferencing_model_geo.txt")
_NAMES = (SHOTS, TRANSFORMATION, TOPOCENTRIC, "cameras.json", "images.json", *_OF_CRS)
_SHOTS_HEAD = re.compile(r'(?s)\s*\{.*"features"\s*:\s*\[.*"(translation|rotation|filename)"')
_KEYS = "cameras|shots|points|pano_shots|reference_lla|biases|rig_cameras|rig_instances"
_HEAD = re.compile(rf'\s*\[\s*\{{\s*"({_KEYS})"\s*:\s*\{{')
Files = Mapping[str, Path]  # existing files of a project by name, and the one with the ``poses``


def recognises(source: Source) -> bool:
    """Whether it is shots.geojson or a reconstruction, or a folder with one."""
    files = _files_of(source.path)
    text = Source(files["poses"]).text if "poses" in files else ""
    return bool(_SHOTS_HEAD.match(text) or _HEAD.match(text))


def read(source: Source) -> Cameras:
    """Read the poses, of a folder rather from the reconstruction than from shots.geojson."""
    files = _files_of(source.path)
    if _SHOTS_HEAD.match(Source(files["poses"]).text):
        return _read_shots(files)
    own, _ = read_reconstruction(files["poses"])
    frame, (gnss, listed) = _frame(files, own), _read_images(files, own.labels)
    # the nearest rotations, as the map scales a bit
    u, _, v = np.linalg.svd(np.asarray(own.rotations) @ np.linalg.inv(frame.matrix))
    return replace(
        own,
        centres=frame.points(own.centres),
        rotations=u @ v,
        crs=frame.crs,
        project_crs=frame.project_crs,
        gnss=gnss or own.gnss,
        unposed=unnamed([*own.unposed, *listed], own.labels),
    )


def tie_points(source: Source, cameras: Cameras) -> TiePoints:
    """Read points and tracks, in the frame of the poses."""
    files = _files_of(source.path)
    path = files["poses"]
    own, points = read_reconstruction(path)
    tracks = path.with_name("tracks.csv")
    if not points or not tracks.is_file():
        why = "it has no points" if not points else "there is no tracks.csv next to it"
        raise checks.no_tie_points(path, why)
    xyz = np.array([point["coordinates"] for point in points.values()], float).reshape(-1, 3)
    camera_of, point_of = (
        {name.encode(errors="replace"): i for i, name in enumerate(names)}
        for names in (cameras.labels, points)
    )
    with checks.reading(tracks), tracks.open("rb") as stream:  # can have many millions of lines
        listed = (line.split(b"\t", 5) for line in stream if b"\t" in line)
        rows = (
            (camera_of.get(f[0], -1), point_of.get(f[1], -1), *map(float, f[3:5])) for f in listed
        )
        values = np.fromiter(rows, np.dtype((np.float64, 4)))
    camera, point = values[:, :2].T.astype(np.int64)
    order = np.lexsort((camera, point))
    size = np.array([(lens.width, lens.height) for lens in cameras.lenses or ()])[camera]
    uv = values[:, 2:] * size.max(axis=1, initial=0.0)[:, None] + size / 2.0
    xyz = _frame(files, own).points(xyz)
    return checks.tie_points(checks.Observations(xyz, point[order], camera[order], uv[order]))


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


# ---- the frame of a reconstruction ----


def _frame(files: Files, own: Cameras) -> AffineFrame:
    """Decide the frame of a reconstruction, see the top of this module for the rules."""
    crs, own_crs = _crs_of(files), own.crs or ""
    origin = Topocentric.from_text(own_crs, "") if is_topocentric(own_crs) else None
    lon, lat = (origin.longitude_deg, origin.latitude_deg) if origin else (np.nan, np.nan)
    located = _located(lon, lat, crs) if origin else None
    unmoved = AffineFrame(np.eye(3), np.zeros(3), own_crs, crs)
    if not (located or files.keys() & {*_OF_CRS, SHOTS, TOPOCENTRIC}):  # OpenSfM's own
        is_far = np.abs(np.median(own.centres[:, :2], axis=0)).max() > 1e5
        return unmoved._replace(crs=None) if is_far else unmoved
    if origin is None or files["poses"].name == TOPOCENTRIC:
        return unmoved
    if path := files.get(TRANSFORMATION):
        with checks.reading(path):
            rows = [row.split()[:4] for row in read_lines(path) if row.strip()]
            matrix = np.array(rows, float).reshape(4, 4)
        turn, shift = matrix[:3, :3], matrix[:3, 3]
        # the squared scale of a map projection is within 0.1 of 1, that of feet is not
        if not (np.abs(turn.T @ turn - np.eye(3)).max() <= 0.1):
            raise damaged(path, "it does not turn and shift the reconstruction")
        if named := _located(lon, lat, crs, shift[:2]):  # else the file is of another origin
            return AffineFrame(turn, shift, named[0])
    if located is None:
        return unmoved
    crs, place = located
    moved = AffineFrame(np.eye(3), np.array([*place, 0.0]), crs)
    # centres of shots.geojson, else the GNSS, which stays topocentric, show whether it was moved:
    # the two readings differ by the meridian convergence and the scale
    truth = np.full((len(own), 2), np.nan)
    if SHOTS in files:
        shots = _shots(files[SHOTS])
        for i, label in enumerate(own.labels):
            truth[i] = triple(shots[label]["translation"])[:2] if label in shots else np.nan
    elif own.gnss is not None:
        truth = _projected(crs, origin.to_degrees(own.gnss.xyz))
    still = _projected(crs, origin.to_degrees(own.centres))
    known = np.isfinite(truth).all(axis=1)
    still_m = np.linalg.norm((still - truth)[known])
    moved_m = np.linalg.norm((moved.points(own.centres)[:, :2] - truth)[known])
    return unmoved._replace(project_crs=crs) if still_m < 0.5 * moved_m else moved


def _located(
    lon: float, lat: float, crs: str | None, place: FloatArray | None = None
) -> tuple[str, FloatArray] | None:
    """Return the CRS in which a place has these coordinates to a metre, and the coordinates.

    Without `place` they are whole metres. The CRS is the one that is named, or else UTM, the zone
    of the place or a neighbouring one.
    """
    zone = int((lon + 180.0) // 6.0) if np.isfinite(lon) else 0
    first = 32601 if lat >= 0.0 else 32701
    zones = [f"EPSG:{first + (zone + step) % 60}" for step in (0, -1, 1)]
    for candidate in [crs] if crs else zones:
        there = _projected(candidate, np.array([[lon, lat]]))[0]
        # 2 mm, as reference_lla is rounded a little
        expected, within_m = (np.round(there), 2e-3) if place is None else (place, 1.0)
        if np.linalg.norm(there - expected) < within_m:
            return candidate, expected
    return None


def _projected(crs: str, degrees: FloatArray) -> FloatArray:
    """Return x and y, shape (n, 2), of longitudes and latitudes."""
    from pyproj import Transformer

    step = Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    return np.column_stack(step.transform(degrees[:, 0], degrees[:, 1]))


def _crs_of(files: Files) -> str | None:
    """Return the projected CRS that the project names."""
    return next((named_crs(files[name]) for name in _OF_CRS if name in files), None)


def named_crs(path: Path) -> str:
    """Return the CRS in the first line of a file: a PROJ string, EPSG:n or WGS84 UTM 16N."""
    return checks.crs(path, [*read_lines(path), ""][0])


# ---- shots.geojson and images.json of ODM ----


def _read_shots(files: Files) -> Cameras:
    """Read the cameras of shots.geojson, in the projected CRS.

    A lens is that of the camera that the shot names, or else the only one of this focal length.
    """
    shots, crs = _shots(files["poses"]), _crs_of(files)
    labels, each = tuple(shots), shots.values()
    centres = np.array([triple(shot["translation"]) for shot in each])
    if crs is None and (place := (next(iter(each))["geometry"] or {}).get("coordinates")):
        lon, lat, _ = triple(place).tolist()  # without GNSS its coordinates are arbitrary
        crs, _ = _located(lon, lat, None, centres[0, :2]) or (None, None)
    known = {}
    if lenses_file := files.get("cameras.json"):
        with checks.reading(lenses_file):
            listed = checks.load_json(lenses_file).items()
            known = {name: lens(lenses_file, name, entry) for name, entry in listed}
    lenses, bare = [], 0
    for shot in each:
        plain = {"f": float(shot["focal"])}
        own = lens_by_name(plain, float(shot["width"]), float(shot["height"]), relative=True)
        near = 1e-6 * own.focal
        alike = [one for one in known.values() if abs(one.focal + one.b1 - own.focal) < near]
        found = known.get(str(shot.get("camera"))) or (alike[0] if len(alike) == 1 else own)
        bare += found is own
        lenses.append(found)
    if bare:
        sentence = f"cameras.json has no camera of {bare} images; no distortion is assumed."
        checks.warn(files["poses"], "cameras.no_distortion", sentence, images=bare)
    turns = from_rotation_vectors(np.array([triple(shot["rotation"]) for shot in each]))
    gnss, images = _read_images(files, labels)
    unposed = unnamed(images, labels)
    crs = crs or "local"
    return Cameras(labels, centres, turns, tuple(lenses), crs, gnss=gnss, unposed=unposed)


def _shots(path: Path) -> dict[str, dict[str, Any]]:
    """Return the properties of every feature by file name, with its `geometry`."""
    features = checks.load_json(path)["features"]
    given = [one["properties"] | {"geometry": one.get("geometry")} for one in features]
    shots = {str(one["filename"]): one for one in given}
    if not shots or len(shots) < len(features):
        raise damaged(path, f"{len(features)} features have {len(shots)} different filenames")
    return shots


def _read_images(files: Files, labels: tuple[str, ...]) -> tuple[GnssPositions | None, list[str]]:
    """Return the GNSS positions of images.json per label, and the names of all its images.

    Longitude, latitude, and the altitude as the image states it.
    """
    if (path := files.get("images.json")) is None:
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


# ---- reconstructions of OpenSfM ----


def read_reconstruction(path: Path) -> tuple[Cameras, dict[str, Any]]:
    """Read the reconstruction with the most images, in the frame of the file; and its points.

    The frame is topocentric at the reference, or local if the file has none, or the zeros that
    OpenSfM writes for images without positions.
    """
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
        turns = np.array([triple(shot["rotation"]) for shot in shots.values()])
        shifts = np.array([triple(shot["translation"]) for shot in shots.values()])
        rotations = from_rotation_vectors(turns)
        places = {}
        for label, shot in shots.items():
            position, dop = shot.get("gps_position"), shot.get("gps_dop")
            if position is not None and dop != 999999.0:  # which stands for no position
                places[label] = position, [np.nan if dop is None else dop] * 3
        origin, other = chosen.get("reference_lla"), path.with_name("reference_lla.json")
        if origin is None and other.is_file() and other.read_bytes()[:100].lstrip()[:1] == b"{":
            origin = checks.load_json(other)
        crs = "local"
        if origin is not None:
            lat, lon, alt = (float(origin[key]) for key in ("latitude", "longitude", "altitude"))
            if not (abs(lat) <= 90.0 and abs(lon) <= 360.0 and abs(alt) < np.inf):
                raise damaged(path, f"reference_lla {lat:g}, {lon:g} is no place on earth")
            crs = crs if lat == lon == 0.0 else f"ENU:{lat!r},{lon!r},{alt!r}"
        cameras = Cameras(
            labels=tuple(shots),
            centres=checks.centres(rotations, shifts),
            rotations=rotations,
            lenses=tuple(lenses[shot["camera"]] for shot in shots.values()),
            crs=crs,
            gnss=None if crs == "local" else checks.measured([*shots], places, crs),
            unposed=unnamed(others, shots),
        )
        return cameras, chosen.get("points", {})


# By names of `checks`, besides the focal lengths and the principal point of every model.
_MODELS = {
    "perspective": LensModel("k1 k2"),
    "simple_radial": LensModel("k1"),
    "radial": LensModel("k1 k2"),
    "brown": LensModel("k1 k2 k3 p1 p2"),
    "fisheye": LensModel("k1 k2", "equidistant"),
    "fisheye_opencv": LensModel("k1 k2 k3 k4", "equidistant"),
    "fisheye62": LensModel("k1 k2 k3 k4 k5 k6 p1 p2", "equidistant"),
    "fisheye624": LensModel("k1 k2 k3 k4 k5 k6 p1 p2 s1 s2 s3 s4", "equidistant"),
    "dual": LensModel("k1 k2 transition", "dual"),
}
_CALLED = {"dx": "c_x", "dy": "c_y", "p1": "p2", "p2": "p1"}
_CALLED |= {"s1": "s0", "s2": "s1", "s3": "s2", "s4": "s3"}
"""What OpenSfM calls what has another name in `checks`."""


def lens(path: Path, name: str, camera: dict[str, Any]) -> Lens:
    """Return the lens of an entry of `cameras`."""
    kind = str(camera.get("projection_type", "perspective"))
    if kind not in _MODELS:
        remedy = f"Remove its images, or use one of {', '.join(_MODELS)}"
        what = f"the projection_type '{kind}' of camera {name}"
        raise checks.unsupported(path, what, remedy, model=kind, camera=name)
    model, camera = _MODELS[kind], {"transition": 0.5} | camera  # 0.5 where OpenSfM omits it
    frame = (float(camera.get(side, 0.0)) for side in ("width", "height"))
    names = ("dx", "dy", *model.names.split())
    given = {one: float(camera.get(_CALLED.get(one, one), 0.0)) for one in names}
    across: Any = camera.get("focal_x", camera.get("focal"))
    given |= {"fx": float(across), "fy": float(camera.get("focal_y", across))}
    return model.lens(given, *frame, relative=True, sensor=name)

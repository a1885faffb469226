"""COLMAP's sparse models, as text or binary.

A model is a folder with ``cameras``, ``images`` and ``points3D``, all ``.bin`` or all ``.txt``;
from COLMAP 3.12 on with ``rigs`` and ``frames`` too, which are not needed, as ``images`` has the
pose of every image in rigs also. Definition: https://colmap.github.io/format.html.

A pose is a unit quaternion, scalar first, and a translation, both world to camera, in OpenCV
axes: ``x_cam = R x + t``, so the projection centre is ``-R' t``. Pixels start at the upper left
corner of the upper left pixel. The world is that of the alignment, if there was one, often minus an
offset; the files name no CRS, so it is None, unless ``georeference.json`` of pcfix lies beside
them (``crs``, text or null, ``offset_m``, three numbers, ``written_by``): its offset is then added
to centres and tie points, and its CRS is theirs. `files` has the lenses.

Images keep the order of the file. An image point belongs to the point in space whose identifier it
has, -1 for none; ``points3D`` lists the same as tracks.

Where the GNSS said the cameras were is in ``database.db`` (SQLite). Table ``pose_priors`` has a row
for an image (``image_id``; from COLMAP 4 on ``corr_data_id`` with the type of the sensor, 0 a
camera), the position as three doubles, its covariance as nine, and the coordinate system: 0 is
WGS84 with latitude, longitude, height, 1 is Cartesian, -1 not defined. The covariance is of metres
east, north, up, or of the Cartesian axes (https://colmap.github.io/database.html and
``src/colmap/geometry/pose_prior.h``).

Models are written in binary, without ``rigs`` and ``frames``, which COLMAP makes itself. Images
and cameras are numbered from 1 in the order of the block, points in the order of the tie points.
Positions are written minus an offset, which ``georeference.json`` keeps.
"""

from __future__ import annotations

import json
import re
import sqlite3
import struct
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pcfix.errors import PcfixWarning
from pcfix.io.cameras import checks, tracks
from pcfix.io.cameras.checks import block_to_write, is_same_lens, lens_not_held, write_new
from pcfix.io.cameras.colmap import files
from pcfix.io.cameras.colmap.files import BY_NAME, MODELS, OBSERVATION, SHAPES, Camera, lens
from pcfix.io.cameras.formats import Source
from pcfix.io.cameras.tracks import NO_TIE_POINTS, are_seen
from pcfix.io.crs import is_topocentric
from pcfix.model import Cameras, FloatArray, GnssPositions, IntArray, Lens, TiePoints
from pcfix.options.declare import File

_PART = re.compile(r"(cameras|images|points3D|rigs|frames)\.(bin|txt)")
_CAMERA_LINE = re.compile(r"^\s*\d+\s+[A-Z][A-Z_0-9]+(\s+\S+){2}", re.MULTILINE)
FILE, WRITER = "georeference.json", "pcfix"
_DATABASE, _FOLDERS_ABOVE = "database.db", 3
_WGS84 = 0


class Model(NamedTuple):
    """Where a model lies; `others` counts further ones beside it."""

    folder: Path
    suffix: str
    others: int = 0

    def part(self, name: str) -> Path:
        """Return the path of one of its files."""
        return self.folder / f"{name}.{self.suffix}"


def recognises(source: Source) -> bool:
    """Whether it is a model, one of its files, or a folder above that has one."""
    return _find(source.path) is not None


def read(source: Source) -> Cameras:
    """Read the poses of registered images and their lenses."""
    model = _model(source)
    listed, path = model.part("cameras"), model.part("images")
    cameras = files.read_cameras(listed)
    images = files.read_images(path, points=False)
    posed = [image for image in images if image.posed]
    if not posed:
        raise checks.no_pose(path)
    poses = np.array([image.pose for image in posed])
    labels = tuple(image.name for image in posed)
    rotations = checks.quaternions(path, labels, poses[:, :4])
    used = dict.fromkeys(image.camera for image in posed)
    lenses = {number: files.lens(listed, number, cameras[number]) for number in used}
    gnss, notes = read_priors(model.folder, labels)
    offset, crs = read_place(model.folder)
    if offset.any() and gnss is not None and gnss.crs is None:
        gnss = None  # of the model that the database found, which this one may not be
    if model.others:
        notes = (checks.several(model.folder, model.others + 1, len(posed)), *notes)
    return Cameras(
        labels=labels,
        centres=checks.centres(rotations, poses[:, 4:]) + offset,
        rotations=rotations,
        lenses=tuple(lenses[image.camera] for image in posed),
        crs=crs,
        notes=notes,
        gnss=gnss,
        unposed=tuple(image.name for image in images if not image.posed),
        source="COLMAP",
    )


def tie_points(source: Source, cameras: Cameras) -> TiePoints:
    """Read the points in space and where the images saw them."""
    model = _model(source)
    path = model.part("points3D")
    if not path.is_file():
        raise tracks.no_tie_points(path, "there is no such file")
    identifiers, xyz = files.read_points(path)
    images = [i for i in files.read_images(model.part("images"), points=True) if i.posed]
    seen = np.concatenate([image.seen for image in images])
    if not len(identifiers) or not len(seen):
        raise tracks.no_tie_points(path, "the model has no points that its images saw")
    camera = np.repeat(np.arange(len(cameras)), [len(image.seen) for image in images])
    order, rising = np.argsort(identifiers), np.argsort(seen["point"])
    place = np.empty(len(seen), np.int64)  # a search in rising order is far quicker
    place[rising] = np.searchsorted(identifiers[order], seen["point"][rising])
    row = order[np.minimum(place, len(order) - 1)]
    known = identifiers[row] == seen["point"]
    xyz = xyz + read_place(model.folder)[0]
    return tracks.tie_points(tracks.Seen(xyz, row[known], camera[known], seen["xy"][known]))


def _model(source: Source) -> Model:
    found = _find(source.path)
    if found is None:
        raise checks.missing(source.path / "cameras.bin")
    return found


def _find(path: Path) -> Model | None:
    """Return the model in a folder, in its ``sparse`` or, of several, the largest there."""
    if not path.is_dir():
        part = _PART.fullmatch(path.name)
        return _in_folder(path.parent, part[2]) if part else None
    for folder in (path, path / "sparse"):
        found = _in_folder(folder, "bin", "txt")
        if found or not folder.is_dir():
            return found
        numbered = [p for p in folder.iterdir() if p.name.isdecimal()]
        models = [m for p in numbered if (m := _in_folder(p, "bin", "txt"))]
        if models:
            models.sort(key=lambda m: (-m.part("images").stat().st_size, m.folder.name))
            return models[0]._replace(others=len(models) - 1)
    return None


def _in_folder(folder: Path, *suffixes: str) -> Model | None:
    for model in (Model(folder, suffix) for suffix in suffixes):
        cameras = model.part("cameras")
        if cameras.is_file() and model.part("images").is_file():
            with cameras.open(encoding="utf-8-sig", errors="replace") as stream:
                if model.suffix == "bin" or _CAMERA_LINE.search(stream.read(4096)):
                    return model
    return None


def read_place(folder: Path) -> tuple[FloatArray, str | None]:
    """Return the offset of a model's positions and their CRS, from pcfix's file beside it."""
    path = folder / FILE
    with checks.reading(path):
        found = checks.load_json(path) if path.is_file() else None
        if not isinstance(found, dict) or found.get("written_by") != WRITER:
            return np.zeros(3), None
        offset, crs = checks.triple(found["offset_m"]), found["crs"]
        if not np.isfinite(offset).all() or not isinstance(crs, str | None):
            raise checks.damaged(path, "it needs offset_m, three numbers, and crs")
    return offset, crs if crs is None or is_topocentric(crs) else checks.crs(path, crs)


def place_text(offset_m: FloatArray, crs: str | None) -> str:
    """Return the content of the file."""
    place = {"crs": crs, "offset_m": [float(value) for value in offset_m], "written_by": WRITER}
    return json.dumps(place, indent=2) + "\n"


def read_priors(
    model: Path, labels: Sequence[str]
) -> tuple[GnssPositions | None, tuple[PcfixWarning, ...]]:
    """Return the priors of images from the database beside or above a model, and notes on it."""
    places = (model, *model.resolve().parents[:_FOLDERS_ABOVE])
    path = next((p / _DATABASE for p in places if (p / _DATABASE).is_file()), None)
    if path is None:
        return None, ()
    try:
        rows = _rows(path)
    except sqlite3.Error as error:
        sentence = f"its pose priors cannot be read ({error}). They are skipped."
        return None, (checks.note(path, "cameras.priors_left_out", sentence),)
    row_of = {label: i for i, label in enumerate(labels)}
    found = [(row_of[name], *row) for name, *row in rows if name in row_of]
    systems = {system for *_, system in found}
    if len(systems) > 1:
        sentence = "its pose priors are in several coordinate systems. They are skipped."
        return None, (checks.note(path, "cameras.priors_left_out", sentence),)
    xyz, sigma = np.full((2, len(labels), 3), np.nan)
    for i, position, covariance, _ in found:
        xyz[i] = np.frombuffer(position, "<f8")
        if isinstance(covariance, bytes) and len(covariance) == 9 * 8:
            variances = np.frombuffer(covariance, "<f8").reshape(3, 3).diagonal()
            sigma[i] = np.sqrt(np.where(variances >= 0.0, variances, np.nan))
    xyz[~np.isfinite(xyz).all(axis=1)] = np.nan
    if np.isnan(xyz).all():
        return None, ()
    if systems == {_WGS84}:
        return GnssPositions(xyz[:, [1, 0, 2]], sigma, "EPSG:4979"), ()
    return GnssPositions(xyz, sigma, None), ()


def _rows(path: Path) -> list[tuple[Any, ...]]:
    """Return name, position, covariance and coordinate system; nothing is written or locked."""
    whole = not path.with_name(path.name + "-wal").exists()
    uri = path.resolve().as_uri() + ("?immutable=1" if whole else "?mode=ro")
    with closing(sqlite3.connect(uri, uri=True, timeout=1.0)) as database:
        columns = {row[1] for row in database.execute("PRAGMA table_info(pose_priors)")}
        if not columns:
            return []
        image = "corr_data_id" if "corr_data_id" in columns else "image_id"
        camera = "corr_sensor_type = 0" if "corr_sensor_type" in columns else "1"
        return database.execute(
            "SELECT images.name, position, position_covariance, coordinate_system"
            f" FROM pose_priors JOIN images ON images.image_id = pose_priors.{image}"
            f" WHERE {camera} AND typeof(position) = 'blob' AND length(position) = 24"
            " AND typeof(images.name) = 'text'"
        ).fetchall()


PREFERRED = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"),
    *("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE", "THIN_PRISM_FISHEYE"),
    *("RAD_TAN_THIN_PRISM_FISHEYE", "FOV", "SIMPLE_DIVISION", "DIVISION", "EUCM"),
)
"""The simplest first; those that only new versions of COLMAP know come last."""
GREY = (128, 128, 128)
ROUND_M = 100.0


def write_colmap(
    folder: File,
    cameras: Cameras,
    tie_points: TiePoints | None = None,
    *,
    offset_m: tuple[float, float, float] | None = None,
    crs: str | None = None,
) -> None:
    """Write a block as a binary COLMAP model.

    Parameters
    ----------
    folder : path
        Made if need be.
    cameras : Cameras
        With rotations and lenses in pixels.
    tie_points : TiePoints, optional
        In the frame of the cameras; those without a position or without a view are left out.
    offset_m : tuple of 3 float, optional
        Taken off all positions. Default: the middle of the block, to `ROUND_M`.
    crs : str, optional
        Default: that of the cameras.
    """
    from scipy.spatial.transform import Rotation

    target = Path(folder)
    _, lenses = block_to_write(  # a file would cut off other names
        target, cameras, lambda name: name == name.strip() != "" and not {"\0", "\n"} & {*name}
    )
    middle = np.median(cameras.centres, axis=0)
    middle[2] = 0.0  # heights are small, and easier to read as they are
    offset = np.asarray(np.round(middle / ROUND_M) * ROUND_M if offset_m is None else offset_m)
    distinct = list(dict.fromkeys(lenses))
    number = {lens: i for i, lens in enumerate(distinct, start=1)}
    ties = tie_points or NO_TIE_POINTS
    kept, counts = are_seen(ties), np.diff(ties.views.start)
    of_kept = np.repeat(kept, counts)
    camera = ties.views.camera[of_kept]
    order = np.argsort(camera, kind="stable")  # COLMAP lists the image points image by image
    seen = np.empty(len(camera), OBSERVATION)
    seen["xy"] = ties.image_xy[of_kept][order]
    seen["point"] = np.repeat(np.cumsum(kept), counts)[of_kept][order]
    start = np.concatenate([[0], np.cumsum(np.bincount(camera, minlength=len(cameras)))])
    listed = [struct.pack("<Q", len(distinct))]
    for i, camera_of in enumerate((colmap_camera(target, one) for one in distinct), start=1):
        size = int(camera_of.width), int(camera_of.height)
        listed.append(struct.pack("<IiQQ", i, MODELS.index(camera_of.model), *size))
        listed.append(np.array(camera_of.values, "<f8").tobytes())
    rotations = np.asarray(cameras.rotations)
    turns = np.roll(Rotation.from_matrix(rotations).as_quat(canonical=True), 1, axis=1)
    shifts = -np.einsum("kij,kj->ki", rotations, cameras.centres - offset)
    images = [struct.pack("<Q", len(cameras))]
    for i, (label, one) in enumerate(zip(cameras.labels, lenses, strict=True)):
        first, last = start[i : i + 2]
        images.append(struct.pack("<I7dI", i + 1, *turns[i], *shifts[i], number[one]))
        images.append(label.encode() + b"\0" + struct.pack("<Q", last - first))
        images.append(seen[first:last].tobytes())
    contents = {
        "cameras.bin": b"".join(listed),
        "images.bin": b"".join(images),
        "points3D.bin": _points(ties.xyz[kept] - offset, seen["point"], start),
        FILE: place_text(offset, crs or cameras.crs).encode(),
    }
    write_new(target, contents)


def colmap_camera(path: Path, given: Lens) -> Camera:
    """Return the simplest of COLMAP's cameras that is exactly this lens."""
    whole = float(given.width).is_integer() and float(given.height).is_integer()
    if given.unit == "px" and whole:
        lists = (
            ("f", (given.focal,)),
            ("fx fy", (given.focal + given.b1, given.focal)),
            ("cx cy", (given.principal_x, given.principal_y)),
            ("k1 k2 k3 k4 k5 k6", given.radial),
            ("d1 d2 d3", given.denominator),
            ("p2 p1", given.tangential),
            ("s1 s2 s3 s4", given.thin_prism),
            (" ".join(SHAPES.get(given.projection, ())), given.shape),
        )
        values = {key: v for keys, vs in lists for key, v in zip(keys.split(), vs, strict=False)}
        for model in PREFERRED:
            names, projection = BY_NAME[model]
            numbers = tuple(values.get(name, 0.0) for name in names)
            camera = Camera(model, given.width, given.height, numbers)
            if projection == given.projection and is_same_lens(lens(path, 1, camera), given):
                return camera
    raise lens_not_held(path, given)


def _points(xyz: FloatArray, point: IntArray, image_start: IntArray) -> bytes:
    """Return the points, each with image number and number in the image of its views; no errors."""
    image = np.repeat(np.arange(len(image_start) - 1), np.diff(image_start))
    within = np.arange(len(image)) - image_start[image]
    order = np.argsort(point, kind="stable")
    views = np.column_stack([image + 1, within])[order].astype("<u4")
    start = np.cumsum(np.bincount(point, minlength=len(xyz) + 1))
    parts = [struct.pack("<Q", len(xyz))]
    for i, place in enumerate(xyz):
        first, last = start[i : i + 2]
        parts.append(struct.pack("<Q3d3BdQ", i + 1, *place, *GREY, 0.0, last - first))
        parts.append(views[first:last].tobytes())
    return b"".join(parts)

"""COLMAP's sparse models, as text or binary.

A model is a folder with ``cameras``, ``images`` and ``points3D``, all ``.bin`` or all ``.txt``;
``rigs`` and ``frames`` (COLMAP 3.12 and later) repeat them. Definition:
https://colmap.github.io/format.html. A pose is a unit quaternion, scalar first, and a translation,
both world to camera, in OpenCV axes: ``x_cam = R x + t``. Pixels start at the upper left corner of
the upper left pixel. An image point has the identifier of its point in space, -1 for none;
``points3D`` lists the same as tracks.

The parameters of a camera are those of https://colmap.github.io/cameras.html and, for newer models,
``src/colmap/sensor/models`` of COLMAP 4. p1 and p2 are in OpenCV's order, except in the model of
Project Aria's cameras (RAD_TAN_THIN_PRISM_FISHEYE), where they are in Brown's and the tangential
and prism terms are of the radially distorted place.

The files name no CRS. pcfix writes positions minus an offset, and both to ``georeference.json``
(``crs``, text or null, ``offset_m``, three numbers, ``written_by``), which it also reads. It writes
binary models; images and cameras are numbered from 1 in the order of the block, points in the order
of the tie points.
"""

import json
import mmap
import os
import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pcfix.errors import bad_file
from pcfix.io.cameras import checks
from pcfix.io.cameras.checks import LensModel, Source, damaged, model_of
from pcfix.io.crs import is_topocentric
from pcfix.model import Cameras, FloatArray, IntArray, Lens, TiePoints
from pcfix.options.declare import File

FILE, WRITER = "georeference.json", "pcfix"


def recognises(source: Source) -> bool:
    """Whether it is a model, one of its files, or a folder above that has one."""
    return bool(_models_at(source.path))


def read(source: Source) -> Cameras:
    """Read the poses of registered images and their lenses."""
    listed, *others = _models_at(source.path)
    path, folder = listed.with_stem("images"), listed.parent
    lens_of, images = read_lenses(listed), read_images(path, points=False)
    poses = np.array([image.pose for image in images]).reshape(-1, 7)
    labels = tuple(image.name for image in images)
    rotations = checks.quaternions(path, labels, poses[:, :4])
    lenses = tuple(lens_of[image.camera] for image in images)
    offset, crs = read_place(folder)
    checks.warn_several(folder, len(others) + 1, len(images))
    return Cameras(labels, checks.centres(rotations, poses[:, 4:]) + offset, rotations, lenses, crs)


def tie_points(source: Source, cameras: Cameras) -> TiePoints:
    """Read the points in space and where the images saw them."""
    listed = _models_at(source.path)[0]
    path = listed.with_stem("points3D")
    if not path.is_file():
        raise checks.no_tie_points(path, "there is no such file")
    identifiers, xyz = read_points(path)
    images = read_images(listed.with_stem("images"), points=True)
    seen = np.concatenate([image.seen for image in images])
    camera = np.repeat(np.arange(len(cameras)), [len(image.seen) for image in images])
    xyz = xyz + read_place(listed.parent)[0]
    row = checks.rows_of(seen["point"], identifiers)
    return checks.tie_points(checks.Observations(xyz, row, camera, seen["xy"]))


def _models_at(path: Path) -> list[Path]:
    """Return the camera lists of the models in a folder or its ``sparse``, the largest first."""
    if not path.is_dir():
        part = re.fullmatch(r"(cameras|images|points3D|rigs|frames)\.(bin|txt)", path.name)
        listed = path.with_name(f"cameras.{part[2] if part else ''}")
        return [listed] if _is_model(listed) else []
    for folders in ([path], path.glob("[0-9]*"), [path / "sparse"], path.glob("sparse/[0-9]*")):
        lists = ([one / "cameras.bin", one / "cameras.txt"] for one in folders)
        found = [found for two in lists if (found := next(filter(_is_model, two), None))]
        if found:
            size = {one: one.with_stem("images").stat().st_size for one in found}
            return sorted(found, key=lambda one: (-size[one], one.parent.name))
    return []


def _is_model(listed: Path) -> bool:
    """Whether there are a list of cameras and one of images."""
    return listed.is_file() and listed.with_stem("images").is_file()


def read_place(folder: Path) -> tuple[FloatArray, str | None]:
    """Return the offset of a model's positions and their CRS, from pcfix's file next to it."""
    path = folder / FILE
    with checks.reading(path):
        found = checks.load_json(path) if path.is_file() else {}
        if found.get("written_by") != WRITER:
            return np.zeros(3), None
        offset, crs = checks.triple(found["offset_m"]), found["crs"]
        return offset, crs if crs is None or is_topocentric(crs) else checks.crs(path, crs)


# In the order of their numbers in binary files, from 0; the names are those of `checks`.
BY_NAME = {
    "SIMPLE_PINHOLE": LensModel("f cx cy"),
    "PINHOLE": LensModel("fx fy cx cy"),
    "SIMPLE_RADIAL": LensModel("f cx cy k1"),
    "RADIAL": LensModel("f cx cy k1 k2"),
    "OPENCV": LensModel("fx fy cx cy k1 k2 p2 p1"),
    "OPENCV_FISHEYE": LensModel("fx fy cx cy k1 k2 k3 k4", "equidistant"),
    "FULL_OPENCV": LensModel("fx fy cx cy k1 k2 p2 p1 k3 d1 d2 d3"),
    "FOV": LensModel("fx fy cx cy omega", "fov"),
    "SIMPLE_RADIAL_FISHEYE": LensModel("f cx cy k1", "equidistant"),
    "RADIAL_FISHEYE": LensModel("f cx cy k1 k2", "equidistant"),
    "THIN_PRISM_FISHEYE": LensModel("fx fy cx cy k1 k2 p2 p1 k3 k4 s1 s3", "equidistant"),
    "RAD_TAN_THIN_PRISM_FISHEYE": LensModel(
        "fx fy cx cy k1 k2 k3 k4 k5 k6 p1 p2 s1 s2 s3 s4", "equidistant", in_turn=True
    ),
    "SIMPLE_DIVISION": LensModel("f cx cy k", "division"),
    "DIVISION": LensModel("fx fy cx cy k", "division"),
    "SIMPLE_FISHEYE": LensModel("f cx cy", "equidistant"),
    "FISHEYE": LensModel("fx fy cx cy", "equidistant"),
    "EUCM": LensModel("fx fy cx cy alpha beta", "eucm"),
}
MODELS = tuple(BY_NAME)


def make_lens(path: Path, camera: object, name: str, numbers: Any) -> Lens:
    """Return the lens of a camera; the numbers are width, height (pixels) and parameters."""
    if name not in BY_NAME:
        what, remedy = f"the model {name} of camera {camera}", "Give the undistorted model"
        raise checks.unsupported(path, what, remedy, model=name)
    width, height, *parameters = map(float, numbers)
    given = dict(zip(BY_NAME[name].names.split(), parameters, strict=True))
    return BY_NAME[name].lens(given, width, height, sensor=f"{camera} {name}")


class Image(NamedTuple):
    """A row of the image list.

    `pose` is qw, qx, qy, qz, tx, ty, tz. `seen` has the image points that have a point in space,
    and the identifiers of those; it is empty where they were not asked for.
    """

    identifier: int
    pose: tuple[float, ...]
    camera: int
    name: str
    seen: np.ndarray


OBSERVATION = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
_COUNT, _CAMERA, _IMAGE = struct.Struct("<Q"), struct.Struct("<IiQQ"), struct.Struct("<I7dI")
# Of a point its number, place and count of views, without colour and error.
_POINT, _VIEW_BYTES = struct.Struct("<Q3d11xQ"), 8


def _take(file: mmap.mmap, form: struct.Struct) -> tuple[Any, ...]:
    """Return the next numbers of a binary file."""
    return form.unpack(file.read(form.size))


def _open(path: Path) -> mmap.mmap:
    """Map a binary file, until nothing refers to it any more."""
    with path.open("rb") as stream:
        return mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)


def _lines(path: Path) -> Iterator[str]:
    """Yield the lines of a text file, blank ones too, but no comments."""
    with path.open(encoding="utf-8-sig", errors="replace") as stream:
        for line in stream:
            if not line.lstrip().startswith("#"):
                yield line.strip()


def read_lenses(path: Path) -> dict[int, Lens]:
    """Read ``cameras``, binary or text: identifier, model, width, height, parameters."""
    lenses: dict[int, Lens] = {}
    with checks.reading(path):
        if path.suffix == ".bin":
            file = _open(path)
            for _ in range(*_take(file, _COUNT)):
                number, model, *frame = _take(file, _CAMERA)
                name = MODELS[model] if 0 <= model < len(MODELS) else str(model)
                count = len(BY_NAME[name].names.split()) if name in BY_NAME else 0
                values = _take(file, struct.Struct(f"<{count}d"))
                lenses[number] = make_lens(path, number, name, (*frame, *values))
            return lenses
        for number, name, *words in filter(None, map(str.split, _lines(path))):
            lenses[int(number)] = make_lens(path, number, name, words)
    return lenses


def read_images(path: Path, *, points: bool) -> list[Image]:
    """Read ``images``; the image points only where they are asked for."""
    with checks.reading(path):
        if path.suffix == ".bin":
            file, images = _open(path), []
            for _ in range(*_take(file, _COUNT)):
                identifier, *pose, camera = _take(file, _IMAGE)
                end = file.find(b"\0", file.tell()) + 1
                name = file.read(end - file.tell())[:-1].decode("utf-8", "replace")
                (count,) = _take(file, _COUNT)
                seen = np.empty(0, OBSERVATION)
                if points and count:
                    seen = np.frombuffer(file, OBSERVATION, count, file.tell())
                    seen = seen[seen["point"] >= 0]
                file.seek(count * OBSERVATION.itemsize, os.SEEK_CUR)
                images.append(Image(identifier, tuple(pose), camera, name, seen))
            return images
        images, lines = [], _lines(path)
        for line in filter(None, lines):
            identifier, *pose, camera, name = line.split(None, 9)
            below = next(lines, "")
            if below:
                int(below.rsplit(None, 1)[-1])  # the line of the next image would end with a name
            rows = np.array(below.split() if points else (), float).reshape(-1, 3)
            rows = rows[rows[:, 2] >= 0]
            seen = np.empty(len(rows), OBSERVATION)
            seen["xy"], seen["point"] = rows[:, :2], rows[:, 2]
            images.append(Image(int(identifier), tuple(map(float, pose)), int(camera), name, seen))
        return images


def read_points(path: Path) -> tuple[IntArray, FloatArray]:
    """Read identifiers and places of ``points3D``; the tracks are in the images too."""
    with checks.reading(path):
        rows: list[list[Any]] = []
        if path.suffix == ".bin":
            data, at = _open(path), _COUNT.size
            for _ in range(*_take(data, _COUNT)):
                *row, views = _POINT.unpack_from(data, at)
                rows.append(row)
                at += _POINT.size + _VIEW_BYTES * views
            if at > len(data):
                raise damaged(path, "its last point has too few views")
        else:
            rows = [line.split(None, 4)[:4] for line in _lines(path) if line]
        places = np.array([row[1:] for row in rows], float).reshape(-1, 3)
        return np.array([int(row[0]) for row in rows], np.int64), places


# Models that are written: older versions of COLMAP do not know the two others.
WRITTEN = {k: model for k, model in BY_NAME.items() if k not in ("SIMPLE_FISHEYE", "FISHEYE")}


def write_colmap(folder: File, cameras: Cameras, tie_points: TiePoints | None = None) -> None:
    """Write a block as a binary COLMAP model, positions minus the middle of the block.

    The folder need not exist. The tie points are in the frame of the cameras; those without a
    position or without a view are skipped.
    """
    target = Path(folder)
    turns, lenses = checks.block_to_write(target, cameras)
    for label in cameras.labels:  # the format would cut other names
        if not label == label.strip() != "" or {"\0", "\n"} & {*label}:
            sentence = f"the format cannot hold the image name {label!r}. Rename the image."
            raise bad_file(target, "output.label", sentence, image=label)
    middle = np.median(cameras.centres, axis=0)
    middle[2] = 0.0  # heights are small numbers
    offset = np.round(middle / 100.0) * 100.0
    # COLMAP lists observations by image, and in tracks as number of the image and place in its list
    seen: list[list[tuple[list[float], int]]] = [[] for _ in cameras.labels]
    points = list[bytes]()
    if tie_points is not None:
        xyz, start = tie_points.xyz - offset, tie_points.views.start
        for row in np.flatnonzero(np.isfinite(xyz).all(axis=1) & (np.diff(start) > 0)).tolist():
            views, track = slice(*start[row : row + 2]), list[int]()
            number = len(points) + 1
            images = tie_points.views.camera[views].tolist()
            for image, uv in zip(images, tie_points.image_xy[views].tolist(), strict=True):
                track += [image + 1, len(seen[image])]
                seen[image].append((uv, number))
            grey = (128, 128, 128)
            head = struct.pack("<Q3d3BdQ", number, *xyz[row], *grey, 0.0, len(images))
            points.append(head + struct.pack(f"<{len(track)}I", *track))
    number_of = {lens: i for i, lens in enumerate(dict.fromkeys(lenses), start=1)}
    listed = list[bytes]()
    for lens, i in number_of.items():
        model, values = model_of(target, lens, WRITTEN, integer=True)
        size = int(lens.width), int(lens.height)
        listed.append(struct.pack("<IiQQ", i, MODELS.index(model), *size))
        listed.append(np.array([*values.values()], "<f8").tobytes())
    shifts = -np.einsum("kij,kj->ki", np.asarray(cameras.rotations), cameras.centres - offset)
    posed = list[bytes]()
    for i, (label, lens) in enumerate(zip(cameras.labels, lenses, strict=True)):
        posed.append(struct.pack("<I7dI", i + 1, *turns[i], *shifts[i], number_of[lens]))
        posed.append(label.encode() + b"\0" + struct.pack("<Q", len(seen[i])))
        posed.append(np.array(seen[i], OBSERVATION).tobytes())
    place = {"crs": cameras.crs, "offset_m": offset.tolist(), "written_by": WRITER}
    contents = {
        "cameras.bin": struct.pack("<Q", len(number_of)) + b"".join(listed),
        "images.bin": struct.pack("<Q", len(cameras)) + b"".join(posed),
        "points3D.bin": struct.pack("<Q", len(points)) + b"".join(points),
        FILE: (json.dumps(place, indent=2) + "\n").encode(),
    }
    checks.write_new(target, contents)

"""Write a block as a COLMAP model, text or binary.

The layout is that of `pcfix.io.cameras.colmap`, without ``rigs`` and ``frames``, which COLMAP makes
itself for models that have none. Images and cameras are numbered from 1 in the order of the block,
points in the order of the tie points. Positions are written minus an offset, which
``georeference.json`` keeps.
"""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pcfix.errors import InputError, SettingError
from pcfix.io.cameras.checks import is_same_lens
from pcfix.io.cameras.colmap import FILE, place_text
from pcfix.io.cameras.colmap.files import BY_NAME, MODELS, Camera, lens
from pcfix.io.files import check_output, write_bytes
from pcfix.model import Cameras, FloatArray, IntArray, Lens, TiePoints

PREFERRED = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"),
    *("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE", "THIN_PRISM_FISHEYE"),
    *("RAD_TAN_THIN_PRISM_FISHEYE", "FOV", "SIMPLE_DIVISION", "DIVISION", "EUCM"),
)
"""The simplest first; those that only new versions of COLMAP know come last."""
PARTS = ("cameras", "images", "points3D")
GREY = (128, 128, 128)
ROUND_M = 100.0


class Block(NamedTuple):
    """What is written: all that the files have, in their order.

    camera_of : row of `cameras` of each image.
    quaternions : array, shape (k, 4), the scalar first.
    translations : array, shape (k, 3).
    points : array, shape (m, 3), minus the offset; `error_px` (m,).
    xy, point : of the image points, (o, 2) and (o,), image by image.
    image_start : array, shape (k + 1,), where each image's begin.
    """

    labels: tuple[str, ...]
    cameras: list[Camera]
    camera_of: IntArray
    quaternions: FloatArray
    translations: FloatArray
    points: FloatArray
    error_px: FloatArray
    xy: FloatArray
    point: IntArray
    image_start: IntArray


def write_colmap(
    folder: str | os.PathLike[str],
    cameras: Cameras,
    tie_points: TiePoints | None = None,
    *,
    binary: bool = True,
    offset_m: tuple[float, float, float] | None = None,
    crs: str | None = None,
    overwrite: bool = False,
    error_px: FloatArray | None = None,
) -> None:
    """Write a block as a COLMAP model.

    Parameters
    ----------
    folder : path
        Made if need be.
    cameras : Cameras
        With rotations and lenses in pixels.
    tie_points : TiePoints, optional
        In the frame of the cameras; those without a position or without a view are left out.
    binary : bool
        ``.bin`` or ``.txt``.
    offset_m : tuple of 3 float, optional
        Taken off all positions. Default: the middle of the block, to `ROUND_M`.
    crs : str, optional
        Default: that of the cameras.
    overwrite : bool
    error_px : array, shape (m,), optional
        Mean reprojection error of each tie point. Default: 0.

    Raises
    ------
    InputError
        If a lens is none that COLMAP has, or the cameras have no rotations.
    SettingError
        If a file exists and `overwrite` is not set, or the folder holds another model.
    """
    target = Path(folder)
    offset = _middle(cameras) if offset_m is None else np.asarray(offset_m, np.float64)
    block = _block(target, cameras, tie_points, offset, error_px)
    suffix = "bin" if binary else "txt"
    _check_names(target, cameras.labels, binary=binary)
    _check_folder(target, suffix, overwrite=overwrite)
    target.mkdir(parents=True, exist_ok=True)
    make = (_cameras_bin, _images_bin, _points_bin)
    if not binary:
        make = (_cameras_txt, _images_txt, _points_txt)
    data = [(f"{part}.{suffix}", each(block)) for part, each in zip(PARTS, make, strict=True)]
    data.append((FILE, place_text(offset, crs or cameras.crs).encode()))
    for name, content in data:
        write_bytes(target / name, content, overwrite=overwrite)


def _middle(cameras: Cameras) -> FloatArray:
    middle = np.median(cameras.centres, axis=0)
    middle[2] = 0.0  # heights are small, and easier to read as they are
    return np.asarray(np.round(middle / ROUND_M) * ROUND_M)


def _check_names(folder: Path, labels: tuple[str, ...], *, binary: bool) -> None:
    """Refuse names that a file would cut off; COLMAP takes the first word of a text's."""
    for label in labels:
        if not label.strip() or "\0" in label or "\n" in label or label != label.strip():
            raise InputError(f"{folder}: the image name {label!r} has no place in COLMAP's files.")
        if not binary and len(label.split()) > 1:
            raise InputError(
                f"{folder}: the image name {label!r} has a space, where COLMAP's text files would"
                " end it; write the binary form."
            )


def _check_folder(folder: Path, suffix: str, *, overwrite: bool) -> None:
    """Refuse files that must not be replaced, and others that would not belong to the model."""
    if folder.exists() and not folder.is_dir():
        raise SettingError(f"{folder}: is a file; give a folder for the COLMAP model.")
    if not folder.exists():
        return
    for name in (*(f"{part}.{suffix}" for part in PARTS), FILE):
        check_output(folder / name, overwrite=overwrite)
    other = "txt" if suffix == "bin" else "bin"
    strange = [f"{part}.{other}" for part in PARTS]
    strange += [f"{part}.{each}" for part in ("rigs", "frames") for each in ("bin", "txt")]
    there = [name for name in strange if (folder / name).exists()]
    if there:
        raise SettingError(
            f"{folder}: holds {there[0]} of another COLMAP model, which would be taken for part of"
            " this one; give another folder."
        )


def _block(
    target: Path,
    cameras: Cameras,
    tie_points: TiePoints | None,
    offset: FloatArray,
    error_px: FloatArray | None,
) -> Block:
    from scipy.spatial.transform import Rotation

    if cameras.rotations is None or cameras.lenses is None:
        raise InputError(f"{target}: a COLMAP model needs rotations and lenses of all images.")
    distinct = list(dict.fromkeys(cameras.lenses))
    models = [colmap_camera(target, each) for each in distinct]
    number = {each: i for i, each in enumerate(distinct)}
    turn = Rotation.from_matrix(cameras.rotations)
    shift = -np.einsum("kij,kj->ki", cameras.rotations, cameras.centres - offset)
    points, error, xy, point, camera = _observations(tie_points, offset, error_px)
    order = np.argsort(camera, kind="stable")
    counts = np.bincount(camera, minlength=len(cameras))
    return Block(
        labels=cameras.labels,
        cameras=models,
        camera_of=np.array([number[each] for each in cameras.lenses]),
        quaternions=np.roll(turn.as_quat(canonical=True), 1, axis=1),
        translations=shift,
        points=points,
        error_px=error,
        xy=xy[order],
        point=point[order],
        image_start=np.concatenate([[0], np.cumsum(counts)]),
    )


def _observations(
    tie_points: TiePoints | None, offset: FloatArray, error_px: FloatArray | None
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray, IntArray]:
    """Return points with a place and a view, their errors, and xy, point, camera of each view."""
    if tie_points is None:
        none = np.empty(0, np.int64)
        return np.empty((0, 3)), np.empty(0), np.empty((0, 2)), none, none
    start = tie_points.views.start
    counts = np.diff(start)
    kept = np.isfinite(tie_points.xyz).all(axis=1) & (counts > 0)
    point = np.repeat(np.cumsum(kept) - 1, counts)
    seen = np.repeat(kept, counts)
    error = np.zeros(len(kept)) if error_px is None else np.asarray(error_px, np.float64)
    error = np.where(np.isfinite(error), error, 0.0)
    xyz = tie_points.xyz[kept] - offset
    uv, camera = tie_points.image_xy[seen], tie_points.views.camera[seen]
    return xyz, error[kept], uv, point[seen], camera.astype(np.int64)


def colmap_camera(path: Path, given: Lens) -> Camera:
    """Return the simplest of COLMAP's cameras that is exactly this lens."""
    whole = float(given.width).is_integer() and float(given.height).is_integer()
    if given.unit == "px" and whole:
        values = _values(given)
        for name in PREFERRED:
            model = BY_NAME[name]
            if model.projection != given.projection:
                continue
            numbers = tuple(values.get(key, 0.0) for key in model.parameters)
            camera = Camera(model, given.width, given.height, numbers)
            if is_same_lens(lens(path, 1, camera), given):
                return camera
    raise InputError(
        f"{path}: COLMAP has no camera model that holds the lens {given.sensor or 'of the images'}"
        f" ({_what(given)}) exactly, so no COLMAP model is written; take another form."
    )


def _values(given: Lens) -> dict[str, float]:
    """Return the parameters of all models by COLMAP's names."""
    values = {"f": given.focal, "fx": given.focal + given.b1, "fy": given.focal}
    values |= {"cx": given.principal_x, "cy": given.principal_y}
    for names, numbers in (
        (("k1", "k2", "k3", "k4", "k5", "k6"), given.radial),
        (("d1", "d2", "d3"), given.denominator),
        (("p2", "p1"), given.tangential),
        (("s1", "s2", "s3", "s4"), given.thin_prism),
    ):
        values |= dict(zip(names, numbers, strict=False))
    own = {"fov": ("omega",), "division": ("k",), "eucm": ("alpha", "beta")}
    return values | dict(zip(own.get(given.projection, ()), given.shape, strict=False))


def _what(given: Lens) -> str:
    """Return in words what a lens has."""
    parts = [f"{given.projection} in {given.unit}"]
    parts += [f"{len(given.radial)} radial"] if given.radial else []
    parts += [f"{len(given.denominator)} rational"] if given.denominator else []
    parts += [f"{len(given.tangential)} tangential"] if given.tangential else []
    parts += ["thin prism"] if any(given.thin_prism) else []
    parts += ["skew"] if given.b2 or given.b3 else []
    parts += ["inverse"] if given.inverse else []
    return ", ".join(parts)


def _cameras_bin(block: Block) -> bytes:
    parts = [struct.pack("<Q", len(block.cameras))]
    for i, camera in enumerate(block.cameras, start=1):
        number = MODELS.index(camera.model)
        parts.append(struct.pack("<IiQQ", i, number, int(camera.width), int(camera.height)))
        parts.append(np.array(camera.values, "<f8").tobytes())
    return b"".join(parts)


def _images_bin(block: Block) -> bytes:
    kind = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
    seen = np.empty(len(block.point), kind)
    seen["xy"], seen["point"] = block.xy, block.point + 1
    parts = [struct.pack("<Q", len(block.labels))]
    for i, label in enumerate(block.labels):
        first, last = block.image_start[i : i + 2]
        pose = (*block.quaternions[i], *block.translations[i])
        parts.append(struct.pack("<I7dI", i + 1, *pose, block.camera_of[i] + 1))
        parts.append(label.encode() + b"\0" + struct.pack("<Q", last - first))
        parts.append(seen[first:last].tobytes())
    return b"".join(parts)


def _points_bin(block: Block) -> bytes:
    tracks, start = _tracks(block)
    views = tracks.astype("<u4")
    parts = [struct.pack("<Q", len(block.points))]
    for i, (xyz, error) in enumerate(zip(block.points, block.error_px, strict=True)):
        first, last = start[i : i + 2]
        parts.append(struct.pack("<Q3d3BdQ", i + 1, *xyz, *GREY, error, last - first))
        parts.append(views[first:last].tobytes())
    return b"".join(parts)


def _tracks(block: Block) -> tuple[IntArray, IntArray]:
    """Return image number and number in the image of each view, point by point, and the starts."""
    image = np.repeat(np.arange(len(block.labels)), np.diff(block.image_start))
    within = np.arange(len(image)) - block.image_start[image]
    order = np.argsort(block.point, kind="stable")
    counts = np.bincount(block.point, minlength=len(block.points))
    start = np.concatenate([[0], np.cumsum(counts)])
    return np.column_stack([image + 1, within])[order], start


def _cameras_txt(block: Block) -> bytes:
    lines = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    for i, c in enumerate(block.cameras, start=1):
        numbers = " ".join(repr(float(value)) for value in c.values)
        lines.append(f"{i} {c.model.name} {int(c.width)} {int(c.height)} {numbers}")
    return _text(lines)


def _images_txt(block: Block) -> bytes:
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# X, Y, POINT3D_ID, ..."]
    for i, label in enumerate(block.labels):
        pose = _numbers(np.concatenate([block.quaternions[i], block.translations[i]]))
        lines.append(f"{i + 1} {pose} {block.camera_of[i] + 1} {label}")
        rows = slice(*block.image_start[i : i + 2].tolist())
        seen = zip(block.xy[rows].tolist(), block.point[rows].tolist(), strict=True)
        lines.append(" ".join(f"{u!r} {v!r} {point + 1}" for (u, v), point in seen))
    return _text(lines)


def _points_txt(block: Block) -> bytes:
    tracks, start = _tracks(block)
    colour = " ".join(map(str, GREY))
    lines = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    for i, (xyz, error) in enumerate(zip(block.points, block.error_px.tolist(), strict=True)):
        views = " ".join(map(str, tracks[start[i] : start[i + 1]].ravel().tolist()))
        lines.append(f"{i + 1} {_numbers(xyz)} {colour} {error!r} {views}")
    return _text(lines)


def _numbers(values: FloatArray) -> str:
    return " ".join(map(repr, values.tolist()))


def _text(lines: list[str]) -> bytes:
    return ("\n".join(lines) + "\n").encode()

"""Write a block as a binary COLMAP model.

The layout is that of `pcfix.io.cameras.colmap`, without ``rigs`` and ``frames``, which COLMAP makes
itself for models that have none. Images and cameras are numbered from 1 in the order of the block,
points in the order of the tie points. Positions are written minus an offset, which
``georeference.json`` keeps.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pcfix.io.cameras.checks import bad_label, is_same_lens, lens_not_held, needs_lenses, write_new
from pcfix.io.cameras.colmap import FILE, place_text
from pcfix.io.cameras.colmap.files import BY_NAME, MODELS, OBSERVATION, SHAPES, Camera, lens
from pcfix.io.cameras.tracks import NO_TIE_POINTS, are_seen
from pcfix.model import Cameras, FloatArray, IntArray, Lens, TiePoints
from pcfix.options.declare import File

PREFERRED = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"),
    *("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE", "THIN_PRISM_FISHEYE"),
    *("RAD_TAN_THIN_PRISM_FISHEYE", "FOV", "SIMPLE_DIVISION", "DIVISION", "EUCM"),
)
"""The simplest first; those that only new versions of COLMAP know come last."""
GREY = (128, 128, 128)
ROUND_M = 100.0


class Block(NamedTuple):
    """What is written: all that the files have, in their order.

    camera_of : row of `cameras` of each image.
    quaternions : array, shape (k, 4), the scalar first.
    translations : array, shape (k, 3).
    points : array, shape (m, 3), minus the offset.
    xy, point : of the image points, (o, 2) and (o,), image by image.
    image_start : array, shape (k + 1,), where each image's begin.
    """

    labels: tuple[str, ...]
    cameras: list[Camera]
    camera_of: IntArray
    quaternions: FloatArray
    translations: FloatArray
    points: FloatArray
    xy: FloatArray
    point: IntArray
    image_start: IntArray


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

    Raises
    ------
    InputError
        If a lens is none that COLMAP has, or the cameras have no rotations.
    SettingError
        If a file exists.
    """
    target = Path(folder)
    middle = np.median(cameras.centres, axis=0)
    middle[2] = 0.0  # heights are small, and easier to read as they are
    offset = np.asarray(np.round(middle / ROUND_M) * ROUND_M if offset_m is None else offset_m)
    block = _block(target, cameras, tie_points or NO_TIE_POINTS, offset)
    for label in cameras.labels:  # a file would cut it off
        if not label.strip() or "\0" in label or "\n" in label or label != label.strip():
            raise bad_label(target, label)
    contents = {
        "cameras.bin": _cameras(block),
        "images.bin": _images(block),
        "points3D.bin": _points(block),
        FILE: place_text(offset, crs or cameras.crs).encode(),
    }
    write_new(target, contents)


def _block(target: Path, cameras: Cameras, tie_points: TiePoints, offset: FloatArray) -> Block:
    from scipy.spatial.transform import Rotation

    if cameras.rotations is None or cameras.lenses is None:
        raise needs_lenses(target)
    distinct = list(dict.fromkeys(cameras.lenses))
    number = {each: i for i, each in enumerate(distinct)}
    turns = Rotation.from_matrix(cameras.rotations).as_quat(canonical=True)
    kept, counts = are_seen(tie_points), np.diff(tie_points.views.start)
    seen = np.repeat(kept, counts)
    camera = tie_points.views.camera[seen]
    order = np.argsort(camera, kind="stable")
    image_counts = np.bincount(camera, minlength=len(cameras))
    return Block(
        labels=cameras.labels,
        cameras=[colmap_camera(target, each) for each in distinct],
        camera_of=np.array([number[each] for each in cameras.lenses]),
        quaternions=np.roll(turns, 1, axis=1),
        translations=-np.einsum("kij,kj->ki", cameras.rotations, cameras.centres - offset),
        points=tie_points.xyz[kept] - offset,
        xy=tie_points.image_xy[seen][order],
        point=np.repeat(np.cumsum(kept) - 1, counts)[seen][order],
        image_start=np.concatenate([[0], np.cumsum(image_counts)]),
    )


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
    raise lens_not_held(path, given)


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
    return values | dict(zip(SHAPES.get(given.projection, ()), given.shape, strict=False))


def _cameras(block: Block) -> bytes:
    parts = [struct.pack("<Q", len(block.cameras))]
    for i, camera in enumerate(block.cameras, start=1):
        number = MODELS.index(camera.model)
        parts.append(struct.pack("<IiQQ", i, number, int(camera.width), int(camera.height)))
        parts.append(np.array(camera.values, "<f8").tobytes())
    return b"".join(parts)


def _images(block: Block) -> bytes:
    seen = np.empty(len(block.point), OBSERVATION)
    seen["xy"], seen["point"] = block.xy, block.point + 1
    parts = [struct.pack("<Q", len(block.labels))]
    for i, label in enumerate(block.labels):
        first, last = block.image_start[i : i + 2]
        pose = (*block.quaternions[i], *block.translations[i])
        parts.append(struct.pack("<I7dI", i + 1, *pose, block.camera_of[i] + 1))
        parts.append(label.encode() + b"\0" + struct.pack("<Q", last - first))
        parts.append(seen[first:last].tobytes())
    return b"".join(parts)


def _points(block: Block) -> bytes:
    """Return the points, each with image number and number in the image of its views; no errors."""
    image = np.repeat(np.arange(len(block.labels)), np.diff(block.image_start))
    within = np.arange(len(image)) - block.image_start[image]
    order = np.argsort(block.point, kind="stable")
    views = np.column_stack([image + 1, within])[order].astype("<u4")
    counts = np.bincount(block.point, minlength=len(block.points))
    start = np.concatenate([[0], np.cumsum(counts)])
    parts = [struct.pack("<Q", len(block.points))]
    for i, xyz in enumerate(block.points):
        first, last = start[i : i + 2]
        parts.append(struct.pack("<Q3d3BdQ", i + 1, *xyz, *GREY, 0.0, last - first))
        parts.append(views[first:last].tobytes())
    return b"".join(parts)

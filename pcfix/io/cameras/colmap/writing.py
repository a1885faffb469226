"""Write a block as a binary COLMAP model.

The layout is that of `pcfix.io.cameras.colmap`, without ``rigs`` and ``frames``, which COLMAP makes
itself for models that have none. Images and cameras are numbered from 1 in the order of the block,
points in the order of the tie points. Positions are written minus an offset, which
``georeference.json`` keeps.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from pcfix.io.cameras.checks import block_to_write, is_same_lens, lens_not_held, write_new
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

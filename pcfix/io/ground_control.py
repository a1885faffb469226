"""Surveyed points and their marks in images, for cameras that are already in the cloud's CRS.

The forms of file are in `control_marks`.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import numpy.typing as npt

from pcfix.errors import InputError, PcfixWarning
from pcfix.io.control_marks import Marks, read_marks
from pcfix.io.crs import is_topocentric
from pcfix.io.files import check_input
from pcfix.io.labels import match_labels, unnamed
from pcfix.io.transformations import LOCAL, way_to_cloud
from pcfix.model import Cameras, FloatArray, GroundControl, IntArray
from pcfix.options.declare import File

SIGMA_M, SIGMA_PX = 0.01, 0.5
"""Where the file states none."""
FARTHEST_M = 50e3
"""From the block in plan; another zone or swapped axes are farther."""
_NAMED = 5


def read_ground_control(path: File, cameras: Cameras, *, crs: str | None = None) -> GroundControl:
    """Read surveyed points and where the images show them, in the CRS of the cameras.

    Stated standard deviations along x and y are taken over unturned, whatever the angle between the
    axes of the two CRS; where none is stated, they are `SIGMA_M` and `SIGMA_PX`. Warns of marks in
    images without a pose, which are left out, and of what is taken for granted about the CRS. An
    `InputError` if a field is not what it should be, rows contradict each other, a mark lies
    outside its image or in one that is not in the model, or the CRS cannot be brought together.

    Parameters
    ----------
    path : path
        A table with the columns name, x, y, z, image, u, v, OpenDroneMap's ``gcp_list.txt``, or
        Metashape's markers (XML, .psx, .psz); see `pcfix.io.control_marks`. An image may be named
        with or without folder and extension.
    cameras : Cameras
        In the cloud's CRS, with lenses in pixels.
    crs : str, optional
        Of the points, instead of what the file says; ``local`` takes the numbers as they are.
    """
    source = check_input(path)
    marks = read_marks(source)
    camera, kept, notes = _cameras_of(marks, cameras)
    name, first, point = _points(marks)
    _check_agreement(marks, first, point)
    _check_once(marks, point, camera)
    _check_frames(marks, cameras, camera)
    used = np.unique(point[kept])
    first = first[used]
    on = tuple(marks.on[i] for i in first) if any(marks.on) else ()
    xyz, way_notes = _to_cameras(marks, cameras, crs, first)
    _check_near(marks, cameras, xyz, first)
    unseen = [one for i, one in enumerate(name) if i not in used]
    if unseen:
        notes += (f"{marks.path}: no image with a pose shows {_few(unseen)}; left out.",)
    notes += way_notes
    for note in notes:
        warnings.warn(note, PcfixWarning, stacklevel=2)
    return GroundControl(
        names=tuple(name[i] for i in used),
        xyz=xyz,
        sigma_m=np.where(np.isnan(xyz), np.inf, _or_else(marks.sigma_m[first], SIGMA_M)),
        is_check=marks.is_check[first],
        under_water=marks.under_water[first],
        point=np.searchsorted(used, point[kept]),
        camera=camera[kept],
        image_xy=marks.uv[kept],
        sigma_px=_or_else(marks.sigma_px[kept], SIGMA_PX),
        crs=cameras.crs,
        on=on,
        on_sigma_m=_or_else(marks.sigma_on[first], SIGMA_M) if on else np.zeros(0),
    )


def _or_else(values: FloatArray, default: float) -> FloatArray:
    return np.where(np.isnan(values), default, values)


def _points(marks: Marks) -> tuple[list[str], IntArray, IntArray]:
    """Return the names of the points, the first row of each, and the point of each row."""
    names = list(dict.fromkeys(marks.point))
    number = {name: i for i, name in enumerate(names)}
    point = np.array([number[name] for name in marks.point])
    return names, np.unique(point, return_index=True)[1], point


def _cameras_of(marks: Marks, cameras: Cameras) -> tuple[IntArray, IntArray, tuple[str, ...]]:
    """Return the camera of each mark, -1 for none, the rows that have one, and notes."""
    names = list(dict.fromkeys(marks.image))
    matched = match_labels(names, cameras.labels)
    of_name = dict(zip(names, matched.row.tolist(), strict=True))
    camera = np.array([of_name[name] for name in marks.image])
    lost = [name for name in names if of_name[name] < 0]
    unknown = {*matched.ambiguous, *unnamed(lost, cameras.unposed)}
    unposed = [name for name in lost if name not in unknown]
    _refuse_unknown(marks, cameras, [n for n in lost if n in unknown], matched.ambiguous)
    kept = np.flatnonzero(camera >= 0)
    if not len(kept):
        raise InputError(f"{marks.path}: all its images are without a pose; align them first.")
    if not unposed:
        return camera, kept, ()
    note = (
        f"{marks.path}: {len(camera) - len(kept)} of {len(camera)} measurements are in images"
        f" without a pose ({_few(unposed)}) and are left out."
    )
    return camera, kept, (note,)


def _refuse_unknown(
    marks: Marks, cameras: Cameras, names: list[str], ambiguous: tuple[str, ...]
) -> None:
    if not names:
        return
    row = marks.image.index(names[0])
    many = f"the model has {len(cameras)} images, the first {cameras.labels[0]}"
    if names[0] in ambiguous:
        raise InputError(
            f"{marks.at(row)}: the name could be that of several images ({many}); name the images"
            " as the model does, with their folders."
        )
    count = sum(image in names for image in marks.image)
    raise InputError(
        f"{marks.at(row)}: measured in images that are not in the model: {_few(names)}, {count} of"
        f" {len(marks.image)} measurements ({many}); give the points of this block, or take those"
        " rows out."
    )


def _few(names: list[str]) -> str:
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return ", ".join(names[:_NAMED]) + more


def _check_agreement(marks: Marks, first: IntArray, point: IntArray) -> None:
    """Refuse a point of which two rows say different things."""
    same = first[point]
    for what, values in (
        ("coordinates", marks.xyz),
        ("standard deviations", marks.sigma_m),
        ("roles", marks.is_check[:, None]),
        ("words on water", marks.under_water[:, None]),
        ("surfaces", np.array(marks.on or [""] * len(marks.point))[:, None]),
    ):
        both_nan = (values != values) & (values[same] != values[same])
        other = ~((values == values[same]) | both_nan).all(axis=1)
        if other.any():
            row = int(np.argmax(other))
            raise InputError(
                f"{marks.at(row)}: the {what} of this point are not those of"
                f" {marks.where[same[row]]} ({_shown(values[row])} and"
                f" {_shown(values[same[row]])}); give two points two names."
            )


def _shown(values: npt.NDArray[np.generic]) -> str:
    return ", ".join(
        ("yes" if v else "no") if isinstance(v, bool) else v if isinstance(v, str) else f"{v:.12g}"
        for v in values.tolist()
    )


def _check_once(marks: Marks, point: IntArray, camera: IntArray) -> None:
    """Refuse a point that is measured twice in an image."""
    first: dict[tuple[int, int], int] = {}
    for row in np.flatnonzero(camera >= 0).tolist():
        before = first.setdefault((int(point[row]), int(camera[row])), row)
        if before != row:
            raise InputError(
                f"{marks.at(row)}: the point is measured in this image at {marks.where[before]}"
                " already; take one of the two out."
            )


def _check_frames(marks: Marks, cameras: Cameras, camera: IntArray) -> None:
    """Refuse marks that lie outside their image."""
    if cameras.lenses is None:
        raise InputError(
            f"{marks.path}: marks in images need lenses, and the cameras have none; give --sensor."
        )
    for row in np.flatnonzero(camera >= 0).tolist():
        lens = cameras.lenses[camera[row]]
        if lens.unit != "px":
            raise InputError(
                f"{marks.at(row)}: the lens of the image is in mm, so marks in pixels have no place"
                " in it; give a sensor with focal_px, width_px, height_px."
            )
        u, v = marks.uv[row]
        if not (0.0 <= u <= lens.width and 0.0 <= v <= lens.height):
            raise InputError(
                f"{marks.at(row)}: measured at {u:g}, {v:g}, outside the image of {lens.width:g} x"
                f" {lens.height:g} pixels; count them from its upper left corner, x to the right,"
                " y down."
            )


def _to_cameras(
    marks: Marks, cameras: Cameras, crs: str | None, rows: IntArray
) -> tuple[FloatArray, tuple[Any, ...]]:
    """Return the points of some rows in the CRS of the cameras."""
    name, source, target = str(marks.path), crs or marks.crs, cameras.crs
    xyz = marks.xyz[rows]
    if target is not None and target.strip().lower() == LOCAL:
        if source is not None and source.strip().lower() != LOCAL:
            raise InputError(
                f"{name}: is in {source}, the cameras in a local frame; bring the cameras to that"
                " CRS, or give the CRS of the points as 'local' to take their numbers as they are."
            )
        return xyz, ()
    if target is not None and is_topocentric(target):
        raise InputError(
            f"{name}: the cameras are in axes east, north, up ({target}); bring them to the"
            " cloud's CRS first."
        )
    forward, notes = way_to_cloud(source, target, xyz, name, heights=True)
    if forward is None:
        return xyz, notes
    moved = forward(xyz)
    lost = ~np.isfinite(moved).all(axis=1) & np.isfinite(xyz).all(axis=1)
    if lost.any():
        row = int(rows[np.argmax(lost)])
        x, y, z = marks.xyz[row]
        raise InputError(
            f"{marks.at(row)}: {x:.10g}, {y:.10g}, {z:.6g} has no place in the cloud's CRS; check"
            " the CRS of the points."
        )
    return moved, notes


def _check_near(marks: Marks, cameras: Cameras, xyz: FloatArray, rows: IntArray) -> None:
    """Refuse points that no image of a block with a CRS can show."""
    if cameras.crs is None or cameras.crs.strip().lower() == LOCAL:
        return
    middle = np.median(cameras.centres[:, :2], axis=0)
    reach_m = FARTHEST_M + np.hypot(*(cameras.centres[:, :2] - middle).T).max()
    apart_m = np.hypot(*(xyz[:, :2] - middle).T)
    if (apart_m > reach_m).any():
        i = int(np.argmax(apart_m))
        swapped = np.hypot(*(xyz[i, 1::-1] - middle)) <= reach_m
        hint = "x and y are swapped" if swapped else "check the CRS of the points"
        raise InputError(
            f"{marks.at(int(rows[i]))}: the point lies {apart_m[i] / 1e3:,.0f} km from the block;"
            f" {hint}."
        )

"""Positions of the GNSS from a file of their own, and in the frame of the adjusted cameras."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pcfix.errors import InputError, PcfixWarning
from pcfix.io.cameras import read_cameras, table
from pcfix.io.cameras.formats import Source
from pcfix.io.cameras.georeference import adjusted_minus_gnss, is_tied
from pcfix.io.cameras.odm import read_images
from pcfix.io.cameras.table import gnss_positions, open_table
from pcfix.io.cameras.table.columns import Columns
from pcfix.io.crs import METRES, is_topocentric, parse_crs
from pcfix.io.files import check_input
from pcfix.io.labels import match_labels, unnamed
from pcfix.model import Cameras, FloatArray, GnssPositions
from pcfix.options.declare import File

SIGMAS = {
    "sigma_x": ("sx", "sxy", "sxyz", "sigma"),
    "sigma_y": ("sy", "sxy", "sxyz", "sigma"),
    "sigma_z": ("sz", "sxyz", "sigma"),
}
"""Further names of standard deviations: what they can only be in a list of measured positions."""
FARTHEST_M = 50e3
"""From the adjusted centres in plan; another zone or swapped axes are farther."""
_NAMED = 5


class GnssInFrame(NamedTuple):
    """Positions of the GNSS in the frame of k cameras, shape (k, 3), and standard deviations.

    `xyz` is NaN where a camera has no position, or its z cannot be compared; `sigma_m`, along x, y,
    z, is NaN there and where none is stated. `reason` says why z, or all, is missing.
    """

    xyz: FloatArray
    sigma_m: FloatArray
    reason: str = ""


def read_gnss(path: File, cameras: Cameras, *, crs: str | None = None) -> Cameras:
    """Return cameras with `gnss`: where the GNSS said that the images were taken.

    It is in its own CRS, NaN for images without a position and for standard deviations that are not
    stated. Warns of images without a position, and of positions of images that are not there. An
    `InputError` if the file cannot be read, one image has two positions, or no image of the block
    has one.

    Parameters
    ----------
    path : path
        A table with the columns image (label, name, ...), x, y, z or longitude, latitude, height
        and, where known, sx, sy, sz (or sigma, or Metashape's accuracies) in metres; Metashape's
        reference table, a list by exiftool, ODM's ``geo.txt`` or ``images.json``; or any camera
        file or folder that keeps such positions (see `pcfix.read_cameras`), as projects of
        Metashape and ODM do. An image may be named with or without folder and extension.
    cameras : Cameras
    crs : str, optional
        Of the positions, instead of what the file says. Where nobody says, that of the cameras.
    """
    source = Path(path) if Path(path).is_dir() else check_input(path)
    if crs is not None and crs.strip().lower() != "local":
        parse_crs(crs, str(source))
    if source.name == "images.json":
        nothing = np.full((len(cameras), 3), np.nan)
        stated, names = read_images(source, cameras.labels)
        found = GnssPositions(nothing, nothing, None) if stated is None else stated
        unknown = list(unnamed(names, cameras.labels))
    else:
        labels, listed = _listed(source)
        found, unknown = _by_camera(source, cameras, labels, listed)
    known = np.isfinite(found.xyz).all(axis=1)
    if not known.any():
        first = f"{cameras.labels[0]}{f', in the file {unknown[0]}' if unknown else ''}"
        raise InputError(
            f"{source}: no position is of an image of the block, which has {len(cameras)} (the"
            f" first is {first}); give the positions of this block."
        )
    if crs is not None:
        found = replace(found, crs=crs)
    _check_near(source, replace(cameras, gnss=found))
    notes = _notes(source, cameras, int(known.sum()), unknown)
    said = [PcfixWarning("gnss.positions", note) for note in notes]
    for note in said:
        warnings.warn(note, PcfixWarning, stacklevel=2)
    return replace(cameras, gnss=found, notes=(*cameras.notes, *said))


def _listed(path: Path) -> tuple[list[str], GnssPositions]:
    """Return the names of images and their positions, of a table or of a camera file."""
    if path.is_dir() or not table.recognises(Source(path)):
        read = read_cameras(path)
        labels, listed = list(read.labels), read.gnss
    else:
        columns = _with_sigmas(open_table(path))
        labels, listed = columns.labels, gnss_positions(columns)
    if listed is None:
        raise InputError(
            f"{path}: has no measured positions; give a table with the columns image, x, y, z or"
            " image, longitude, latitude, height."
        )
    return labels, listed


def _with_sigmas(columns: Columns) -> Columns:
    """Return columns with standard deviations under their further names."""
    header, place = columns.table.header, dict(columns.place)
    for role, names in SIGMAS.items():
        stated = [header.index(name) for name in names if name in header]
        if stated and role not in place:
            place[role] = stated[0]
    return replace(columns, place=place)


def _by_camera(
    path: Path, cameras: Cameras, names: list[str], listed: GnssPositions
) -> tuple[GnssPositions, list[str]]:
    """Return the positions by camera, and the names of images that are none of the cameras."""
    bad = (listed.sigma_m <= 0.0).any(axis=1)
    if bad.any():
        i = int(np.argmax(bad))
        raise InputError(
            f"{path}: image {names[i]}: the standard deviation {np.nanmin(listed.sigma_m[i]):g} m"
            " must be positive; leave it empty where it is not known."
        )
    row_of = _first_rows(path, names, listed)
    labels = list(row_of)
    matched = match_labels(labels, cameras.labels)
    if matched.ambiguous:
        raise InputError(
            f"{path}: image {matched.ambiguous[0]}: the name could be that of several images (the"
            f" model has {len(cameras)}); name the images as the model does, with their folders."
        )
    there = matched.row >= 0
    rows = np.array([row_of[label] for label in labels])[there]
    xyz, sigma = np.full((2, len(cameras), 3), np.nan)
    xyz[matched.row[there]], sigma[matched.row[there]] = listed.xyz[rows], listed.sigma_m[rows]
    unknown = [label for label, known in zip(labels, there, strict=True) if not known]
    return GnssPositions(xyz, sigma, listed.crs), unknown


def _check_near(path: Path, cameras: Cameras) -> None:
    """Refuse positions far from a block whose place is known."""
    if not is_tied(cameras.crs, str(path)) or not _differences_are_of_the_frame(cameras, str(path)):
        return
    apart_m = np.hypot(*adjusted_minus_gnss(cameras, str(path)).enu_m[:, :2].T)
    if np.isfinite(apart_m).any() and np.nanmedian(apart_m) > FARTHEST_M:
        raise InputError(
            f"{path}: its positions lie {np.nanmedian(apart_m) / 1e3:,.0f} km from the block; check"
            " their CRS, and that x is east and y north."
        )


def _first_rows(path: Path, labels: list[str], listed: GnssPositions) -> dict[str, int]:
    """Return the row of each label; two rows of one must say the same."""
    row_of: dict[str, int] = {}
    for i, label in enumerate(labels):
        first = row_of.setdefault(label, i)
        if not np.array_equal(listed.xyz[i], listed.xyz[first], equal_nan=True):
            raise InputError(
                f"{path}: image {label} has two positions; give every image one, with its folder"
                " in the name where several are called alike."
            )
    return row_of


def _notes(path: Path, cameras: Cameras, known: int, unknown: list[str]) -> tuple[str, ...]:
    notes = []
    if known < len(cameras):
        notes.append(f"{path}: {known} of {len(cameras)} images have a position by GNSS.")
    others = unnamed(unknown, cameras.unposed)
    if others:
        more = ", ..." if len(others) > _NAMED else ""
        notes.append(
            f"{path}: {len(others)} positions are of images that are not in the model"
            f" ({', '.join(others[:_NAMED])}{more}) and are left out."
        )
    return tuple(notes)


def gnss_in_frame_of(cameras: Cameras, name: str = "cameras") -> GnssInFrame:
    """Return the positions of the GNSS in the frame of the cameras, read from the file `name`.

    The cameras are in a projected CRS in metres, or in the frame of their `gnss`. Standard
    deviations east and north are taken as those along x and y, whatever the meridian convergence;
    of a height that cannot be compared there is none.
    """
    nothing = np.full((len(cameras), 3), np.nan)
    if cameras.gnss is None:
        return GnssInFrame(nothing, nothing, f"{name}: has no positions of the GNSS.")
    if not _differences_are_of_the_frame(cameras, name):
        reason = (
            f"{name}: {cameras.crs} is no map in metres, so positions of the GNSS have no place."
        )
        return GnssInFrame(nothing, nothing, reason)
    found = adjusted_minus_gnss(cameras, name)
    xyz = cameras.centres - found.enu_m
    return GnssInFrame(xyz, np.where(np.isnan(xyz), np.nan, cameras.gnss.sigma_m), found.reason)


def _differences_are_of_the_frame(cameras: Cameras, name: str) -> bool:
    """Whether adjusted minus GNSS is a difference of the numbers of the cameras' frame."""
    if not is_tied(cameras.crs, name) or cameras.crs is None:
        return True
    if is_topocentric(cameras.crs):
        return cameras.gnss is not None and cameras.gnss.crs in (None, cameras.crs)
    crs = parse_crs(cameras.crs, name)
    return crs.is_projected and {axis.unit_name for axis in crs.axis_info}.issubset(METRES)

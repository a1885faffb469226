"""GNSS positions from a file of their own, and in the frame of the adjusted cameras."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

from pcfix.errors import InputError, PcfixWarning
from pcfix.io.cameras import read_cameras, table
from pcfix.io.cameras.formats import Source
from pcfix.io.cameras.georeference import adjusted_minus_gnss, is_tied
from pcfix.io.cameras.odm import read_images
from pcfix.io.cameras.table import gnss_positions, open_table
from pcfix.io.crs import METRES, is_topocentric, parse_crs
from pcfix.io.files import check_input
from pcfix.io.labels import match_labels, unnamed
from pcfix.model import Cameras, GnssPositions
from pcfix.options.declare import File

SIGMAS = {
    "sigma_x": ("sx", "sxy", "sxyz", "sigma"),
    "sigma_y": ("sy", "sxy", "sxyz", "sigma"),
    "sigma_z": ("sz", "sxyz", "sigma"),
}
"""Further names of columns with standard deviations, unambiguous in a list of positions."""
FARTHEST_M = 50e3
"""Horizontal distance to the projection centres that indicates another zone or swapped axes."""
_NAMED = 5


def read_gnss(path: File, cameras: Cameras, *, crs: str | None = None) -> Cameras:
    """Return cameras with `gnss`: the GNSS positions of their images, in their own CRS.

    They are NaN for images without a position, and standard deviations for positions without one.
    Warns of images without a position, and of positions of unknown images.

    Parameters
    ----------
    path : path
        A table with the columns image (label, name, ...), x, y, z or longitude, latitude, height
        and optionally sx, sy, sz (or sigma, or Metashape's accuracies) in metres; Metashape's
        reference table, a list by exiftool, ODM's ``geo.txt`` or ``images.json``; or any camera
        file or folder with such positions (see `pcfix.read_cameras`), such as projects of
        Metashape and ODM. Images may be named with or without folder and extension.
    cameras : Cameras
    crs : str, optional
        Of the positions, instead of that in the file. That of the cameras if none is stated.
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
        found, unknown = _by_camera(source, cameras, *_listed(source))
    known = int(np.isfinite(found.xyz).all(axis=1).sum())
    if not known:
        first = f"first {cameras.labels[0]}{f', in the file {unknown[0]}' if unknown else ''}"
        words = (
            f"{source}: no position belongs to one of the {len(cameras)} images ({first}). Give the"
            " positions of this block."
        )
        raise InputError("gnss.no_image", words, path=source)
    if crs is not None:
        found = replace(found, crs=crs)
    _check_near(source, replace(cameras, gnss=found))
    notes = []
    if known < len(cameras):
        words = f"{source}: {known} of {len(cameras)} images have a GNSS position."
        notes.append(PcfixWarning("gnss.images_without", words, path=source, images=known))
    others = unnamed(unknown, cameras.unposed)
    if others:
        some = f"{', '.join(others[:_NAMED])}{', ...' if len(others) > _NAMED else ''}"
        words = f"{source}: {len(others)} positions of images that are not in the model ({some})"
        words += " were skipped."
        notes.append(PcfixWarning("gnss.unknown_images", words, path=source, images=list(others)))
    for note in notes:
        warnings.warn(note, stacklevel=2)
    return replace(cameras, gnss=found, notes=(*cameras.notes, *notes))


def _listed(path: Path) -> tuple[list[str], GnssPositions]:
    """Return the names of images and their positions, from a table or a camera file."""
    if path.is_dir() or not table.recognises(Source(path)):
        read = read_cameras(path)
        labels, listed = list(read.labels), read.gnss
    else:
        columns = open_table(path)
        header, place = columns.table.header, dict(columns.place)
        for role, names in SIGMAS.items():
            stated = [header.index(name) for name in names if name in header]
            if stated and role not in place:
                place[role] = stated[0]
        columns = replace(columns, place=place)
        labels, listed = columns.labels, gnss_positions(columns)
    if listed is None:
        words = (
            f"{path}: has no measured positions. Give a table with the columns image, x, y, z or"
            " image, longitude, latitude, height."
        )
        raise InputError("gnss.none", words, path=path)
    return labels, listed


def _by_camera(
    path: Path, cameras: Cameras, names: list[str], listed: GnssPositions
) -> tuple[GnssPositions, list[str]]:
    """Return the positions by camera, and the names of unknown images."""
    bad = (listed.sigma_m <= 0.0).any(axis=1)
    if bad.any():
        i = int(np.argmax(bad))
        words = (
            f"{path}: image {names[i]}: the standard deviation {np.nanmin(listed.sigma_m[i]):g} m"
            " must be positive. Leave it empty if it is unknown."
        )
        raise InputError("gnss.sigma", words, path=path, image=names[i])
    row_of: dict[str, int] = {}
    for i, label in enumerate(names):
        first = row_of.setdefault(label, i)
        if not np.array_equal(listed.xyz[i], listed.xyz[first], equal_nan=True):
            words = (
                f"{path}: image {label} has two positions. Give one for every image, and use names"
                " with folders if names are repeated."
            )
            raise InputError("gnss.two_positions", words, path=path, image=label)
    labels = list(row_of)
    matched = match_labels(labels, cameras.labels)
    if matched.ambiguous:
        words = (
            f"{path}: image {matched.ambiguous[0]} could be several of the {len(cameras)} images of"
            " the model. Use its names, with their folders."
        )
        raise InputError("images.ambiguous", words, path=path, image=matched.ambiguous[0])
    there = matched.row >= 0
    rows = np.array([row_of[label] for label in labels])[there]
    xyz, sigma = np.full((2, len(cameras), 3), np.nan)
    xyz[matched.row[there]], sigma[matched.row[there]] = listed.xyz[rows], listed.sigma_m[rows]
    unknown = [label for label, known in zip(labels, there, strict=True) if not known]
    return GnssPositions(xyz, sigma, listed.crs), unknown


def _check_near(path: Path, cameras: Cameras) -> None:
    """Refuse positions far from a block with a known place."""
    if not is_tied(cameras.crs, str(path)) or not _differences_are_of_the_frame(cameras, str(path)):
        return
    apart_m = np.hypot(*adjusted_minus_gnss(cameras, str(path)).enu_m[:, :2].T)
    if np.isfinite(apart_m).any() and np.nanmedian(apart_m) > FARTHEST_M:
        words = (
            f"{path}: its positions are {np.nanmedian(apart_m) / 1e3:,.0f} km from the block. Check"
            " their CRS, and that x is east and y north."
        )
        raise InputError("gnss.far", words, path=path, apart_m=float(np.nanmedian(apart_m)))


def gnss_in_frame_of(cameras: Cameras, name: str = "cameras") -> tuple[GnssPositions, str]:
    """Return the GNSS positions of the file `name` in the frame of the cameras.

    The cameras are in a projected CRS in metres, or in the frame of their `gnss`. Positions are NaN
    for cameras without one, and heights that cannot be compared. Standard deviations east and north
    are used along x and y, without the meridian convergence.

    Returns
    -------
    positions : GnssPositions
        Without a CRS of their own.
    reason : str
        Why heights or all positions are missing; empty if they are not.
    """
    nothing = np.full((len(cameras), 3), np.nan)
    if cameras.gnss is None or not _differences_are_of_the_frame(cameras, name):
        why = "has no GNSS positions"
        if cameras.gnss is not None:
            why = f"{cameras.crs} is no map in metres, in which GNSS positions could be compared"
        return GnssPositions(nothing, nothing, None), f"{name}: {why}."
    found = adjusted_minus_gnss(cameras, name)
    xyz = cameras.centres - found.enu_m
    sigma = np.where(np.isnan(xyz), np.nan, cameras.gnss.sigma_m)
    return GnssPositions(xyz, sigma, None), found.reason


def _differences_are_of_the_frame(cameras: Cameras, name: str) -> bool:
    """Return whether adjusted minus GNSS is a difference of coordinates in the cameras' frame."""
    if not is_tied(cameras.crs, name) or cameras.crs is None:
        return True
    if is_topocentric(cameras.crs):
        return cameras.gnss is not None and cameras.gnss.crs in (None, cameras.crs)
    crs = parse_crs(cameras.crs, name)
    return crs.is_projected and {axis.unit_name for axis in crs.axis_info}.issubset(METRES)

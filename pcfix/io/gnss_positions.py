"""GNSS positions from a file of their own, and in the frame of the adjusted cameras."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

from pcfix.errors import PcfixWarning, bad_file
from pcfix.io.cameras import read_cameras, table
from pcfix.io.cameras.checks import Source
from pcfix.io.cameras.georeference import adjusted_minus_gnss, is_tied
from pcfix.io.cameras.table import gnss_positions, open_table
from pcfix.io.crs import METRES, is_topocentric, parse_crs
from pcfix.io.files import check_input
from pcfix.io.labels import match_labels
from pcfix.io.tables import places
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


_WITHOUT_NAMES = {".mrk": "a list of DJI's exposure times", ".pos": "a solution of RTKLIB"}


def read_gnss(path: File, cameras: Cameras, *, crs: str | None = None) -> Cameras:
    """Return cameras with `gnss`: the GNSS positions of their images, in their own CRS.

    They are NaN for images without a position, and standard deviations for positions without one.
    Warns of images without a position.

    The file is a table with the columns image (label, name, ...), x, y, z or longitude, latitude,
    height and optionally sx, sy, sz (or sigma, or Metashape's accuracies) in metres; Metashape's
    reference table, a list by exiftool, or ODM's ``geo.txt``; or any camera file or folder with
    such positions (see `pcfix.read_cameras`), such as projects of Metashape and ODM. Images may be
    named with or without folder and extension. `crs` replaces that in the file; if none is stated,
    it is that of the cameras.
    """
    source = Path(path) if Path(path).is_dir() else check_input(path)
    if crs is not None:
        parse_crs(crs, str(source))
    if (kind := _WITHOUT_NAMES.get(source.suffix.lower())) is not None:
        sentence = f"is {kind}, which names no images. Make a table with the columns image,"
        sentence += " longitude, latitude, height from it."
        raise bad_file(source, "gnss.no_names", sentence)
    if source.is_dir() or not table.recognises(Source(source)):
        read = read_cameras(source)
        names, listed = list(read.labels), read.gnss
    else:
        columns = open_table(source)
        place = places(columns.header, SIGMAS) | dict(columns.place)
        names, listed = columns.labels, gnss_positions(replace(columns, place=place))
    if listed is None:
        sentence = "has no measured positions. Give a table with the columns image, x, y, z."
        raise bad_file(source, "gnss.none", sentence)
    row_of: dict[str, int] = {}
    for i, name in enumerate(names):
        first = row_of.setdefault(name, i)
        if (listed.sigma_m[i] <= 0.0).any():
            sentence = f"image {name}: standard deviations must be positive, or empty if unknown."
            raise bad_file(source, "gnss.sigma", sentence, image=name)
        if not np.array_equal(listed.xyz[i], listed.xyz[first], equal_nan=True):
            sentence = f"image {name} has two positions. Give one for every image."
            raise bad_file(source, "gnss.two_positions", sentence, image=name)
    row, ambiguous = match_labels(list(row_of), cameras.labels)
    for name in ambiguous:
        sentence = f"image {name} could be several of the model. Use names with their folders."
        raise bad_file(source, "images.ambiguous", sentence, image=name)
    there = row >= 0
    rows = np.array(list(row_of.values()))[there]
    xyz, sigma = np.full((2, len(cameras), 3), np.nan)
    xyz[row[there]], sigma[row[there]] = listed.xyz[rows], listed.sigma_m[rows]
    known = int(np.isfinite(xyz).all(axis=1).sum())
    if not known:
        sentence = f"no position belongs to an image such as {cameras.labels[0]}. Give those of"
        raise bad_file(source, "gnss.no_image", f"{sentence} this block.")
    cameras = replace(cameras, gnss=GnssPositions(xyz, sigma, crs or listed.crs))
    if is_tied(cameras.crs, str(source)):
        enu_m = adjusted_minus_gnss(cameras, str(source))[0][:, :2]
        both = enu_m[np.isfinite(enu_m).all(axis=1)]
        apart_m = float(np.median(np.hypot(*both.T))) if len(both) else 0.0
        if apart_m > FARTHEST_M:
            sentence = f"its positions are {apart_m / 1e3:,.0f} km from the block. Check their CRS."
            raise bad_file(source, "gnss.far", sentence, apart_m=apart_m)
    if known == len(cameras):
        return cameras
    words = f"{source}: {known} of {len(cameras)} images have a GNSS position."
    note = PcfixWarning("gnss.images_without", words, path=source, images=known)
    warnings.warn(note, stacklevel=2)
    return replace(cameras, notes=(*cameras.notes, note))


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
    if cameras.gnss is None:
        return GnssPositions(nothing, nothing, None), f"{name}: has no GNSS positions."
    crs, is_frame = cameras.crs or "", True  # whether the differences are of coordinates in it
    if is_topocentric(crs):
        is_frame = cameras.gnss.crs in (None, crs)
    elif is_tied(cameras.crs, name):
        found = parse_crs(crs, name)
        is_frame = found.is_projected and {a.unit_name for a in found.axis_info}.issubset(METRES)
    if not is_frame:
        reason = f"{name}: {cameras.crs} is no map in metres, so the GNSS cannot be compared."
        return GnssPositions(nothing, nothing, None), reason
    enu_m, reason = adjusted_minus_gnss(cameras, name)
    xyz = cameras.centres - enu_m
    sigma = np.where(np.isnan(xyz), np.nan, cameras.gnss.sigma_m)
    return GnssPositions(xyz, sigma, None), reason

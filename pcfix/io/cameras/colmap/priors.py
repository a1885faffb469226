"""Pose priors of COLMAP: where the GNSS said the cameras were, from ``database.db``.

The database is SQLite. Table ``pose_priors`` has a row for an image (``image_id``; from COLMAP 4
on ``corr_data_id`` with the type of the sensor, 0 a camera), the position as three doubles, its
covariance as nine, and the coordinate system: 0 is WGS84 with latitude, longitude, height, 1 is
Cartesian, -1 not defined. The covariance is of metres east, north, up, or of the Cartesian axes
(https://colmap.github.io/database.html and ``src/colmap/geometry/pose_prior.h``).
"""

from __future__ import annotations

import sqlite3
from contextlib import closing
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from pcfix.model import GnssPositions

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

_DATABASE = "database.db"
_FOLDERS_ABOVE = 3
_WGS84 = 0
_WGS84_CRS = "EPSG:4979"

_Row: TypeAlias = tuple[str, bytes, bytes | None, int]


def read_priors(model: Path, labels: Sequence[str]) -> tuple[GnssPositions | None, tuple[str, ...]]:
    """Return the priors of images by their names, from the database beside or above a model.

    Parameters
    ----------
    model : Path
        The folder of the model.
    labels : sequence of str, length k

    Returns
    -------
    GnssPositions or None
        None where there is no database, or no prior of these images in it.
    tuple of str
        What to tell the user: that a database cannot be read.
    """
    places = (model, *model.resolve().parents[:_FOLDERS_ABOVE])
    path = next((p / _DATABASE for p in places if (p / _DATABASE).is_file()), None)
    if path is None:
        return None, ()
    try:
        rows = _rows(path)
    except sqlite3.Error as error:
        return None, (f"{path}: the pose priors cannot be read ({error}); they are left out.",)
    row_of = {label: i for i, label in enumerate(labels)}
    found = [(row_of[row[0]], row) for row in rows if row[0] in row_of]
    if len({row[-1] for _, row in found}) > 1:
        return None, (f"{path}: the pose priors are in several systems; they are left out.",)
    return _positions(found, len(labels)), ()


def _rows(path: Path) -> list[_Row]:
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


def _positions(found: Sequence[tuple[int, _Row]], count: int) -> GnssPositions | None:
    xyz, sigma = np.full((2, count, 3), np.nan)
    for row, (_, position, covariance, _) in found:
        xyz[row] = np.frombuffer(position, "<f8")
        if isinstance(covariance, bytes) and len(covariance) == 9 * 8:
            variances = np.frombuffer(covariance, "<f8").reshape(3, 3).diagonal()
            sigma[row] = np.sqrt(np.where(variances >= 0.0, variances, np.nan))
    xyz[~np.isfinite(xyz).all(axis=1)] = np.nan
    if np.isnan(xyz).all():
        return None
    wgs84 = found[0][1][-1] == _WGS84
    return GnssPositions(xyz[:, [1, 0, 2]] if wgs84 else xyz, sigma, _WGS84_CRS if wgs84 else None)

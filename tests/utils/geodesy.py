"""Axes and places about the earth, written out."""

from typing import Any

import numpy as np


def axes_at(lon_deg: Any, lat_deg: Any) -> np.ndarray:
    """Return east, north and up as rows in geocentric axes, (..., 3, 3)."""
    lon, lat = np.radians(lon_deg), np.radians(lat_deg)
    zero = np.zeros_like(lon)
    rows = [
        [-np.sin(lon), np.cos(lon), zero],
        [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)],
        [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def geocentric(lon_deg: Any, lat_deg: Any, height: Any, a: float, f: float) -> np.ndarray:
    lon, lat = np.radians(lon_deg), np.radians(lat_deg)
    e2 = f * (2.0 - f)
    n = a / np.sqrt(1.0 - e2 * np.sin(lat) ** 2)
    across = (n + height) * np.cos(lat)
    z = (n * (1.0 - e2) + height) * np.sin(lat)
    return np.stack([across * np.cos(lon), across * np.sin(lon), z], axis=-1)

"""Read camera files as a user does; what they warn of stays in their notes."""

import warnings
from pathlib import Path
from typing import Any

import pcfix
from pcfix.io.cameras import read_tie_points
from pcfix.model import Cameras, TiePoints


def read(path: Path, *args: Any, **options: Any) -> Cameras:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", pcfix.PcfixWarning)
        return pcfix.read_cameras(path, *args, **options)


def read_ties(path: Path) -> TiePoints:
    return read_tie_points(path, read(path))


def notes(cameras: Cameras) -> list[str]:
    """Return the codes of what was noted on reading."""
    return [note.code for note in cameras.notes]


def brown(x: float, y: float, k: Any, p: Any = (0.0, 0.0)) -> tuple[float, float]:
    """Return a place after Brown's distortion, his order of p1 and p2, written out."""
    r2 = x * x + y * y
    radial = 1.0 + sum(value * r2 ** (i + 1) for i, value in enumerate(k))
    return (
        x * radial + p[0] * (r2 + 2 * x * x) + 2 * p[1] * x * y,
        y * radial + p[1] * (r2 + 2 * y * y) + 2 * p[0] * x * y,
    )

"""Write a block as the plain table that `pcfix.io.cameras.table` reads, and its sensor beside it.

``cameras.csv`` has label, x, y, z, qw, qx, qy, qz: projection centre and rotation from the world to
the camera (x right, y down, z forward), after a comment with the CRS where there is one.
``sensor.csv`` has the lens, in pixels with OpenCV's names or, of an undistorted lens in mm, as
focal, sensor_x, sensor_y. Where the images have several lenses of one frame, each row of
``cameras.csv`` has its own (f, px, py, k1 ... k4, t1, t2) and ``sensor.csv`` says the frame alone.
"""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras.same_lens import is_same_lens
from pcfix.io.cameras.table.sensor import FILM_MM
from pcfix.io.crs import is_topocentric
from pcfix.io.files import check_output, write_text
from pcfix.model import Lens

if TYPE_CHECKING:
    import os
    from collections.abc import Sequence

    from pcfix.model import Cameras

FILES = ("cameras.csv", "sensor.csv")
POSE = ("label", "x", "y", "z", "qw", "qx", "qy", "qz")
OWN = ("f", "px", "py", "k1", "k2", "k3", "k4", "t1", "t2")


def write_table(
    folder: str | os.PathLike[str], cameras: Cameras, *, overwrite: bool = False
) -> None:
    """Write ``cameras.csv`` and ``sensor.csv``.

    Parameters
    ----------
    folder : path
        Made if need be.
    cameras : Cameras
        With rotations and lenses.
    overwrite : bool

    Raises
    ------
    InputError
        If a lens has what the table cannot say, or the cameras have no rotations.
    SettingError
        If a file exists and `overwrite` is not set.
    """
    target = Path(folder)
    if cameras.rotations is None or cameras.lenses is None:
        raise InputError(f"{target}: a table of poses needs rotations and lenses of all images.")
    if cameras.crs is not None and is_topocentric(cameras.crs):
        raise InputError(
            f"{target}: a table cannot say that its axes are {cameras.crs}; bring the cameras to a"
            " projected CRS first."
        )
    distinct = list(dict.fromkeys(cameras.lenses))
    single = len(distinct) == 1
    sensor = _sensor(target, distinct[0]) if single else _frame(target, distinct)
    own = None if single else [_own(target, lens) for lens in cameras.lenses]
    texts = (_poses(cameras, own), sensor)
    if target.is_dir():
        for name in FILES:
            check_output(target / name, overwrite=overwrite)
    target.mkdir(parents=True, exist_ok=True)
    for name, text in zip(FILES, texts, strict=True):
        write_text(target / name, text, overwrite=overwrite)


def _poses(cameras: Cameras, own: list[list[float]] | None) -> str:
    from scipy.spatial.transform import Rotation

    turns = Rotation.from_matrix(np.asarray(cameras.rotations)).as_quat(canonical=True)
    numbers = np.column_stack([cameras.centres, np.roll(turns, 1, axis=1)]).tolist()
    stream = io.StringIO()
    if cameras.crs is not None and cameras.crs.strip().lower() != "local":
        stream.write(f"# CoordinateSystem: {' '.join(cameras.crs.split())}\n")
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(POSE if own is None else POSE + OWN)
    for i, label in enumerate(cameras.labels):
        more = [] if own is None else own[i]
        writer.writerow([label, *map(repr, [*numbers[i], *more])])
    return stream.getvalue()


def _sensor(target: Path, lens: Lens) -> str:
    """Return the one row of the lens of all images."""
    if lens.unit == "mm":
        centred = Lens(
            *(lens.focal, lens.width, lens.height, lens.width / 2.0, lens.height / 2.0), unit="mm"
        )
        _check_held(target, lens, centred)
        values = {"focal": lens.focal, "sensor_x": lens.width, "sensor_y": lens.height}
        return _row(values)
    radial, denominator, tangential = (
        (*given, *(0.0,) * count)[:count]
        for given, count in ((lens.radial, 3), (lens.denominator, 3), (lens.tangential, 2))
    )
    _check_held(target, lens, _brown(lens, radial, denominator, tangential))
    values = {"focal_px": lens.focal, "width_px": lens.width, "height_px": lens.height}
    values |= {"cx": lens.principal_x, "cy": lens.principal_y}
    values |= {f"k{i}": value for i, value in enumerate((*radial, *denominator), start=1)}
    values |= {"p1": tangential[1], "p2": tangential[0]}  # OpenCV counts them the other way round
    return _row(values)


def _frame(target: Path, lenses: list[Lens]) -> str:
    """Return the row of the frame that all lenses have."""
    frames = {(lens.width, lens.height, lens.unit) for lens in lenses}
    if len(frames) > 1 or lenses[0].unit != "px":
        raise InputError(
            f"{target}: a table of poses holds several lenses only in pixels and of one frame;"
            " take another form."
        )
    return _row({"width_px": lenses[0].width, "height_px": lenses[0].height})


def _own(target: Path, lens: Lens) -> list[float]:
    """Return f, px, py, k1 ... k4, t1, t2 of one image, as RealityCapture's tables have them."""
    radial, tangential = (
        (*given, *(0.0,) * count)[:count]
        for given, count in ((lens.radial, 4), (lens.tangential, 2))
    )
    _check_held(target, lens, _brown(lens, radial, (), tangential))
    largest = max(lens.width, lens.height)
    x, y = lens.principal_x - lens.width / 2.0, lens.principal_y - lens.height / 2.0
    return [lens.focal * FILM_MM / largest, x / largest, y / largest, *radial, *tangential]


def _brown(
    lens: Lens, radial: Sequence[float], denominator: Sequence[float], tangential: Sequence[float]
) -> Lens:
    return Lens(
        *(lens.focal, lens.width, lens.height, lens.principal_x, lens.principal_y),
        radial=tuple(radial),
        denominator=tuple(denominator),
        tangential=tuple(tangential),
    )


def _check_held(target: Path, lens: Lens, held: Lens) -> None:
    if not is_same_lens(lens, held):
        raise InputError(
            f"{target}: a table of poses cannot hold the lens {lens.sensor or 'of the images'}"
            f" ({lens.projection}) exactly: it knows one focal length, the principal point and"
            " OpenCV's k and p; take another form."
        )


def _row(values: dict[str, float]) -> str:
    return ",".join(values) + "\n" + ",".join(repr(float(v)) for v in values.values()) + "\n"

"""The water surface, from one word that says what it is; triangle meshes.

PLY goes through open3d, which keeps double precision. OBJ does not: open3d hands OBJ
coordinates on as 32-bit floats, half a metre apart at a northing of five million, so the two
kinds of line that matter are read here.
"""

from __future__ import annotations

import ctypes
import math
import os
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from pcfix.errors import InputError, PcfixWarning, SettingError
from pcfix.io.files import check_input
from pcfix.io.water_rasters import read_water_raster
from pcfix.model import FloatArray, IntArray, WaterDimension, WaterMesh, WaterPlane, WaterSurface
from pcfix.options.declare import File

if TYPE_CHECKING:
    from pyproj import CRS


KINDS = (
    "a level such as 0.37, plane:a,b,c, dim:NAME, a mesh file (.obj, .ply), or a raster of heights"
    " (.tif or another that GDAL reads)"
)

_NO_RASTERS = (".csv", ".txt", ".json", ".geojson", ".gpkg", ".shp", ".wkt", ".las", ".laz")
"""GDAL would try some of these as rasters all the same."""


MOST_OVERLAP = 0.01
"""Of the plan area: what folds at the rim of a triangulated shore come to."""
LEAST_FACET_M2 = 1e-6


def read_water(
    spec: float | File,
    cloud_crs: str | CRS | None = None,
    bounds: tuple[float, float, float, float] | None = None,
) -> WaterSurface:
    """Return the water surface that a word describes.

    Parameters
    ----------
    spec : float, str or path
        ``0.37``
            a level, metres, in the cloud's own heights;
        ``plane:a,b,c``
            the plane z = a + b x + c y in the cloud's own coordinates;
        ``dim:NAME``
            a dimension of the cloud that holds the height of the surface above each point;
            NaN where it is not known;
        ``surface.obj``, ``surface.ply``
            a triangulated surface in the cloud's own coordinates;
        ``surface.tif``
            or another raster that GDAL reads: one band of heights, in any CRS.
    cloud_crs : str or CRS, optional
        Projected, metres; rasters are brought to it. Default: that of the raster.
    bounds : tuple of 4 float, optional
        West, south, east and north end of the cloud: of a large raster only what lies about it
        is read.

    Returns
    -------
    WaterSurface

    Raises
    ------
    SettingError
        If the word is none of these, or its numbers are not finite.
    InputError
        If the mesh or raster is missing or damaged, or cannot be brought to the cloud's CRS.

    Examples
    --------
    >>> import pcfix
    >>> pcfix.read_water("0.37")
    WaterPlane(a=0.37, b=0.0, c=0.0)
    """
    if isinstance(spec, (int, float)):
        return WaterPlane(*_finite([float(spec)], str(spec)))
    text = str(spec).strip()
    kind, colon, rest = text.partition(":")
    if colon and kind.lower() == "plane":
        parts = rest.split(",")
        if len(parts) != 3:
            raise SettingError(f"water '{text}': plane: needs three numbers a,b,c.")
        return WaterPlane(*_finite(parts, text))
    if colon and kind.lower() == "dim":
        if not rest:
            raise SettingError(f"water '{text}': name the dimension, as in dim:w_surf.")
        return WaterDimension(rest)
    if Path(text).suffix.lower() in (".obj", ".ply"):
        return _mesh(check_input(text))
    try:
        return WaterPlane(*_finite([text], text))
    except SettingError:
        if not (os.path.lexists(text) or Path(text).suffix[1:2].isalpha()):
            raise  # no number ends as file names do
        check_input(text)
    if Path(text).suffix.lower() in _NO_RASTERS:
        raise InputError(f"{text}: is not a water surface that pcfix reads; give {KINDS}.")
    return read_water_raster(text, cloud_crs, bounds)


def _finite(values: list[str] | list[float], text: str) -> list[float]:
    try:
        numbers = [float(value) for value in values]
    except ValueError:
        raise SettingError(f"water '{text}' is not understood; give {KINDS}.") from None
    if not all(math.isfinite(number) for number in numbers):
        raise SettingError(f"water '{text}': the numbers must be finite.")
    return numbers


def _mesh(path: Path) -> WaterMesh:
    read = _read_obj if path.suffix.lower() == ".obj" else _read_ply
    vertices, triangles = read(path)
    if len(triangles) == 0:
        raise InputError(f"{path}: holds no triangles; export the water surface as a mesh.")
    if not np.isfinite(vertices).all():
        raise InputError(f"{path}: a vertex is not finite; export the mesh again.")
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise InputError(f"{path}: a face names a vertex that is not there; export it again.")
    mesh = WaterMesh(vertices, triangles, path.name)
    check_mesh(mesh, path)
    return mesh


def check_mesh(mesh: WaterMesh, path: Path) -> None:
    """Refuse a mesh that is no height field, and warn of facets that do not count.

    Which way a facet faces does not matter, nor do holes, edges of three facets, or facets that
    overlap at one height: all are well defined as heights. Vertical facets have none.
    """
    from pcfix.water.surface import build_tin, in_two_sheets

    tin = build_tin(mesh)
    double, area_m2 = in_two_sheets(tin)
    share = float(area_m2[double].sum() / area_m2.sum())
    if share > MOST_OVERLAP:
        raise InputError(
            f"{path}: {100.0 * share:.0f} % of the mesh lies above or below another part of it;"
            " the water has one height at a place, so export its surface alone, not a closed body"
            " or several surfaces."
        )
    if double.any():
        _note(
            f"{path}: facets overlap others at another height ({int(double.sum()):,} of"
            f" {len(mesh.triangles):,}); there the water may be either."
        )
    edges = np.diff(mesh.vertices[mesh.triangles], axis=1)
    size_m2 = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) / 2.0
    upright = int((size_m2 > LEAST_FACET_M2).sum()) - int((area_m2 > LEAST_FACET_M2).sum())
    if upright > 0:
        _note(f"{path}: vertical facets have no height and are left out ({upright:,}).")


def _note(sentence: str) -> None:
    warnings.warn(sentence, PcfixWarning, stacklevel=4)


def _read_obj(path: Path) -> tuple[FloatArray, IntArray]:
    """Return vertices, shape (v, 3), and triangles, shape (t, 3)."""
    vertices: list[list[float]] = []
    triangles: list[list[int]] = []
    for number, line in enumerate(path.read_text("latin-1").splitlines(), start=1):
        key, *fields = line.split() or [""]
        try:
            if key == "v":
                x, y, z = fields[:3]
                vertices.append([float(x), float(y), float(z)])
            elif key == "f":
                corners = [_obj_index(field, len(vertices)) for field in fields]
                triangles += [[corners[0], *corners[i : i + 2]] for i in range(1, len(corners) - 1)]
        except ValueError as error:
            raise InputError(f"{path}: line {number} is not an OBJ line ({error}).") from error
    return np.array(vertices).reshape(-1, 3), np.array(triangles, dtype=np.int64).reshape(-1, 3)


def _obj_index(field: str, count: int) -> int:
    """Return the row of a corner such as ``7``, ``7/1/3`` or, counted from the end, ``-1``."""
    index = int(field.split("/")[0])
    return index - 1 if index > 0 else count + index


def _read_ply(path: Path) -> tuple[FloatArray, IntArray]:
    o3d = load_open3d()
    quiet = o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error)
    with _stderr_of_c() as messages, quiet:
        mesh = o3d.io.read_triangle_mesh(str(path))
        messages.seek(0)
        complaints = [line for line in messages.read().decode().splitlines() if "RPly:" in line]
    if complaints or len(mesh.vertices) == 0:
        reason = complaints[0].partition("RPly: ")[2] if complaints else "no vertices"
        raise InputError(f"{path}: is not a whole PLY mesh ({reason}); export it again.")
    return np.array(mesh.vertices), np.array(mesh.triangles, dtype=np.int64)


@contextmanager
def _stderr_of_c() -> Iterator[IO[bytes]]:
    """Catch what C code writes to stderr: open3d returns half a mesh and says so only there."""
    with tempfile.TemporaryFile() as messages:
        kept = os.dup(2)
        try:
            os.dup2(messages.fileno(), 2)
            yield messages
        finally:
            os.dup2(kept, 2)
            os.close(kept)


def load_open3d() -> Any:
    """Import open3d, with the libusb that it needs.

    Its camera drivers link to the system's libusb-1.0, which servers often lack; the one of the
    package libusb-package serves as well. An `InputError` if it cannot be imported; the message
    says what to install.
    """
    try:
        try:
            import libusb_package

            ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
        except (ImportError, OSError):
            pass  # the system's own may do
        import open3d
    except (ImportError, OSError) as error:
        raise InputError(
            f"open3d cannot be loaded ({error}); on Debian and Ubuntu: apt-get install"
            " libusb-1.0-0 libgl1 libegl1 libgomp1 libx11-6."
        ) from error
    return open3d

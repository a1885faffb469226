"""Other clouds than one LAS file: many files as one cloud, and a raster of heights.

A cell with a height is a point at its centre. The raster is read in square windows, so that its
size does not matter. Where it has no height (no data, NaN, transparent, or impossible) there is no
point.
"""

from __future__ import annotations

import glob
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import laspy
import numpy as np
from laspy.vlrs.vlr import VLR

from pcfix.errors import SettingError, bad_file, warn
from pcfix.grid.lattice import Window
from pcfix.io.crs import metres_up
from pcfix.io.files import path_of, read_json, refusing
from pcfix.io.las.source import LasSource, RasterBand, coordinates, metric_crs
from pcfix.io.las.writing import NOTES, USER_ID
from pcfix.io.rasters import (
    IMPOSSIBLE_M,
    NO_HEIGHT,
    open_raster,
    place_of,
    raster_errors,
    read_masked,
    slices,
)
from pcfix.io.tables import METRES
from pcfix.model import FloatArray
from pcfix.options.declare import File

if TYPE_CHECKING:
    from rasterio.io import DatasetReader

Clouds: TypeAlias = "File | Iterable[File] | Tiles"

SUFFIXES = (".las", ".laz")
LISTS = (".txt", ".lst", ".list")
OVERLAP = 0.01
"""A fraction of a tile's side: neighbours may reach so far into each other, by rounding."""


@dataclass(frozen=True)
class Tiles:
    """Files that are read as one cloud, in their order."""

    name: str  # as the user names them
    paths: tuple[Path, ...]
    points: tuple[int, ...]  # of each file
    lows: FloatArray  # corners of each file, shape (files, 3), metres
    highs: FloatArray
    step_m: float  # the coarsest scale

    def __str__(self) -> str:
        return self.name

    def __len__(self) -> int:
        return sum(self.points)


class TiledSource(LasSource):
    """Many open files, one after another; see `LasSource`. What is not of points is the first's."""

    def __init__(self, tiles: Tiles, jobs: int | None = None) -> None:
        """Open the first."""
        super().__init__(tiles.paths[0], jobs)
        self._tiles, self._jobs, self.path = tiles, jobs, Path(tiles.name)
        self.header.mins, self.header.maxs = tiles.lows.min(axis=0), tiles.highs.max(axis=0)
        self.header.scales = np.full(3, tiles.step_m)
        self.header.point_count = len(tiles)

    def chunks(self) -> Iterator[laspy.ScaleAwarePointRecord]:
        """Yield all points."""
        for path in self._tiles.paths:
            with LasSource(path, self._jobs) as source:
                yield from source.chunks()


CloudFiles: TypeAlias = Path | RasterBand | Tiles


def open_cloud(cloud: CloudFiles, jobs: int | None = None) -> LasSource:
    """Return the points of a file, or of many; see `LasSource`. Those of a raster are its cells."""
    if isinstance(cloud, Tiles):
        return TiledSource(cloud, jobs)
    if isinstance(cloud, RasterBand) or is_raster(cloud):
        return RasterSource(cloud if isinstance(cloud, RasterBand) else band_of(cloud))
    return LasSource(cloud, jobs)


def band_of(path: CloudFiles, options: Any = None) -> Any:
    """Return the band of a raster that the options of a command ask for; of other clouds the path.

    The cells with a height are counted, once for all readers; an `InputError` if there are none.
    """
    if not isinstance(path, Path):
        return path
    band = getattr(options, "band", None)
    if not is_raster(path):
        if band is not None:
            words = "band has an effect only if the input is a raster; omit it."
            raise SettingError("option.needs", words, option="band", needs="raster")
        return path
    one = RasterBand(path, band)
    with RasterSource(one) as source:
        count, ends = 0, list[FloatArray]()
        for points in source.chunks():
            xyz, count = coordinates(points), count + len(points)
            ends += [xyz.min(axis=0), xyz.max(axis=0)]
    if not count:
        raise bad_file(path, "raster.empty", "no cell contains a height.")
    return replace(one, points=count, mins=np.min(ends, axis=0), maxs=np.max(ends, axis=0))


def inputs_of(cloud: Any) -> list[Any]:
    """Return the files of a cloud, one or many."""
    if isinstance(cloud, RasterBand):
        return [cloud.path]
    return list(cloud.paths) if isinstance(cloud, Tiles) else [cloud]


def tiles_of(cloud: Clouds) -> Tiles | None:
    """Return many files as one cloud; None if a path is that of a single file.

    Parameters
    ----------
    cloud : path, iterable of paths, or Tiles
        A folder, a glob (``tiles/*.laz``), a text list with a path on each line, or a virtual
        point cloud (``.vpc``); paths in these two may be relative to their own folder.

    Warns
    -----
    PcfixWarning
        If tiles overlap.
    """
    if isinstance(cloud, Tiles):
        return cloud
    if not isinstance(cloud, Iterable) or isinstance(cloud, str):
        paths, name = _listed(path_of(cloud)), str(cloud)
        if paths is None:
            return None
    else:
        paths = [path_of(one) for one in cloud]
        name = f"{len(paths)} files"
    if not paths:
        sentence = "contains no LAS or LAZ files. Give a folder, glob or list that does."
        raise bad_file(name, "cloud.no_files", sentence)
    by_name: dict[str, Path] = {}
    for path in paths:
        other = by_name.setdefault(path.name, path)
        if other is not path:
            sentence = f"{name}: {other} and {path} have the same file name. Rename one of them."
            raise SettingError("cloud.same_names", sentence, path=path)
    return tiles_from(name, paths)


def cloud_of(cloud: Clouds) -> Path | Tiles:
    """Return a file, or many as one cloud, see `tiles_of`."""
    return tiles_of(cloud) or path_of(cloud)


def _listed(path: Path) -> list[Path] | None:
    """Return the files that a path lists; None if it is that of a single cloud."""
    text, suffix = str(path), path.suffix.lower()
    if glob.has_magic(text) and not path.exists():
        return sorted(Path(path.anchor).glob(str(path.relative_to(path.anchor))))
    if path.is_dir():
        return sorted(one for one in path.iterdir() if one.suffix.lower() in SUFFIXES)
    if suffix == ".vpc":  # a STAC feature collection with an item for each file
        sentence = "is not a virtual point cloud. Give what 'pdal_wrench build_vpc' writes."
        with refusing(path, "cloud.index", sentence):
            assets = [one["assets"] for one in read_json(path)["features"]]
            names = [next(iter(one.values()))["href"].removeprefix("file://") for one in assets]
    elif suffix in LISTS and path.is_file():
        lines = [one.strip() for one in path.read_text("utf-8", errors="replace").splitlines()]
        names = [line for line in lines if line and not line.startswith("#")]
    else:
        return None
    near = [path.parent / name for name in names]
    return [one if one.exists() else path_of(name) for one, name in zip(near, names, strict=True)]


def tiles_from(name: str, paths: Iterable[Path]) -> Tiles:
    """Return files as one cloud; an `InputError` if the header of any cannot be read."""
    heads: dict[Path, tuple[Any, ...]] = {}
    for path in paths:
        if is_raster(path):
            sentence = "is one of several rasters. Merge them first, for example with gdalbuildvrt."
            raise bad_file(path, "cloud.rasters", sentence)
        with LasSource(path) as source:
            header, form = source.header, source.header.point_format
            kind = metric_crs(source), form.id, tuple(form.dimension_names)
            box = header.mins, header.maxs, float(max(header.scales))
            heads[path] = kind, len(source), *box
    kinds, counts, lows, highs, steps = zip(*heads.values(), strict=True)
    tiles = Tiles(name, tuple(heads), counts, np.array(lows), np.array(highs), max(steps))
    first = tiles.paths[0]
    for path, kind in zip(heads, kinds, strict=True):
        for words, *both in zip(("CRS", "point format", "dimensions"), kinds[0], kind, strict=True):
            if both[0] != both[1]:
                one, other = (getattr(value, "name", value) for value in both)
                sentence = f"{first.name} has the {words} {one}, {path.name} {other}. Convert them"
                sentence += " to the same, or correct them separately."
                raise bad_file(name, "cloud.mixed_tiles", sentence, paths=[first, path])
    import shapely  # slow to import

    # Warn of tiles that reach into each other by more than rounding, as points may be double
    margin = OVERLAP / 2.0 * (tiles.highs - tiles.lows)[:, :2]
    boxes = shapely.box(*(tiles.lows[:, :2] + margin).T, *(tiles.highs[:, :2] - margin).T)
    pairs = shapely.STRtree(boxes).query(boxes, predicate="intersects").T.tolist()
    found = [(tiles.paths[i].name, tiles.paths[j].name) for i, j in pairs if i < j]
    if found:
        sentence = (
            f"{' and '.join(found[0])} overlap, as do {len(found)} pairs. Points in both count"
        )
        sentence += " twice; cut off the buffers of the tiles."
        warn(tiles, "cloud.overlap", sentence, pairs=found)
    return tiles


RASTERS = (".tif", ".tiff", ".vrt", ".png", ".jpg", ".jpeg")
"""Of rasters; the last three only to say that pictures have no heights."""
READ_CELLS = 256
"""Side of the windows that are read, whose points are corrected at once."""
CACHE_BYTES = 64_000_000
"""Of GDAL, whose default is 5 % of the memory of the machine."""
STEPS_A_CELL = 1000.0
"""Coordinates of points are multiples of a power of ten, at least this much finer than a cell."""
_COLOURS = ("red", "green", "blue", "palette")


def is_raster(path: object) -> bool:
    """Whether a path is that of a raster by its name."""
    return str(path).lower().endswith(RASTERS)


class RasterSource(LasSource):
    """An open raster as a cloud, of LAS point format 6; see `LasSource`.

    It has the open `raster` with the number of the `band` of heights, its `crs`, the `window` of
    all cells and their side `cell_m`. Stored values of `dtype` are heights (m) after multiplication
    by `scale` and addition of `offset`; a copy has `nodata` where there is no height. The points of
    `part` are counted, see `band_of`; before that there are none.
    """

    def __init__(self, part: RasterBand) -> None:
        """Open; an `InputError` if its band does not contain heights in metres."""
        import rasterio
        from pyproj import CRS

        self.path = part.path
        with ExitStack() as stack:
            # GeoTIFF 1.0 states the vertical datum too, which GDAL ignores by default
            settings = rasterio.Env(GTIFF_REPORT_COMPD_CS=True, GDAL_CACHEMAX=CACHE_BYTES)
            stack.enter_context(settings)
            self.raster = raster = stack.enter_context(open_raster(part.path))
            self.band = band = _height_band(raster, part)
            self.crs = CRS(raster.crs.to_wkt())
            if metres_up(self.crs) < 0.0 or "depth" in f"{raster.descriptions[band - 1]}".lower():
                sentence = "contains depths (positive down). Give heights: water level minus depth."
                raise bad_file(part.path, "raster.depths", sentence)
            self.window = Window(0, raster.height, 0, raster.width)
            self.cell_m = float(np.sqrt(abs(raster.transform.determinant)))
            self.dtype = np.dtype(raster.dtypes[band - 1])
            self.scale, self.offset = raster.scales[band - 1], raster.offsets[band - 1]
            missing = NO_HEIGHT if self.dtype.kind == "f" else np.iinfo(self.dtype).max
            self.nodata = float(missing if raster.nodata is None else raster.nodata)
            # what a LAS file has: a header, and the record of a correction
            header = laspy.LasHeader(version="1.4", point_format=6)
            step = 10.0 ** np.floor(np.log10(self.cell_m / STEPS_A_CELL))
            header.scales = np.array([step, step, min(step, 0.0001)])
            box = np.array([[*raster.bounds[:2], 0.0], [*raster.bounds[2:], 0.0]])
            header.offsets = np.floor(box.mean(axis=0))
            header.add_crs(self.crs)
            header.generating_software = ""
            header.mins, header.maxs = (part.mins, part.maxs) if part.points else box
            header.point_count = part.points
            self.header, self.vlrs, self.evlrs = header, list(header.vlrs), []
            self.identity = bytes(68)
            record = raster.tags().get("PCFIX", "")
            if '"corrected": true' in record:
                self.vlrs.append(VLR(USER_ID, NOTES["settings"], "", record.encode()))
            metric_crs(self)
            self._stack = stack.pop_all()

    def __exit__(self, *exception: object) -> None:
        self._stack.close()

    def read(self, window: Window) -> FloatArray:
        """Return the heights of a window, shape (rows, columns), metres; NaN without one."""
        with raster_errors(self.path):
            stored = read_masked(self.raster, self.band, window=slices(window))
            for number, kind in enumerate(self.raster.colorinterp, start=1):
                if kind.name == "alpha":  # GDAL ignores it next to a band of floating point
                    stored[self.raster.read(number, window=slices(window)) == 0] = np.nan
        height = stored * self.scale + self.offset
        height[~(np.abs(height) <= IMPOSSIBLE_M)] = np.nan
        return height

    def chunks(self) -> Iterator[laspy.ScaleAwarePointRecord]:
        """Yield the points of each window with any, row by row."""
        for window in self.window.parts(READ_CELLS):
            height = self.read(window)
            row, column = np.nonzero(np.isfinite(height))
            if len(row) == 0:
                continue
            centre = column + window.column + 0.5, row + window.row + 0.5
            x, y = place_of(self.raster.transform, *centre)
            points = laspy.ScaleAwarePointRecord.zeros(len(row), header=self.header)
            xyz = np.column_stack([x, y, height[row, column]])
            steps = np.rint((xyz - self.header.offsets) / self.header.scales)
            points.array["X"], points.array["Y"], points.array["Z"] = steps.T
            points["return_number"][:] = points["number_of_returns"][:] = 1
            yield points


def _height_band(raster: DatasetReader, part: RasterBand) -> int:
    """Return the number of the band of heights; an `InputError` if there are other values."""
    path, band = part.path, part.band
    kinds = [one.name for one in raster.colorinterp]
    known = [number for number, kind in enumerate(kinds, 1) if kind != "alpha"]
    if band is not None and band not in known:
        sentence = f"has no band {band} of heights; it has {len(known)}. Give another --band."
        raise bad_file(path, "raster.band", sentence, band=band)
    asked = known if band is None else [band]
    if any(kinds[one - 1] in _COLOURS or raster.dtypes[one - 1] == "uint8" for one in asked):
        sentence = "is a picture (colours or a hillshade), not heights. Give the DSM."
        raise bad_file(path, "raster.picture", sentence)
    if len(asked) != 1:
        sentence = f"has {len(known)} bands. Give the one with the heights as --band N."
        raise bad_file(path, "raster.bands", sentence, bands=len(known))
    (band,) = asked
    if raster.crs is None or raster.transform.is_identity:
        sentence = "has no CRS, or no georeference. Assign it, for example with gdal_edit."
        raise bad_file(path, "raster.no_crs", sentence)
    unit = (raster.units[band - 1] or "").strip()
    if unit.lower() not in METRES:
        sentence = f"its heights are in '{unit}'. Convert them to metres."
        raise bad_file(path, "raster.unit", sentence, value=unit)
    return band

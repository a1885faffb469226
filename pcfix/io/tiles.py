"""Many LAS or LAZ files as one cloud: which they are, whether they go together, their points."""

from __future__ import annotations

import glob
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import shapely

from pcfix.errors import PcfixWarning, SettingError, bad_file
from pcfix.io.files import path_of, read_json, refusing
from pcfix.io.las.source import LasSource, RasterBand, coordinates, metric_crs
from pcfix.io.raster_cloud import RasterSource, is_raster
from pcfix.model import FloatArray
from pcfix.options.declare import File

if TYPE_CHECKING:
    import laspy

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
    # Warn of tiles that reach into each other by more than rounding, as points may be double
    margin = OVERLAP / 2.0 * (tiles.highs - tiles.lows)[:, :2]
    boxes = shapely.box(*(tiles.lows[:, :2] + margin).T, *(tiles.highs[:, :2] - margin).T)
    pairs = shapely.STRtree(boxes).query(boxes, predicate="intersects").T.tolist()
    found = [(tiles.paths[i].name, tiles.paths[j].name) for i, j in pairs if i < j]
    if found:
        sentence = f"{tiles}: {' and '.join(found[0])} overlap, as do {len(found)} pairs. Points in"
        sentence += " both count twice; cut off the buffers of the tiles."
        warnings.warn(PcfixWarning("cloud.overlap", sentence, pairs=found), stacklevel=3)
    return tiles

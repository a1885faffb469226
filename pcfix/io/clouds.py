"""Open clouds: one LAS file, many files as one cloud, or a raster; read points and references.

Comparisons and rasters need to know which points count, and where the water was.
"""

import glob
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import laspy
import numpy as np
import numpy.typing as npt

from pcfix.compare.match import Reference, SurveyCloud
from pcfix.errors import SettingError, bad_file, warn
from pcfix.io.crs import is_same, parts
from pcfix.io.files import check_input, path_of, read_json, refusing
from pcfix.io.las.columns import SHIFTS
from pcfix.io.las.source import LasSource, coordinates, metric_crs, stated_crs
from pcfix.io.las.writing import own_settings, record_errors
from pcfix.io.rasters import RasterBand, RasterSource, is_raster, open_raster, place_of, read_masked
from pcfix.io.tables import POINT_SPELLINGS, read_table
from pcfix.model import (
    BATHYMETRIC_POINT,
    NOISE_CLASSES,
    BoolArray,
    FloatArray,
    IntArray,
    Views,
    WaterDimension,
    WaterPlane,
    WaterSurface,
)
from pcfix.options.declare import File
from pcfix.running import FEW_ROWS, blocks, empty, mapped, release, subset

if TYPE_CHECKING:
    from pyproj import CRS


SUFFIXES = (".las", ".laz")


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


Clouds: TypeAlias = File | Iterable[File] | Tiles  # as users name them
CloudFiles: TypeAlias = Path | RasterBand | Tiles


def open_cloud(cloud: CloudFiles, jobs: int | None = None) -> LasSource:
    """Return the points of a file, or of many; see `LasSource`. Those of a raster are its cells."""
    if isinstance(cloud, Tiles):
        return TiledSource(cloud, jobs)
    if is_raster(cloud):
        return RasterSource(band_of(cloud))
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
    """Return many files as one cloud, and warn if they overlap; None for a path of a single file.

    A path is that of a folder, a glob (``tiles/*.laz``), a text list with a path on each line, or a
    virtual point cloud (``.vpc``); paths in these two may be relative to their own folder.
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
    elif suffix in (".txt", ".lst", ".list") and path.is_file():
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

    # Warn of tiles that reach into each other by more than 1 % of a side, which may be rounding:
    # points may be double
    margin = 0.005 * (tiles.highs - tiles.lows)[:, :2]
    boxes = shapely.box(*(tiles.lows[:, :2] + margin).T, *(tiles.highs[:, :2] - margin).T)
    pairs = shapely.STRtree(boxes).query(boxes, predicate="intersects").T.tolist()
    found = [(tiles.paths[i].name, tiles.paths[j].name) for i, j in pairs if i < j]
    if found:
        sentence = f"{' and '.join(found[0])} overlap, as do {len(found)} pairs. Points in both"
        sentence += " count twice; cut off the buffers of the tiles."
        warn(tiles, "cloud.overlap", sentence, pairs=found)
    return tiles


class Points(NamedTuple):
    """Some points of a cloud; None where the cloud does not have an attribute."""

    xyz: FloatArray  # (n, 3), world frame, metres
    heights: FloatArray | None  # (n,), of the water above each, if a dimension has it
    classes: npt.NDArray[np.uint8]  # (n,)
    rgb: npt.NDArray[Any] | None = None  # (n, 3)
    withheld: BoolArray | None = None  # (n,)
    original_xyz: FloatArray | None = None  # (n, 3), before the transfer to adjusted cameras
    views: Views | None = None
    dimensions: Mapping[str, FloatArray] | None = None  # (n,), those that were asked for, by name

    def counts(self, skip_classes: Sequence[int] = NOISE_CLASSES) -> BoolArray:
        """Return which points are neither withheld nor of some classes, shape (n,)."""
        good = ~np.isin(self.classes, skip_classes)
        return good if self.withheld is None else good & ~self.withheld

    def take(self, rows: IntArray | slice) -> "Points":
        """Return some of the points, without dimensions."""
        some: list[Any] = [None if v is None else np.ascontiguousarray(v[rows]) for v in self[:-2]]
        views = None if self.views is None else self.views.take(np.arange(len(self.xyz))[rows])
        return Points._make([*some, views, None])


@dataclass(frozen=True)
class CloudView:
    """A cloud in one file, in many, or in memory: its properties, and all its points."""

    name: str  # for messages
    crs: "CRS | str | None"
    low: FloatArray  # (2,), south-west and north-east corner, metres
    high: FloatArray
    points: int
    # of the water, whose heights a dimension may have, and of the names of further dimensions
    chunks: Callable[..., Iterator[Points]]
    software: str = ""  # generating software in the header
    step_m: float = 0.0  # coordinates are rounded to it
    names: Collection[str] = ()  # of its dimensions

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """West, south, east and north, metres."""
        return (*self.low.tolist(), *self.high.tolist())


def points_of(
    chunk: Any, source: LasSource, water: WaterSurface | None, names: Iterable[str] = ()
) -> Points:
    """Return the n points of a chunk, with the dimensions of some names."""
    known = chunk.array.dtype.names
    colours = [chunk.array[one] for one in ("red", "green", "blue") if one in known]
    return Points(
        coordinates(chunk),
        source.dimension(chunk, water.name) if isinstance(water, WaterDimension) else None,
        np.asarray(chunk["classification"]),
        np.column_stack(colours) if colours else None,
        np.asarray(chunk["withheld"]).astype(np.bool_),
        dimensions={name: source.dimension(chunk, name) for name in names},
    )


def read_cloud(
    path: Path | Tiles,
    water: WaterSurface | None = None,
    skip_classes: Sequence[int] = NOISE_CLASSES,
) -> SurveyCloud:
    """Read the points that count of a LAS or LAZ cloud, in one file or in many.

    Those of `skip_classes`, and withheld ones, are left out. The `water` is by default the one in
    the record of a cloud that pcfix corrected. An `InputError` if the file is damaged, no point
    counts, or it lacks the dimension that `water` names.
    """
    columns: list[npt.NDArray[Any]] = []
    first = 0
    with open_cloud(path) as source:
        own, crs, most = water or own_water(source), stated_crs(source), len(source)
        extra = source.header.point_format.extra_dimension_names
        names = {"WaterDepth", *SHIFTS}.intersection(extra)
        few = (c[rows] for c in source.chunks() for rows in blocks(len(c), FEW_ROWS))
        for points in (points_of(chunk, source, own, names) for chunk in few):
            known, used = points.dimensions or {}, points.counts(skip_classes)
            if water is None and "WaterDepth" in known:
                depth = known["WaterDepth"]
                above = np.where(depth > 0.0, points.xyz[:, 2] + depth, np.nan)
            elif own is not None:
                from pcfix.water.surface import surface_above  # with its compiler, slow to import

                above = surface_above(own, points.xyz, points.heights).height_m
            else:
                above = np.full(len(points.xyz), np.nan)
            bathymetric = subset(used, points.classes) == BATHYMETRIC_POINT
            # rows of the large arrays, which are made for all points when the first are known
            parts = [subset(used, points.xyz), subset(used, above), bathymetric]
            if known.keys() >= set(SHIFTS):
                parts.append(np.column_stack([known[name] for name in SHIFTS])[used])
            columns = columns or [empty((most, *part.shape[1:]), part.dtype) for part in parts]
            for column, part in zip(columns, parts, strict=True):
                column[first : first + len(part)] = part
            first += len(parts[0])
            release()
    xyz, water_m, bathymetric, *shifts = (column[:first] for column in columns)
    if first == 0:
        skipped = ", ".join(map(str, skip_classes))
        sentence = f"every point is withheld or in a class that is skipped ({skipped})."
        raise bad_file(path, "cloud.nothing_left", sentence)
    # the plane in the record is exact only if no dimension has the water above each point
    exact = water is not None or not mapped(np.isfinite, water_m).any()
    surface = own if exact and not isinstance(own, WaterDimension) else None
    shift_m = shifts[0] if shifts else None
    return SurveyCloud(str(path), xyz, crs, most - first, shift_m, bathymetric, water_m, surface)


def own_water(source: LasSource) -> WaterSurface | None:
    """Return the plane of the water surface that the cloud's own VLR names, if any."""
    with record_errors(source.path):
        ours = own_settings(source.vlrs)
        plane = None if ours is None else ours.get("water_plane")
        return None if plane is None else WaterPlane(*map(float, plane))


TABLES = (".csv", ".txt")
KINDS = "a cloud (.las, .laz), check points (.csv, .txt) or a grid (.tif, .tiff)"


def reference_of(reference: Clouds) -> Path | Tiles:
    """Return a file, or many as one cloud, see `cloud_of`; ``.txt`` is a table, no list of them."""
    is_path = isinstance(reference, str | PathLike)
    if is_path and path_of(reference).suffix.lower() in TABLES:
        return path_of(reference)
    return cloud_of(reference)


def is_cloud(reference: Path | Tiles) -> bool:
    """Whether a reference is one by its name."""
    return isinstance(reference, Tiles) or reference.suffix.lower() in SUFFIXES


def read_reference(reference: Clouds) -> Reference:
    """Read a reference of the kind that the end of its name states.

    ``.las``, ``.laz``, and many files of these: all points but those withheld and those of noise or
    water; ``.csv``, ``.txt``: columns x, y, z; ``.tif``, ``.tiff``: the centres of all cells with
    data. An `InputError` if it is none of these, damaged or empty.
    """
    found = reference_of(reference)
    if isinstance(found, Tiles) or is_cloud(check_input(found)):
        water = 9, 41, 42, 45  # ASPRS classes of water, its surface and column: not the bed
        cloud = read_cloud(found, skip_classes=NOISE_CLASSES + water)
        return Reference(cloud.name, cloud.xyz, cloud.crs, cloud.excluded)
    suffix = found.suffix.lower()
    if suffix in TABLES:
        xyz = read_table(found, ("x", "y", "z"), spellings=POINT_SPELLINGS).of("xyz")
        return Reference(str(found), xyz, None, sparse=True)
    if suffix not in (".tif", ".tiff"):
        raise bad_file(found, "reference.unknown", f"is not a reference. Give {KINDS}.")
    from pyproj import CRS

    with open_raster(found) as grid:  # the centres of the cells of its first band
        height = read_masked(grid)
        transform, crs = grid.transform, CRS(grid.crs.to_wkt()) if grid.crs else None
    if transform.is_identity:
        sentence = "has no georeference. Give a georeferenced GeoTIFF."
        raise bad_file(found, "raster.not_georeferenced", sentence)
    row, column = np.nonzero(np.isfinite(height))
    if len(row) == 0:
        raise bad_file(found, "raster.empty", "no cell contains a height.")
    x, y = place_of(transform, column + 0.5, row + 0.5)
    xyz = np.column_stack([x, y, height[row, column]])
    return Reference(str(found), xyz, crs, height.size - len(xyz), raster=True)


def check_same_crs(cloud: str, crs: "CRS | None", reference: str, other: "CRS | None") -> None:
    """Refuse to compare what does not lie in one CRS; warn where one has none.

    Nothing is transformed here: heights moved silently between datums would look like errors of the
    cloud. An `InputError` if the CRS differ in plan or in height, or are in degrees.
    """
    for name, one in ((cloud, crs), (reference, other)):
        if one is not None and one.is_geographic:
            sentence = f"is in degrees ({one.name}). Reproject it to a CRS in metres first."
            raise bad_file(name, "crs.degrees", sentence, crs=one.name)
    if crs is None or other is None:
        if crs is not other:
            bare, name = (cloud, other.name) if other else (reference, crs.name if crs else "")
            warn(bare, "crs.assumed", f"names no CRS; {name} is assumed.", path=bare)
        return
    codes = "crs.differs", "crs.heights_differ"
    for code, one, another in zip(codes, parts(crs), parts(other), strict=True):
        if one is not None and another is not None and not is_same(one, another):
            sentence = f"is in {another.name}, the cloud in {one.name}. Transform it to that first."
            raise bad_file(reference, code, sentence, crs=another.name, expected=one.name)

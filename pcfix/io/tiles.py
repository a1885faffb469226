"""Many LAS or LAZ files as one cloud: which they are, whether they go together, their points."""

from __future__ import annotations

import glob
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import numpy as np

from pcfix.errors import InputError, PcfixWarning, SettingError
from pcfix.io.files import path_of, read_json
from pcfix.io.las.source import LasSource, metric_crs
from pcfix.model import FloatArray
from pcfix.options.declare import File

if TYPE_CHECKING:
    import laspy

Clouds: TypeAlias = "File | Iterable[File] | Tiles"

SUFFIXES = (".las", ".laz")
LISTS = (".txt", ".lst", ".list")
OVERLAP = 0.01
"""Of the smaller tile's side: neighbours may reach so far into each other, by rounding."""


class BrokenTileError(InputError):
    """One of many files that cannot be read; `path` is which."""

    def __init__(self, path: Path, sentence: str) -> None:
        super().__init__("cloud.broken_tile", sentence, path=path)
        self.path = path


@dataclass(frozen=True)
class Tiles:
    """Files that are read as one cloud, in their order.

    Attributes
    ----------
    name : str
        As the user names them.
    paths : tuple of path
    points : tuple of int
        Of each file.
    lows, highs : array, shape (files, 3)
        The corners of each file, metres.
    step_m : float
        The coarsest scale.
    broken : dict
        The files that cannot be read, and why; they are not in `paths`.
    """

    name: str
    paths: tuple[Path, ...]
    points: tuple[int, ...]
    lows: FloatArray
    highs: FloatArray
    step_m: float
    broken: dict[Path, str] = field(default_factory=dict)

    def __str__(self) -> str:
        return self.name

    def __len__(self) -> int:
        return sum(self.points)

    def without(self, path: Path, why: str) -> Tiles:
        """Return the others, where one turns out to be broken."""
        rows = [i for i, one in enumerate(self.paths) if one != path]
        if not rows:
            raise InputError("cloud.broken_files", why)
        return replace(
            self,
            paths=tuple(self.paths[i] for i in rows),
            points=tuple(self.points[i] for i in rows),
            lows=self.lows[rows],
            highs=self.highs[rows],
            broken={**self.broken, path: why},
        )


class TiledSource(LasSource):
    """Many open files, one after another; see `LasSource`. What is not of points is the first's."""

    def __init__(self, tiles: Tiles, jobs: int | None = None, *, places_only: bool = False) -> None:
        """Open the first."""
        super().__init__(tiles.paths[0], jobs)
        self._tiles, self._jobs, self.path = tiles, jobs, Path(tiles.name)
        self._places_only = places_only
        self.header.mins, self.header.maxs = tiles.lows.min(axis=0), tiles.highs.max(axis=0)
        self.header.scales = np.full(3, tiles.step_m)
        self.header.point_count = len(tiles)

    def chunks(self) -> Iterator[laspy.ScaleAwarePointRecord]:
        """Yield all points; a `BrokenTileError` if a file cannot be read to its end."""
        for path in self._tiles.paths:
            try:
                with LasSource(path, self._jobs, places_only=self._places_only) as source:
                    yield from source.chunks()
            except InputError as error:
                raise BrokenTileError(path, str(error)) from error


def open_cloud(
    cloud: Path | Tiles, jobs: int | None = None, *, places_only: bool = False, kept: Any = None
) -> LasSource:
    """Return the points of a file, or of many; see `LasSource`."""
    if isinstance(cloud, Tiles):
        return TiledSource(cloud, jobs, places_only=places_only)
    return LasSource(cloud, jobs, places_only=places_only, kept=kept)


def check_one_file(cloud: Any, options: Any) -> None:
    """Refuse options that are about one file, or about many, where it is the other."""
    many = isinstance(cloud, Tiles)
    for name in ("bounds", "read_resolution") if many else ("scheduler",):
        if getattr(options, name, None) is not None:
            kind = "a single file" if many else "many files (a folder, glob or list of tiles)"
            raise SettingError(
                "option.one_file",
                f"{name.replace('_', '-')} works only with {kind}; omit it.",
                option=name,
            )


def inputs_of(cloud: Any) -> list[Any]:
    """Return the files of a cloud, one or many."""
    return [*cloud.paths, *cloud.broken] if isinstance(cloud, Tiles) else [cloud]


def single(cloud: Clouds) -> File:
    """Return the path of a single file."""
    return cast(File, cloud)


def tiles_of(cloud: Clouds) -> Tiles | None:
    """Return many files as one cloud; None if a path is that of a single file.

    Parameters
    ----------
    cloud : path, iterable of paths, or Tiles
        A folder, a glob (``tiles/*.laz``), a text list with a path on each line, or a virtual
        point cloud (``.vpc``); paths in these two may be relative to their own folder.

    Raises
    ------
    PcfixError
        If there are no files, or they do not go together.

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
        raise InputError(
            "cloud.no_files",
            f"{name}: contains no LAS or LAZ files. Give a folder, glob or list that does.",
            path=name,
        )
    by_name: dict[str, Path] = {}
    for path in paths:
        other = by_name.setdefault(path.name, path)
        if other is not path:
            raise SettingError(
                "cloud.same_names",
                f"{name}: {other} and {path} would both be written as {path.name}. Rename one of"
                " them, or correct them one by one.",
                path=path,
            )
    return tiles_from(name, paths)


def cloud_of(cloud: Clouds) -> Path | Tiles:
    """Return a file, or many as one cloud that lacks none of them; see `tiles_of`.

    Raises
    ------
    PcfixError
        If one of many cannot be read: what is made of all would be without its points.
    """
    tiles = tiles_of(cloud)
    if tiles is None:
        return path_of(cloud)
    if tiles.broken:
        count, why = len(inputs_of(tiles)), "\n".join(f"  {one}" for one in tiles.broken.values())
        raise InputError(
            "cloud.broken_files",
            f"{tiles}: {len(tiles.broken)} of {count} files cannot be read. Replace them, or give"
            f" only the others:\n{why}",
            paths=list(tiles.broken),
        )
    return tiles


def _listed(path: Path) -> list[Path] | None:
    """Return the files that a path stands for; None if it is that of a single one."""
    text = str(path)
    if path.suffix.lower() in SUFFIXES and not glob.has_magic(text):
        return None
    if glob.has_magic(text) and not path.exists():
        return sorted(Path(path.anchor).glob(str(path.relative_to(path.anchor))))
    if path.suffix.lower() == ".vpc":
        return _of_index(path)
    if path.suffix.lower() in LISTS and path.is_file():
        lines = [one.strip() for one in path.read_text("utf-8", errors="replace").splitlines()]
        return [_beside(path, line) for line in lines if line and not line.startswith("#")]
    if path.is_dir():
        return sorted(one for one in path.iterdir() if one.suffix.lower() in SUFFIXES)
    return None


def _beside(path: Path, text: str) -> Path:
    """Return a path that a list names: beside the list, else as it is."""
    return path.parent / text if (path.parent / text).exists() else path_of(text)


def _of_index(path: Path) -> list[Path]:
    """Return the files of a virtual point cloud: a STAC feature collection, an item for each."""
    try:
        features = read_json(path)["features"]
        links = [next(iter(one["assets"].values()))["href"] for one in features]
        return [_beside(path, link.removeprefix("file://")) for link in links]
    except (OSError, ValueError, KeyError, TypeError, AttributeError, StopIteration) as error:
        raise InputError(
            "cloud.index",
            f"{path}: is not a virtual point cloud ({type(error).__name__}: {error}). Give the"
            " index that 'pdal_wrench build_vpc' writes, or a folder of tiles.",
            path=path,
        ) from error


def tiles_from(name: str, paths: Iterable[Path]) -> Tiles:
    """Return files as one cloud; those whose header cannot be read are told apart.

    Raises
    ------
    InputError
        If their coordinate systems or dimensions are not the same, or none can be read.
    """
    kinds: dict[Path, tuple[Any, ...]] = {}
    heads: dict[Path, tuple[int, FloatArray, FloatArray, float]] = {}
    broken: dict[Path, str] = {}
    for path in paths:
        try:
            with LasSource(path) as source:
                header = source.header
                crs, format = metric_crs(source), header.point_format
                words = f"CRS {crs.name}" if crs else "no CRS"
                kinds[path] = (crs, format.id, tuple(format.dimension_names), words)
                heads[path] = (len(source), header.mins, header.maxs, float(max(header.scales)))
        except InputError as error:
            broken[path] = str(error)
    if not heads:
        raise InputError("cloud.broken_files", next(iter(broken.values())), paths=list(broken))
    _refuse_mixed(name, kinds)
    _warn_of_overlap(name, {path: (low, high) for path, (_, low, high, _) in heads.items()})
    points, lows, highs, steps = zip(*heads.values(), strict=True)
    return Tiles(name, tuple(heads), points, np.array(lows), np.array(highs), max(steps), broken)


def _refuse_mixed(name: str, kinds: dict[Path, tuple[Any, ...]]) -> None:
    """Refuse files of several coordinate systems, point formats or extra dimensions."""
    first, *rest = kinds
    one = kinds[first]
    others = [path for path in rest if kinds[path][:3] != one[:3]]
    if not others:
        return
    other = kinds[others[0]]
    said = [
        (one[3], other[3]), (f"point format {one[1]}", f"point format {other[1]}"),
        (f"dimensions {', '.join(one[2])}", f"dimensions {', '.join(other[2])}"),
    ]  # fmt: skip
    at = next(i for i in range(3) if one[i] != other[i])
    more = f" (and {len(others) - 1} more)" if len(others) > 1 else ""
    raise InputError(
        "cloud.mixed_tiles",
        f"{name}: {first.name} has {said[at][0]}, {others[0].name}{more} {said[at][1]}. Convert"
        " them to the same, or correct them separately.",
        paths=[first, others[0]],
    )


def _warn_of_overlap(name: str, boxes: dict[Path, tuple[FloatArray, FloatArray]]) -> None:
    """Warn of tiles that lie in each other by more than their borders, as points may be double."""
    order = sorted(boxes, key=lambda path: float(boxes[path][0][0]))
    found = []
    for i, one in enumerate(order):
        for other in order[i + 1 :]:
            if boxes[other][0][0] > boxes[one][1][0]:
                break
            low = np.maximum(boxes[one][0], boxes[other][0])[:2]
            high = np.minimum(boxes[one][1], boxes[other][1])[:2]
            sides = [(box[1] - box[0])[:2] for box in (boxes[one], boxes[other])]
            if (high - low > OVERLAP * np.minimum(*sides)).all() and (high > low).all():
                found.append((one.name, other.name))
    if found:
        warnings.warn(
            PcfixWarning(
                "cloud.overlap",
                f"{name}: the extents of {found[0][0]} and {found[0][1]} overlap ({len(found)}"
                " pairs do). Points in both count twice; cut off the buffers of the tiles.",
                pairs=found,
            ),
            stacklevel=3,
        )

"""The cleaning of a LAS or LAZ file: read, test, write, in bounded memory."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pcfix.clean.neighbours import Empty
from pcfix.clean.points import check_tile, flag_neighbours, flag_weak
from pcfix.clean.settings import CleanSummary, Reason
from pcfix.errors import InputError
from pcfix.flow.surfaces import find_surface, view_of
from pcfix.io.files import check_input, check_output, scratch_arrays, write_text
from pcfix.io.las.columns import convert
from pcfix.io.las.source import LasSource, coordinates
from pcfix.io.las.writing import (
    LasSink,
    check_suffix,
    cleaning_vlr,
    corrected_identity,
    noted_header,
    output_evlrs,
)
from pcfix.model import HIGH_NOISE, LOW_NOISE, BoolArray, FloatArray, WaterDimension, WaterSurface
from pcfix.options.declare import File, taken
from pcfix.options.shared import WaterOptions
from pcfix.options.steps import CleanOptions, CleanRules
from pcfix.threads import threads
from pcfix.version import __version__
from pcfix.water.checks import check_submerged
from pcfix.water.surface import is_submerged, surface_above

if TYPE_CHECKING:
    import laspy

AnyPath = str | PathLike[str]

"""ASPRS classes of low and high noise (LAS 1.4 R15, table 17)."""
_PASSES = 4


def clean_file(
    input: File,
    output: File,
    *,
    options: CleanOptions | None = None,
    tile_m: float | None = None,
    progress: Callable[[int, int], None] | None = None,
    **keywords: Any,
) -> CleanSummary:
    """Flag or drop the noise of a LAS or LAZ cloud; what ``pcfix clean`` runs.

    Noise gets class 7 and the withheld flag; nothing else of it changes, and nothing at all of
    the other points. Points that come withheld or with class 7 or 18 stay as they are and are
    no one's neighbour. `restore_file` undoes a correction before or after the cleaning; it gives
    back all but the class and the withheld flag of the points that are noise.

    Parameters
    ----------
    input, output : path
        The names end in ``.las`` or ``.laz``; the output is LAS 1.4, see `correct_file`. While
        it works, it needs 90 bytes a point of disk beside the output.
    options : CleanOptions, optional
        Or its attributes as keywords, as of ``pcfix clean``: the thresholds of the tests, water,
        drop and others.
    tile_m : float, optional
        Side of the square tiles that are worked on. The result does not depend on it.
    progress : callable, optional
        Called with (points done, points in all), over all passes.

    Returns
    -------
    CleanSummary

    Raises
    ------
    PcfixError
        With one sentence on what to mend; no output is left behind.
    """
    started = time.perf_counter()
    given = taken(CleanOptions, options, keywords, "clean_file")
    settings, water, drop, jobs = given.part(CleanRules), given.water, given.drop, given.jobs
    summary, overwrite = given.summary, given.overwrite
    check_tile(tile_m)
    source = check_input(input)
    inputs = [p for p in (input, water) if isinstance(p, str | PathLike)]
    target = check_output(output, overwrite=overwrite, inputs=inputs)
    check_suffix(target)
    if summary is not None:
        check_output(summary, overwrite=overwrite, inputs=[*inputs, target])
    surface = _surface(water, source)
    with threads(jobs):
        with scratch_arrays(target) as empty, LasSource(source, jobs) as las:
            steps = _Steps(len(las), progress)
            found = _find(las, surface, settings, _Means(empty, tile_m, jobs, steps))
        content: dict[str, Any] = {
            "pcfix": __version__,
            "settings": asdict(settings),
            "water": None if surface is None else str(surface),
            "reasons": _counts(found.reasons),
        }
        _write(source, target, {**content, "drop": drop}, found.reasons, jobs, steps)
    noise = int(np.count_nonzero(found.reasons))
    result = CleanSummary(
        input=str(source),
        output=str(target),
        points=len(found.reasons),
        set_aside=found.set_aside,
        submerged=found.submerged,
        noise=noise,
        dropped=noise if drop else 0,
        neighbour_distance_m=found.distance_m,
        not_run=found.not_run,
        seconds=round(time.perf_counter() - started, 3),
        **content,
    )
    if summary is not None:
        write_text(summary, json.dumps(result.as_dict(), indent=2) + "\n", overwrite=overwrite)
    return result


class _Steps:
    """Adds up the points of all passes for a bar."""

    def __init__(self, points: int, progress: Callable[[int, int], None] | None) -> None:
        self._points, self._progress, self._done = points, progress, 0

    def add(self, count: int) -> None:
        """Report so many more points."""
        self._done += count
        if self._progress is not None:
            self._progress(self._done // _PASSES, self._points)


class _Means(NamedTuple):
    """With what the work is done; without effect on the result."""

    empty: Empty
    tile_m: float | None
    jobs: int | None
    steps: _Steps


class _Found(NamedTuple):
    """The result of all tests, in the order of the file, and counts for the summary."""

    reasons: npt.NDArray[np.uint8]
    set_aside: int
    submerged: int
    distance_m: dict[str, float]
    not_run: list[str]


def _find(
    las: LasSource, water: WaterSurface | None, settings: CleanRules, means: _Means
) -> _Found:
    """Read the cloud and run the tests."""
    cloud = _read(las, water, settings, means)
    _check_cloud(las, cloud, water, settings)
    if not settings.below_or_floating:
        cloud.submerged[:] = False
    distance_m = flag_neighbours(
        str(las.path),
        *cloud[:3],
        settings,
        cloud.reasons,
        tile_m=means.tile_m,
        empty=means.empty,
        jobs=means.jobs,
        progress=means.steps.add,
    )
    names = set(las.header.point_format.dimension_names)
    return _Found(
        cloud.reasons,
        int((~cloud.used).sum()),
        int(cloud.submerged.sum()),
        distance_m,
        _not_run(names, water, settings),
    )


class _Cloud(NamedTuple):
    """What the tests need of a file, in its order."""

    xyz: FloatArray
    used: BoolArray
    submerged: BoolArray
    reasons: npt.NDArray[np.uint8]


def _surface(water: WaterSurface | float | AnyPath | None, path: Path) -> WaterSurface | None:
    return None if water is None else find_surface(water, WaterOptions(), view_of(path)).surface


def _read(
    las: LasSource, water: WaterSurface | None, settings: CleanRules, means: _Means
) -> _Cloud:
    """Read coordinates and masks, and flag weak intersections on the way."""
    n, names = len(las), set(las.header.point_format.dimension_names)
    used, submerged, reasons = np.zeros(n, np.bool_), np.zeros(n, np.bool_), np.zeros(n, np.uint8)
    cloud = _Cloud(means.empty((n, 3), np.float64), used, submerged, reasons)
    first = 0
    for points in las.chunks():
        rows = slice(first, first + len(points))
        xyz = coordinates(points)
        classes = np.asarray(points["classification"])
        withheld = np.asarray(points["withheld"]).astype(np.bool_)
        good = ~(withheld | (classes == LOW_NOISE) | (classes == HIGH_NOISE))
        rays = las.dimension(points, "RayCount") if "RayCount" in names else None
        if rays is not None:
            optional = [
                las.dimension(points, d) if d in names else None for d in ("RayMiss", "Incidence")
            ]
            flag_weak(settings, cloud.reasons[rows], rays, *optional)
            cloud.reasons[rows][~good] = 0
        cloud.xyz[rows], cloud.used[rows] = xyz, good
        cloud.submerged[rows] = good & _submerged(las, points, xyz, water, rays)
        first = rows.stop
        means.steps.add(len(points))
    return cloud


def _submerged(
    las: LasSource,
    points: laspy.ScaleAwarePointRecord,
    xyz: FloatArray,
    water: WaterSurface | None,
    rays: FloatArray | None,
) -> BoolArray:
    if water is None:
        return np.zeros(len(xyz), np.bool_) if rays is None else rays > 0
    heights = las.dimension(points, water.name) if isinstance(water, WaterDimension) else None
    return is_submerged(xyz[:, 2], surface_above(water, xyz, heights))


def _not_run(names: set[str], water: WaterSurface | None, settings: CleanRules) -> list[str]:
    """Return which tests the file does not allow, and why."""
    needs = (
        ("few rays", "RayCount", settings.min_rays),
        ("ray miss", "RayMiss", settings.max_ray_miss),
        ("incidence", "Incidence", settings.max_incidence),
    )
    missing = [
        f"{test}: the cloud has no dimension {dimension if 'RayCount' in names else 'RayCount'}"
        for test, dimension, limit in needs
        if limit is not None and not {"RayCount", dimension} <= names
    ]
    if settings.below_or_floating and water is None and "RayCount" not in names:
        missing.append("below bed, floating: no --water, and no dimension RayCount")
    return missing


def _check_cloud(
    las: LasSource, cloud: _Cloud, water: WaterSurface | None, settings: CleanRules
) -> None:
    """Refuse a cloud that leaves nothing to test."""
    if not cloud.used.any():
        raise InputError(
            f"{las.path}: all {len(las):,} points are withheld or noise (class 7 or 18) already;"
            " there is nothing left to clean."
        )
    if water is not None and settings.below_or_floating:
        check_submerged(int(cloud.submerged.sum()), str(las.path), water)


def _counts(reasons: npt.NDArray[np.uint8]) -> dict[str, int]:
    return {
        reason.name.lower(): int(np.count_nonzero(reasons & np.uint8(reason)))
        for reason in Reason
        if reason.name is not None
    }


def _write(
    path: Path,
    target: Path,
    content: dict[str, Any],
    reasons: npt.NDArray[np.uint8],
    jobs: int | None,
    steps: _Steps,
) -> None:
    """Copy the file, with its noise flagged or left out."""
    drop = content["drop"]
    if drop and reasons.all():
        raise InputError(
            f"{path}: every point is noise by these thresholds; choose wider ones, or do not drop."
        )
    with LasSource(path, jobs) as source:
        header = noted_header(source, cleaning_vlr(content))
        evlrs, identity = output_evlrs(source), corrected_identity(source)
        with LasSink(target, header, evlrs, identity, jobs) as sink:
            first = 0
            for points in source.chunks():
                new = convert(points, header.point_format)
                noise = reasons[first : first + len(new)] != 0
                first += len(new)
                if drop:
                    new = new[~noise]
                else:
                    new.array["classification"][noise] = LOW_NOISE
                    new["withheld"][:] = np.asarray(new["withheld"]) | noise
                sink.write(new)
                steps.add(len(noise))

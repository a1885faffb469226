"""The cleaning of a LAS or LAZ file: read, test, write, in bounded memory."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pcfix.blocks import empty, let_go
from pcfix.clean.points import (
    CleanSummary,
    Cloud,
    Reason,
    Resources,
    check_tile,
    flag_neighbours,
    flag_weak,
)
from pcfix.errors import InputError
from pcfix.flow.runner import Chunk, FileTask, Header, Progress, Step, file_task
from pcfix.flow.surfaces import CloudView, Points, find_surface, points_of, view_of
from pcfix.flow.tiles import TiledRun
from pcfix.io.drafts import all_or_none
from pcfix.io.files import local_path, scratch_arrays
from pcfix.io.las.columns import convert
from pcfix.io.las.source import LasSource
from pcfix.io.las.writing import cleaning_vlr, noted_header, own_settings
from pcfix.io.tiles import Clouds, Tiles, open_cloud, single, tiles_of
from pcfix.kernels import threads
from pcfix.model import LOW_NOISE, NOISE_CLASSES, BoolArray, FloatArray, WaterSurface
from pcfix.options.declare import File, taken
from pcfix.options.shared import WaterOptions
from pcfix.options.steps import CleanOptions, CleanRules
from pcfix.sums import Sums
from pcfix.version import __version__
from pcfix.water.checks import check_submerged
from pcfix.water.surface import is_submerged, surface_above

_PASSES = 4


def clean_file(
    input: Clouds,
    output: File,
    *,
    options: CleanOptions | None = None,
    tile_m: float | None = None,
    progress: Progress | None = None,
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
        it works, it needs 90 bytes a point of disk beside the output. Or many files and a folder,
        see `pcfix.correct_file`: neighbours are those of the whole cloud.
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
    given = taken(CleanOptions, options, keywords, "clean_file")
    check_tile(tile_m)
    how, last = Resources(tile_m, given.jobs), _last_pass(progress)
    tiles = tiles_of(input)
    if tiles is not None:
        folder = local_path(output)
        there = next(one for one in (folder, *folder.absolute().parents) if one.is_dir())
        run = TiledRun("clean", tiles, folder, given, last)
        return run.run(
            lambda part: _Cleaning(part, given, there / folder.name, how, progress),
            lambda step: step.summary(str(tiles), str(output), run.seconds),
        )
    task = file_task(single(input), output, given, reads=[given.water], progress=last)
    with threads(given.jobs):
        step = _Cleaning(task.source, given, task.target, how, progress)
    with all_or_none():
        task.run(step)
        result = step.summary(str(task.source), str(task.target), task.seconds)
        task.tell(result.as_dict())
    return result


def _last_pass(progress: Progress | None) -> Progress | None:
    """Return what the writing tells, once the points have gone through all other passes."""
    if progress is None:
        return None
    return lambda done, total: progress(((_PASSES - 1) * total + done) // _PASSES, total)


RAY_DIMENSIONS = ("RayCount", "RayMiss", "Incidence")
"""What a correction said of each point, and the tests of weak intersections need."""


class Tested(NamedTuple):
    """Some points, and by name those of `RAY_DIMENSIONS` that the cloud has, shape (n,)."""

    points: Points
    withheld: BoolArray
    rays: dict[str, FloatArray]


class NoiseSearch:
    """The tests of a whole cloud, whichever door it came through.

    Parameters
    ----------
    name : str
        Of the cloud, for messages.
    options : CleanOptions
    view : callable
        Returns the cloud as a water surface needs it.
    names : collection of str
        The dimensions that the cloud has.
    has_rays : bool
        Whether, if it was corrected, there were cameras.
    """

    cloud: Cloud

    def __init__(
        self,
        name: str,
        options: CleanOptions,
        view: Callable[[], CloudView],
        names: Collection[str],
        *,
        has_rays: bool = True,
    ) -> None:
        rules = options.part(CleanRules)
        self._not_run = []
        if rules.weak and not has_rays:
            rules = replace(rules, weak=False)
            self._not_run = [
                "few rays, ray miss, incidence: the cloud was corrected without cameras"
            ]
        self._name, self._rules = name, rules
        given = options.water
        self.water = None if given is None else find_surface(given, WaterOptions(), view()).surface
        self._has = [one for one in RAY_DIMENSIONS if {"RayCount", one} <= set(names)]

    def run(self, chunks: Iterable[Tested], n: int, resources: Resources) -> BoolArray:
        """Run the tests on all n points; return which are noise, shape (n,)."""
        used, submerged, reasons = (np.zeros(n, kind) for kind in (bool, bool, np.uint8))
        self.cloud = Cloud(empty((n, 3)), used, submerged, reasons)
        first = 0
        for one in chunks:
            self._add(one, slice(first, first + len(one.withheld)))
            first += len(one.withheld)
            let_go()
            if resources.progress is not None:
                resources.progress(len(one.withheld))
        self._check()
        if not self._rules.below_or_floating:
            submerged[:] = False
        self._distance_m = flag_neighbours(self._name, self.cloud, self._rules, resources)
        self.cloud = self.cloud._replace(xyz=np.zeros((0, 3)))  # gives the disk back
        return reasons != 0

    def _add(self, one: Tested, rows: slice) -> None:
        """Take coordinates and masks, and flag weak intersections on the way."""
        cloud, (xyz, heights, classes, *_) = self.cloud, one.points
        used = ~(one.withheld | np.isin(classes, NOISE_CLASSES))
        rays, miss, incidence = (one.rays.get(name) for name in RAY_DIMENSIONS)
        if rays is not None:
            flag_weak(self._rules, cloud.reasons[rows], rays, miss, incidence)
            cloud.reasons[rows][~used] = 0
        cloud.xyz[rows], cloud.used[rows] = xyz, used
        if self.water is not None:
            above = surface_above(self.water, xyz, heights)
            cloud.submerged[rows] = used & is_submerged(xyz[:, 2], above)
        elif rays is not None:
            cloud.submerged[rows] = used & (rays > 0)

    def _check(self) -> None:
        """Refuse a cloud that leaves nothing to test."""
        if not self.cloud.used.any():
            raise InputError(
                f"{self._name}: all {len(self.cloud.used):,} points are withheld or noise (class 7"
                " or 18) already; there is nothing left to clean."
            )
        if self.water is not None and self._rules.below_or_floating:
            check_submerged(int(self.cloud.submerged.sum()), self._name, self.water)

    def _tests_not_run(self) -> list[str]:
        """Return which tests the cloud does not allow, and why."""
        rules, has = self._rules, self._has
        needs = (
            ("few rays", "RayCount", rules.min_rays),
            ("ray miss", "RayMiss", rules.max_ray_miss),
            ("incidence", "Incidence", rules.max_incidence),
        )
        missing = self._not_run + [
            f"{test}: the cloud has no dimension {dimension if has else 'RayCount'}"
            for test, dimension, limit in needs
            if limit is not None and dimension not in has
        ]
        if rules.below_or_floating and self.water is None and not has:
            missing.append("below bed, floating: no --water, and no dimension RayCount")
        return missing

    def content(self) -> dict[str, Any]:
        """Return what the file and the summary say of the cleaning."""
        reasons = self.cloud.reasons
        return {
            "pcfix": __version__,
            "settings": asdict(self._rules),
            "water": None if self.water is None else str(self.water),
            "reasons": {
                str(reason.name).lower(): int(np.count_nonzero(reasons & np.uint8(reason)))
                for reason in Reason
            },
        }

    def summary(self, input: str, output: str, *, drop: bool, seconds: float) -> CleanSummary:
        """Return the numbers of the cleaning."""
        cloud, noise = self.cloud, int(np.count_nonzero(self.cloud.reasons))
        return CleanSummary(
            input=input,
            output=output,
            points=len(cloud.used),
            set_aside=int((~cloud.used).sum()),
            submerged=int(cloud.submerged.sum()),
            noise=noise,
            dropped=noise if drop else 0,
            neighbour_distance_m=self._distance_m,
            not_run=self._tests_not_run(),
            seconds=round(seconds, 3),
            **self.content(),
        )


class _Cleaning(Sums, Step):
    """The step that flags noise or leaves it out, once it was found in the whole cloud.

    Large arrays of the search lie beside a file meanwhile. A bit for each point is kept.
    """

    def __init__(
        self,
        cloud: Path | Tiles,
        options: CleanOptions,
        beside: Path,
        how: Resources,
        progress: Progress | None,
    ) -> None:
        with open_cloud(cloud) as source:
            names = set(source.header.point_format.dimension_names)
            points, has_rays = len(source), _has_rays(source)
        passed = 0

        def count(some: int) -> None:
            nonlocal passed
            passed += some
            if progress is not None:
                progress(passed // _PASSES, points)

        search = NoiseSearch(str(cloud), options, lambda: view_of(cloud), names, has_rays=has_rays)
        with scratch_arrays(beside):
            tested = _tested(cloud, search.water, how.jobs)
            noise = search.run(tested, points, how._replace(progress=count))
        self._drop, self._noise = options.drop, np.packbits(noise)
        self._content = {**search.content(), "drop": options.drop}
        self._summary = search.summary("", "", drop=options.drop, seconds=0.0)
        if self._drop and noise.all():
            raise InputError(
                f"{cloud}: every point is noise by these thresholds; choose wider ones, or do not"
                " drop."
            )
        self.begin(0)

    def begin(self, first_row: int) -> None:
        """Go on at a row of the whole cloud."""
        self._row = first_row

    def run(self, task: FileTask) -> None:
        """Take a file through."""
        task.run(self)

    def header(self, source: LasSource) -> Header:
        """Return the header with the record of what is done."""
        return noted_header(source, cleaning_vlr(self._content))

    def chunk(self, points: Chunk, source: LasSource, header: Header) -> Callable[[], Chunk]:
        """Return what flags the noise among points, or leaves it out."""
        first, byte = self._row, self._row // 8
        self._row += len(points)
        bits = np.unpackbits(self._noise[byte : (self._row + 7) // 8])
        noise = bits[first - 8 * byte : self._row - 8 * byte].astype(np.bool_)
        return partial(self._cleaned, points, header, noise)

    def _cleaned(self, points: Chunk, header: Header, noise: BoolArray) -> Chunk:
        new = convert(points, header.point_format)
        if self._drop:
            return new[~noise]
        new.array["classification"][noise] = LOW_NOISE
        new["withheld"][:] = np.asarray(new["withheld"]) | noise
        return new

    def summary(self, input: str, output: str, seconds: float) -> CleanSummary:
        """Return the numbers of the cleaning."""
        return replace(self._summary, input=input, output=output, seconds=round(seconds, 3))


def _tested(cloud: Path | Tiles, water: WaterSurface | None, jobs: int | None) -> Iterator[Tested]:
    with open_cloud(cloud, jobs) as source:
        names = set(source.header.point_format.dimension_names)
        for chunk in source.chunks():
            rays = {name: source.dimension(chunk, name) for name in RAY_DIMENSIONS if name in names}
            withheld = np.asarray(chunk["withheld"]).astype(np.bool_)
            yield Tested(points_of(chunk, source, water), withheld, rays)


def _has_rays(source: LasSource) -> bool:
    """Return whether a cloud, if it was corrected, was so with cameras."""
    try:
        ours = own_settings(source.vlrs)
    except ValueError:  # whoever needs it says so
        return True
    return not (isinstance(ours, dict) and ours.get("cameras") == 0)

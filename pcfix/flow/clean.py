"""Clean a LAS or LAZ file: read, test, write, in bounded memory."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

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
from pcfix.flow.runner import Chunk, Command, Progress, streaming
from pcfix.flow.surfaces import CloudView, Points, find_surface, points_of, view_of
from pcfix.flow.tiles import run_command
from pcfix.io.files import scratch_arrays
from pcfix.io.las.columns import convert
from pcfix.io.las.source import LasSource
from pcfix.io.las.writing import cleaning_vlr, corrected_identity, noted_header, own_settings
from pcfix.io.tiles import Clouds, Tiles, open_cloud
from pcfix.model import LOW_NOISE, NOISE_CLASSES, BoolArray, FloatArray, WaterSurface
from pcfix.options.declare import File, taken
from pcfix.options.shared import WaterOptions
from pcfix.options.steps import CleanOptions, CleanRules
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

    Noise gets class 7 and the withheld flag; nothing else changes. Points that are withheld or of
    class 7 or 18 in the input are neither tested nor neighbours of others. `restore_file` undoes a
    correction before or after the cleaning, except the class and the withheld flag of noise.

    Parameters
    ----------
    input, output : path
        The names end in ``.las`` or ``.laz``; the output is LAS 1.4, see `correct_file`. The
        search needs 90 bytes per point of disk beside the output. Or many files and a folder, see
        `pcfix.correct_file`: neighbours are those of the whole cloud.
    options : CleanOptions, optional
        Or its attributes as keywords: the options of ``pcfix clean``.
    tile_m : float, optional
        Side of the square tiles of the search. The result does not depend on it.
    progress : callable, optional
        Called with (points done, all points), over all passes.

    Returns
    -------
    CleanSummary

    Raises
    ------
    PcfixError
        If a file, an option or the cloud cannot be used; no output is left behind.
    """
    given = taken(CleanOptions, options, keywords, "clean_file")
    check_tile(tile_m)
    how = Resources(tile_m, given.jobs)
    command = Command(
        "clean",
        plan=partial(_plan_file, given, how, progress),
        process=partial(streaming, _Cleaning),
        check=lambda plan, tally: None,
        summarize=lambda plan, tally, findings, ends: replace(
            plan.summary, input=ends.input, output=ends.output, seconds=round(ends.seconds, 3)
        ),
    )
    last = None
    if progress is not None:  # writing is the last of the passes
        last = lambda done, total: progress(((_PASSES - 1) * total + done) // _PASSES, total)  # noqa: E731
    result: CleanSummary = run_command(
        command, input, output, given, reads=[given.water], progress=last
    )
    return result


RAY_DIMENSIONS = ("RayCount", "RayMiss", "Incidence")
"""Dimensions of a corrected cloud that the tests of weak intersections need."""
_NEEDS = {"few rays": "min_rays", "ray miss": "max_ray_miss", "incidence": "max_incidence"}


class Tested(NamedTuple):
    """Some points, and by name those of `RAY_DIMENSIONS` that the cloud has, shape (n,)."""

    points: Points
    withheld: BoolArray
    rays: dict[str, FloatArray]


class NoiseSearch:
    """The tests of a whole cloud, from a file or a PDAL pipeline.

    Parameters
    ----------
    name : str
        Name of the cloud, for messages.
    options : CleanOptions
    view : callable
        Returns the cloud as a water surface needs it.
    names : collection of str
        The dimensions of the cloud.
    has_rays : bool
        False if the cloud was corrected without cameras.
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
        self._name, self._not_run = name, list[str]()
        if rules.weak and not has_rays:
            rules = replace(rules, weak=False)
            self._not_run.append(f"{', '.join(_NEEDS)}: the cloud was corrected without cameras")
        given = options.water
        self.water = None if given is None else find_surface(given, WaterOptions(), view()).surface
        has = [one for one in RAY_DIMENSIONS if {"RayCount", one} <= set(names)]
        self._not_run += [
            f"{test}: the cloud has no dimension {dimension if has else 'RayCount'}"
            for (test, limit), dimension in zip(_NEEDS.items(), RAY_DIMENSIONS, strict=True)
            if getattr(rules, limit) is not None and dimension not in has
        ]
        if rules.below_or_floating and self.water is None and not has:
            self._not_run.append("below bed, floating: no --water, and no dimension RayCount")
        self._rules = rules

    def run(self, chunks: Iterable[Tested], n: int, resources: Resources) -> BoolArray:
        """Run the tests on all n points; return which are noise, shape (n,)."""
        used, submerged, reasons = (np.zeros(n, kind) for kind in (bool, bool, np.uint8))
        self.cloud = Cloud(empty((n, 3)), used, submerged, reasons)
        first = 0
        for one in chunks:
            count = len(one.withheld)
            rows = slice(first, first + count)
            xyz, heights, classes, *_ = one.points
            self.cloud.xyz[rows] = xyz
            used[rows] = ~(one.withheld | np.isin(classes, NOISE_CLASSES))
            rays, miss, incidence = (one.rays.get(name) for name in RAY_DIMENSIONS)
            if rays is not None:
                flag_weak(self._rules, reasons[rows], rays, miss, incidence)
                reasons[rows][~used[rows]] = 0
            if self.water is not None:
                above = surface_above(self.water, xyz, heights)
                submerged[rows] = used[rows] & is_submerged(xyz[:, 2], above)
            elif rays is not None:
                submerged[rows] = used[rows] & (rays > 0)
            first += count
            let_go()
            if resources.progress is not None:
                resources.progress(count)
        if not used.any():
            raise InputError(
                "cloud.all_withheld",
                f"{self._name}: all {n:,} points are withheld or noise (class 7 or 18). There is"
                " nothing left to clean.",
                path=self._name, points=n,
            )  # fmt: skip
        if not self._rules.below_or_floating:
            submerged[:] = False
        elif self.water is not None:
            check_submerged(int(submerged.sum()), self._name, self.water)
        self._distance_m = flag_neighbours(self._name, self.cloud, self._rules, resources)
        self.cloud = self.cloud._replace(xyz=np.zeros((0, 3)))  # frees the disk
        return reasons != 0

    def content(self) -> dict[str, Any]:
        """Return what the record in the file and the summary have in common."""
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
            not_run=self._not_run,
            seconds=round(seconds, 3),
            **self.content(),
        )


class CleanPlan(NamedTuple):
    """The noise of a whole cloud, one bit per point, and what is said of it."""

    noise: npt.NDArray[np.uint8]
    drop: bool
    content: dict[str, Any]
    summary: CleanSummary


def _plan_file(
    options: CleanOptions, how: Resources, progress: Progress | None,
    cloud: Path | Tiles, target: Path, kept: list[Chunk] | None = None,
) -> CleanPlan:  # fmt: skip
    """Find the noise of a whole cloud; large arrays are on the disk of the target."""
    with open_cloud(cloud) as source:
        names = set(source.header.point_format.dimension_names)
        points = len(source)
        try:
            ours = own_settings(source.vlrs)
        except ValueError:  # a damaged record is reported where its content is needed
            ours = None
    has_rays = not (isinstance(ours, dict) and ours.get("cameras") == 0)
    passed = 0

    def count(some: int) -> None:
        nonlocal passed
        passed += some
        if progress is not None:
            progress(passed // _PASSES, points)

    search = NoiseSearch(str(cloud), options, lambda: view_of(cloud), names, has_rays=has_rays)
    beside = target.absolute()
    if not beside.parent.is_dir():  # the folder of many files is made later
        beside = next(one for one in beside.parents if one.is_dir()) / target.name
    with scratch_arrays(beside):
        tested = _tested(cloud, search.water, how.jobs)
        noise = search.run(tested, points, how._replace(progress=count))
    if options.drop and noise.all():
        raise InputError(
            "cloud.all_noise",
            f"{cloud}: every point is noise by these thresholds. Use wider thresholds, or leave"
            " out --drop.",
            path=cloud, points=points,
        )  # fmt: skip
    summary = search.summary("", "", drop=options.drop, seconds=0.0)
    content = {**search.content(), "drop": options.drop}
    return CleanPlan(np.packbits(noise), options.drop, content, summary)


class _Cleaning:
    """The cleaning of one file: its header with a record of it, and each chunk."""

    def __init__(self, plan: CleanPlan, source: LasSource) -> None:
        self._plan = plan
        self.header = noted_header(source, cleaning_vlr(plan.content))
        self.identity = corrected_identity(source)

    def compute(self, points: Chunk, row: int) -> tuple[BoolArray, int]:
        """Return which points of a chunk are noise, and their number."""
        end, byte = row + len(points), row // 8
        bits = np.unpackbits(self._plan.noise[byte : (end + 7) // 8])
        return bits[row - 8 * byte : end - 8 * byte].astype(np.bool_), len(points)

    def apply(self, points: Chunk, noise: BoolArray) -> Chunk:
        """Flag or drop the noise."""
        new = convert(points, self.header.point_format)
        if self._plan.drop:
            return new[~noise]
        new.array["classification"][noise] = LOW_NOISE
        new["withheld"][:] = np.asarray(new["withheld"]) | noise
        return new


def _tested(cloud: Path | Tiles, water: WaterSurface | None, jobs: int | None) -> Iterator[Tested]:
    with open_cloud(cloud, jobs) as source:
        names = set(source.header.point_format.dimension_names)
        for chunk in source.chunks():
            rays = {name: source.dimension(chunk, name) for name in RAY_DIMENSIONS if name in names}
            withheld = np.asarray(chunk["withheld"]).astype(np.bool_)
            yield Tested(points_of(chunk, source, water), withheld, rays)

"""The cleaning of a LAS or LAZ file: read, test, write, in bounded memory."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import numpy as np

from pcfix.clean.neighbours import Empty
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
from pcfix.flow.surfaces import find_surface, points_of, view_of
from pcfix.io.files import scratch_arrays
from pcfix.io.las.columns import convert
from pcfix.io.las.source import LasSource
from pcfix.io.las.writing import cleaning_vlr, noted_header, own_settings
from pcfix.kernels import threads
from pcfix.model import LOW_NOISE, NOISE_CLASSES
from pcfix.options.declare import File, taken
from pcfix.options.shared import WaterOptions
from pcfix.options.steps import CleanOptions, CleanRules
from pcfix.version import __version__
from pcfix.water.checks import check_submerged
from pcfix.water.surface import is_submerged, surface_above

_PASSES = 4


def clean_file(
    input: File,
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
    given = taken(CleanOptions, options, keywords, "clean_file")
    check_tile(tile_m)
    task = file_task(input, output, given, reads=[given.water], progress=progress)
    step = Cleaning(task, given)
    with threads(given.jobs), scratch_arrays(task.target) as empty:
        step.find(tile_m, empty)
    replace(task, progress=None).run(step)  # the step counts the points of all passes
    result = step.summary()
    task.tell(result.as_dict())
    return result


class Cleaning(Step):
    """The step that flags noise or leaves it out, once it was found in the whole cloud."""

    cloud: Cloud

    def __init__(self, task: FileTask, options: CleanOptions) -> None:
        self._task, self._drop, self._rules = task, options.drop, options.part(CleanRules)
        water = options.water
        self._water = (
            None
            if water is None
            else find_surface(water, WaterOptions(), view_of(task.source)).surface
        )
        self._passed = self._written = 0
        self._distance_m: dict[str, float] = {}
        self._not_run: list[str] = []

    def find(self, tile_m: float | None, empty: Empty) -> None:
        """Read the cloud and run the tests, with arrays on disk for what is large."""
        jobs = self._task.jobs
        with LasSource(self._task.source, jobs) as source:
            self._rules = rules = self._rules_of(source)
            names = set(source.header.point_format.dimension_names)
            n = len(source)
            used, submerged, reasons = (np.zeros(n, kind) for kind in (bool, bool, np.uint8))
            self.cloud = Cloud(empty((n, 3), np.float64), used, submerged, reasons)
            first = 0
            for points in source.chunks():
                self._read(points, source, slice(first, first + len(points)), names)
                first += len(points)
                self._count(len(points))
            self._check(str(source.path))
        if not rules.below_or_floating:
            submerged[:] = False
        resources = Resources(tile_m, empty, jobs, self._count)
        self._distance_m = flag_neighbours(str(source.path), self.cloud, rules, resources)
        self._not_run += self._tests_not_run(names)
        self.cloud = self.cloud._replace(xyz=np.zeros((0, 3)))  # gives the disk back

    def _rules_of(self, source: LasSource) -> CleanRules:
        """Return the rules without those about rays, where a cloud was corrected without any."""
        try:
            ours = own_settings(source.vlrs) or {}
        except ValueError:  # whoever needs it says so
            ours = {}
        if ours.get("cameras") != 0 or not self._rules.weak:
            return self._rules
        self._not_run = ["few rays, ray miss, incidence: the cloud was corrected without cameras"]
        return replace(self._rules, weak=False)

    def _count(self, points: int) -> None:
        """Report so many more points of a pass."""
        self._passed += points
        if self._task.progress is not None:
            self._task.progress(self._passed // _PASSES, len(self.cloud.used))

    def _read(self, points: Chunk, source: LasSource, rows: slice, names: set[str]) -> None:
        """Read coordinates and masks, and flag weak intersections on the way."""
        cloud, (xyz, heights, classes, _) = self.cloud, points_of(points, source, self._water)
        withheld = np.asarray(points["withheld"]).astype(np.bool_)
        used = ~(withheld | np.isin(classes, NOISE_CLASSES))
        rays, miss, incidence = (
            source.dimension(points, name) if name in names else None
            for name in ("RayCount", "RayMiss", "Incidence")
        )
        if rays is not None:
            flag_weak(self._rules, cloud.reasons[rows], rays, miss, incidence)
            cloud.reasons[rows][~used] = 0
        cloud.xyz[rows], cloud.used[rows] = xyz, used
        if self._water is not None:
            above = surface_above(self._water, xyz, heights)
            cloud.submerged[rows] = used & is_submerged(xyz[:, 2], above)
        elif rays is not None:
            cloud.submerged[rows] = used & (rays > 0)

    def _check(self, name: str) -> None:
        """Refuse a cloud that leaves nothing to test."""
        if not self.cloud.used.any():
            raise InputError(
                f"{name}: all {len(self.cloud.used):,} points are withheld or noise (class 7 or"
                " 18) already; there is nothing left to clean."
            )
        if self._water is not None and self._rules.below_or_floating:
            check_submerged(int(self.cloud.submerged.sum()), name, self._water)

    def _tests_not_run(self, names: set[str]) -> list[str]:
        """Return which tests the file does not allow, and why."""
        rules = self._rules
        needs = (
            ("few rays", "RayCount", rules.min_rays),
            ("ray miss", "RayMiss", rules.max_ray_miss),
            ("incidence", "Incidence", rules.max_incidence),
        )
        missing = [
            f"{test}: the cloud has no dimension {dimension if 'RayCount' in names else 'RayCount'}"
            for test, dimension, limit in needs
            if limit is not None and not {"RayCount", dimension} <= names
        ]
        if rules.below_or_floating and self._water is None and "RayCount" not in names:
            missing.append("below bed, floating: no --water, and no dimension RayCount")
        return missing

    def _content(self) -> dict[str, Any]:
        """Return what the file and the summary say of the cleaning."""
        reasons = self.cloud.reasons
        return {
            "pcfix": __version__,
            "settings": asdict(self._rules),
            "water": None if self._water is None else str(self._water),
            "reasons": {
                str(reason.name).lower(): int(np.count_nonzero(reasons & np.uint8(reason)))
                for reason in Reason
            },
        }

    def header(self, source: LasSource) -> Header:
        """Return the header with the record of what is done."""
        if self._drop and self.cloud.reasons.all():
            raise InputError(
                f"{source.path}: every point is noise by these thresholds; choose wider ones, or"
                " do not drop."
            )
        return noted_header(source, cleaning_vlr({**self._content(), "drop": self._drop}))

    def chunk(self, points: Chunk, source: LasSource, header: Header) -> Chunk:
        """Return points with their noise flagged or left out."""
        new = convert(points, header.point_format)
        noise = self.cloud.reasons[self._written : self._written + len(new)] != 0
        self._written += len(noise)
        self._count(len(noise))
        if self._drop:
            return new[~noise]
        new.array["classification"][noise] = LOW_NOISE
        new["withheld"][:] = np.asarray(new["withheld"]) | noise
        return new

    def summary(self) -> CleanSummary:
        """Return the numbers of the cleaning."""
        cloud, noise = self.cloud, int(np.count_nonzero(self.cloud.reasons))
        return CleanSummary(
            input=str(self._task.source),
            output=str(self._task.target),
            points=len(cloud.used),
            set_aside=int((~cloud.used).sum()),
            submerged=int(cloud.submerged.sum()),
            noise=noise,
            dropped=noise if self._drop else 0,
            neighbour_distance_m=self._distance_m,
            not_run=self._not_run,
            seconds=round(self._task.seconds, 3),
            **self._content(),
        )

"""Clean a LAS or LAZ file: read, test, write, in bounded memory."""

from contextlib import suppress
from dataclasses import asdict, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from pcfix.errors import bad_file
from pcfix.flow.runner import Chunk, FileTask, FileWork, Progress, run_command
from pcfix.flow.surfaces import CloudView, find_surface, view_of
from pcfix.io.clouds import Clouds, open_cloud
from pcfix.io.files import scratch_arrays
from pcfix.io.las.columns import convert
from pcfix.io.las.source import LasSource
from pcfix.io.las.writing import output_header, own_settings
from pcfix.model import LOW_NOISE, BoolArray
from pcfix.options.declare import File, taken
from pcfix.options.shared import WaterOptions
from pcfix.options.steps import CleanOptions, CleanRules
from pcfix.points.noise import WEAK, Cloud, Reason, flag_neighbours
from pcfix.running import current, empty, release, running
from pcfix.sums import Figures
from pcfix.version import __version__
from pcfix.water.checks import check_submerged
from pcfix.water.surface import surface_above

_PASSES = 4


def clean_file(
    input: Clouds,
    output: File,
    *,
    options: CleanOptions | None = None,
    progress: Progress | None = None,
    **keywords: Any,
) -> Figures:
    """Flag or drop the noise of a LAS or LAZ cloud; what ``pcfix clean`` runs.

    Noise gets class 7 and the withheld flag; nothing else changes. Points that are withheld or of
    class 7 or 18 in the input are neither tested nor neighbours of others. `restore_file` undoes a
    correction before or after the cleaning, except the class and the withheld flag of noise.

    Parameters
    ----------
    input, output : path
        The names end in ``.las`` or ``.laz``; the output is LAS 1.4, see `correct_file`. The
        search needs 120 bytes per point of disk beside the output. Or many files and a folder, see
        `pcfix.correct_file`: neighbours are those of the whole cloud.
    options, progress
        See `pcfix.correct_file`.
    """
    given = taken(CleanOptions, options, keywords, "clean_file")
    last = None
    if progress is not None:  # writing is the last of the passes
        last = lambda done, total: progress(((_PASSES - 1) * total + done) // _PASSES, total)  # noqa: E731
    return run_command(
        "clean", input, output, given, plan=partial(_plan_file, given, progress), work=_cleaning,
        finish=lambda plan, task, count: Figures(
            input=str(task.source), output=str(task.target), **plan.found, seconds=task.seconds
        ),
        reads=[given.water], progress=last,
    )  # fmt: skip


def find_noise(
    options: CleanOptions, view: CloudView, *, has_rays: bool = True
) -> tuple[BoolArray, dict[str, Any]]:
    """Run the tests on a whole cloud of n points.

    `has_rays` is False if it was corrected without cameras. Returns which points are noise, shape
    (n,), and the summary without files and time.
    """
    rules, not_run, water = options.part(CleanRules), list[str](), None
    if rules.weak and not has_rays:
        rules = replace(rules, weak=False)
        not_run.append("weak intersections: the cloud was corrected without cameras")
    if options.water is not None:
        water = find_surface(options.water, WaterOptions(), view).surface
    n, has = view.points, {one for one in WEAK if {"RayCount", one} <= set(view.names)}
    missing = ", ".join(one for one in WEAK if one not in has)
    if rules.weak and missing:
        not_run.append(f"weak intersections: the cloud has no dimension {missing}")
    if rules.below_or_floating and water is None and not has:
        not_run.append("below bed, floating: no --water, and no dimension RayCount")
    cloud = Cloud(empty((n, 3)), *(np.zeros(n, kind) for kind in (bool, bool, np.uint8)))
    first = 0
    for points in view.chunks(water, set(WEAK).intersection(view.names)):
        rows = slice(first, first + len(points.xyz))
        above = None if water is None else surface_above(water, points.xyz, points.heights)
        cloud.add(rows, points.xyz, points.counts(), above, points.dimensions or {}, rules)
        first = rows.stop
        release()
        current().report(len(points.xyz))
    tested, submerged = int(cloud.used.sum()), int(cloud.submerged.sum())
    if not tested:
        sentence = f"all {n:,} points are withheld or noise (class 7 or 18). Nothing is left."
        raise bad_file(view.name, "cloud.all_withheld", sentence, points=n)
    if not rules.below_or_floating:
        submerged = 0
    elif water is not None:
        check_submerged(submerged, view.name, water)
    distance_m = flag_neighbours(view.name, cloud, rules)
    noise = cloud.reasons != 0
    count = int(noise.sum())
    return noise, {
        "pcfix": __version__,
        "points": n,
        "set_aside": n - tested,  # withheld or noise before: not tested, not neighbours
        "submerged": submerged,  # tested against the bed
        "noise": count,
        "reasons": {
            str(reason.name).lower(): int(np.count_nonzero(cloud.reasons & np.uint8(reason)))
            for reason in Reason
        },
        "dropped": count if options.drop else 0,
        "neighbour_distance_m": distance_m,  # mean, sd and limit; see `flag_sparse`
        "not_run": not_run,  # tests that could not be run, and why
        "water": None if water is None else str(water),
        "settings": asdict(rules),
    }


class CleanPlan(NamedTuple):
    """The noise of a whole cloud, and the summary."""

    noise: BoolArray  # (n,)
    drop: bool
    found: dict[str, Any]  # see `find_noise`


def _plan_file(options: CleanOptions, progress: Progress | None, task: FileTask) -> CleanPlan:
    """Find the noise of a whole cloud; large arrays are on the disk of the target."""
    view, ours = view_of(task.source, options.jobs, in_metres=options.water is not None), None
    with open_cloud(task.source) as source, suppress(ValueError):  # a damaged record counts as none
        ours = own_settings(source.vlrs)
    has_rays = not (isinstance(ours, dict) and ours.get("cameras") == 0)
    passed = 0.0

    def count(points: float) -> None:
        nonlocal passed
        passed += points
        if progress is not None:
            progress(int(passed) // _PASSES, view.points)

    # the folder of many files is made later
    disk = next(one for one in task.target.absolute().parents if one.is_dir())
    with scratch_arrays(disk / task.target.name), running(report=count):
        noise, found = find_noise(options, view, has_rays=has_rays)
    if options.drop and noise.all():
        sentence = "every point is noise by these thresholds. Use wider ones, or omit --drop."
        raise bad_file(task.source, "cloud.all_noise", sentence, points=view.points)
    return CleanPlan(noise, options.drop, found)


def _cleaning(plan: CleanPlan, source: LasSource) -> FileWork:
    """Return the cleaning of one file: its header with a record of it, and each chunk."""
    content = {name: plan.found[name] for name in ("pcfix", "settings", "water", "reasons")}
    header = output_header(source, "cleaning", {**content, "drop": plan.drop})

    def apply(points: Chunk, noise: BoolArray) -> Chunk:
        """Flag or drop the noise."""
        new = convert(points, header.point_format)
        if plan.drop:
            return new[~noise]
        new.array["classification"][noise] = LOW_NOISE
        new["withheld"][:] = np.asarray(new["withheld"]) | noise
        return new

    return FileWork(
        header, lambda points, row: (plan.noise[row : row + len(points)], len(points)), apply
    )

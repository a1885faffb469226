"""The calculation over a LAS or LAZ file: chunks in, chunks out, bounded memory."""

from __future__ import annotations

import json
import time
from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import InputError
from pcfix.flow.inputs import Inputs
from pcfix.flow.job import Job
from pcfix.flow.points import CHUNK_POINTS
from pcfix.flow.surfaces import view_of
from pcfix.io.files import check_input, check_output, write_text
from pcfix.io.las.columns import (
    OutOfRangeError,
    TooNarrowError,
    changed_rows,
    columns_for,
    fill,
    shift_steps,
    shifted,
)
from pcfix.io.las.source import LasSource, centring_steps, coordinates
from pcfix.io.las.writing import (
    LasSink,
    check_suffix,
    corrected_header,
    corrected_identity,
    output_evlrs,
)
from pcfix.model import (
    BATHYMETRIC_POINT,
    Cameras,
    Correction,
    Summary,
    WaterDimension,
    WaterSurface,
)
from pcfix.options import (
    DEFAULT_REFRACTIVE_INDEX,
    Dimensions,
    ErrorBudget,
    LabelSettings,
    Settings,
    Uncorrected,
)
from pcfix.port.shapes import port_of
from pcfix.threads import threads
from pcfix.water.index import index_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from os import PathLike
    from pathlib import Path

    import laspy
    import numpy.typing as npt

    from pcfix.flow.job import Points
    from pcfix.flow.surfaces import WaterModel
    from pcfix.io.cameras.formats import Angles
    from pcfix.io.las.columns import Column
    from pcfix.model import FloatArray
    from pcfix.options import CameraSet, MatcherKind, Method, Occlusion, ViewsAre
    from pcfix.port.shapes import Port

    AnyPath = str | PathLike[str]


def correct_file(
    input: AnyPath,
    output: AnyPath,
    *,
    cameras: Cameras | AnyPath,
    water: WaterSurface | float | AnyPath | None = None,
    port: Port | str | None = None,
    sensor: AnyPath | None = None,
    angles: Angles | None = None,
    cameras_crs: str | None = None,
    cameras_offset_m: tuple[float, float, float] | None = None,
    adjusted_from: Cameras | AnyPath | None = None,
    views: AnyPath | None = None,
    water_model: WaterModel = "auto",
    water_crs: str | None = None,
    tide: AnyPath | None = None,
    image_times: AnyPath | None = None,
    water_mask: AnyPath | None = None,
    connected: bool = False,
    least_pool_m2: float | None = None,
    respect_classes: tuple[int, ...] = (),
    refractive_index: float | str = DEFAULT_REFRACTIVE_INDEX,
    max_angle_deg: float | None = None,
    max_cameras: int | None = None,
    method: Method = "snell",
    camera_set: CameraSet = "auto",
    matcher: MatcherKind = "depth-maps",
    views_are: ViewsAre = "auto",
    occlusion: Occlusion = "auto",
    depth_factor: float | None = None,
    check_depths: AnyPath | None = None,
    least_r2: float = 0.5,
    errors: ErrorBudget | None = None,
    uncorrected: Uncorrected = "withhold",
    dimensions: Dimensions = "all",
    summary: AnyPath | None = None,
    overwrite: bool = False,
    jobs: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Summary:
    """Correct a LAS or LAZ cloud; what ``pcfix correct`` runs.

    Parameters
    ----------
    input, output : path
        The names end in ``.las`` or ``.laz``; the output is LAS 1.4, point format 6, 7 or 8 (9
        or 10 for inputs with waveforms).
    cameras : Cameras or path
        See `pcfix.read_cameras`.
    water : WaterSurface, float, str or path
        See `pcfix.read_water`; besides, shoreline points in a vector file, or ``auto``.
    port : Port or str
        Instead of the water, for a cloud that was taken under water: the port of the cameras'
        housing, as ``flat:distance=0.02,thickness=0.008``; see `pcfix.port.shapes.port_of`. All
        points count as under water. As no surface is known, ``WaterDepth`` is 0.001 m, the least.
    sensor, angles
        See `pcfix.read_cameras`.
    cameras_crs : str, optional
        Of the cameras, as ``EPSG:25830``; ``local`` takes their numbers as they are. Default: what
        their file says, else the cloud's.
    cameras_offset_m : tuple of 3 float, optional
        Added to the projection centres, in the axes of their file.
    adjusted_from : Cameras or path, optional
        The cameras that the cloud was made with, where `cameras` are the same images adjusted
        since: all points, land too, are first taken from those to these; see
        `pcfix.adjust.carry`. `views` are theirs then. `cameras_crs` and `cameras_offset_m` count
        for whichever of the two files does not say where it lies; see
        `pcfix.flow.old_cameras.told_apart`.
    views : path, optional
        Which cameras made each point; see `pcfix.io.views.read_views`. The camera file itself
        stands for the tracks of its tie points. Default: every camera whose frame holds it.
    water_model, water_crs
        See `pcfix.flow.surfaces.WaterWords`.
    tide, image_times : path, optional
        Water levels over time (CSV ``time,level_m``) and when each image was taken (CSV
        ``label,time``, or the folder of images): each ray bends at the level of its own image.
        Default of the times: what the camera file says.
    water_mask : path, optional
        Polygons outside which no point is submerged; see `pcfix.flow.label.label_file`.
    connected, least_pool_m2, respect_classes
        See `pcfix.LabelSettings`.
    refractive_index : float or str
        A number, or the water: ``fresh``, ``sea``, or salinity, temperature and wavelength as
        ``35,15,0.53`` (PSU, degrees Celsius, micrometres); see `pcfix.refractive_index`.
    max_angle_deg, max_cameras, method, camera_set, matcher, occlusion, depth_factor, errors
        See `correct_points`.
    views_are : {"auto", "tracks", "depth-maps"}
        What the views are; see `pcfix.Views`. auto: what their kind of file says.
    check_depths : path, optional
        With the method regression: measured depths; see `pcfix.io.tables`.
    least_r2 : float
        A regression with a lower coefficient of determination is refused.
    uncorrected : {"withhold", "keep", "drop"}
        What becomes of a submerged point with fewer than two usable rays: unmoved with its
        withheld flag set, unmoved, or left out.
    dimensions : {"all", "minimal", "none"}
        Extra dimensions to write. Only with "all" can `restore_file` undo the correction.
    summary : path, optional
        Write the summary there, as JSON.
    overwrite : bool
        Replace an output that exists.
    jobs : int, optional
        Threads; default all cores. The result does not depend on it.
    progress : callable, optional
        Called with (points done, points in all) after each chunk.

    Returns
    -------
    Summary

    Raises
    ------
    PcfixError
        With one sentence on what to mend; no output is left behind.
    """
    started = time.perf_counter()
    index, index_from = index_of(refractive_index)
    settings = Settings(
        index, max_angle_deg, max_cameras, uncorrected, dimensions, index_from, method, camera_set,
        occlusion, depth_factor, least_r2, errors or ErrorBudget(), matcher,
    )  # fmt: skip
    label = LabelSettings(
        connected=connected, least_pool_m2=least_pool_m2, respect_classes=respect_classes
    )
    source = check_input(input)
    inputs = Inputs(
        cameras, water, sensor, angles, cameras_crs, cameras_offset_m, views, water_mask,
        tide, image_times, water_model, water_crs, views_are, check_depths,
        port_of(port) if isinstance(port, str) else port, adjusted_from,
    )  # fmt: skip
    given = [input, *inputs.paths()]
    target = check_output(output, overwrite=overwrite, inputs=given)
    check_suffix(target)
    if summary is not None:
        check_output(summary, overwrite=overwrite, inputs=[*given, target])
    job = job_for(source, settings, inputs, label)
    with threads(jobs):
        job.look_around(lambda: file_points(source, job.water, jobs))
        _write_until_it_fits(job, source, target, jobs, progress)
    result = job.summary(str(source), str(target), time.perf_counter() - started)
    if summary is not None:
        write_text(summary, json.dumps(result.as_dict(), indent=2) + "\n", overwrite=overwrite)
    return result


def job_for(
    path: Path, settings: Settings, inputs: Inputs, label: LabelSettings | None = None
) -> Job:
    """Return the job of correcting a LAS or LAZ file."""
    view = view_of(path)
    with LasSource(path) as source:
        step = float(max(source.header.scales))
    label = label or LabelSettings()
    if inputs.port is not None:
        from pcfix.flow.port_job import PortJob

        return PortJob(
            str(path), settings, inputs, inputs.port, view=view, step_m=step, label=label
        )
    return Job(str(path), settings, inputs, view=view, step_m=step, label=label)


def file_points(path: Path, water: WaterSurface, jobs: int | None = None) -> Iterator[Points]:
    """Yield all points of a LAS or LAZ file, chunk by chunk."""
    with LasSource(path, jobs) as source:
        for points in source.chunks(CHUNK_POINTS):
            heights = water_heights(water, source, points)
            yield coordinates(points), heights, np.asarray(points["classification"])


def _write_until_it_fits(
    job: Job,
    source: Path,
    target: Path,
    jobs: int | None,
    progress: Callable[[int, int], None] | None,
) -> None:
    """Write with narrow types and the input's offsets, and again where a cloud is beyond them."""
    wide = False
    steps: tuple[int, ...] = (0, 0, 0)
    while True:
        try:
            return _write(job, source, target, jobs, progress, wide=wide, steps=steps)
        except TooNarrowError:
            wide = True
        except OutOfRangeError as axis:
            old, steps = steps, centring_steps(source, jobs)
            if steps == old:
                raise InputError(
                    f"{source}: the scale of {axis} is too fine to hold the result in 32 bits;"
                    " write the cloud with a coarser scale first."
                ) from axis
        job.restart()


def _write(
    job: Job,
    path: Path,
    target: Path,
    jobs: int | None,
    progress: Callable[[int, int], None] | None,
    *,
    wide: bool,
    steps: tuple[int, ...],
) -> None:
    """Read, correct and write chunk by chunk."""
    columns = columns_for(job.settings.dimensions)
    with LasSource(path, jobs) as source:
        header = corrected_header(source, columns, job.provenance(), wide=wide, steps=steps)
        evlrs, identity = output_evlrs(source), corrected_identity(source)
        with LasSink(target, header, evlrs, identity, jobs) as sink:
            for points in source.chunks(CHUNK_POINTS):
                heights = water_heights(job.water, source, points)
                classes = np.asarray(points["classification"])
                correction = job.correct(coordinates(points), heights, classes)
                moved = shift_steps(correction, header.scales)
                new = shifted(points, header, moved + np.array(steps))
                _mark(new, columns, correction, moved, job.settings)
                if job.settings.uncorrected == "drop":
                    new = new[~correction.uncorrected]
                sink.write(new)
                if progress is not None:
                    progress(job.tally.points, len(source))
            job.check_fit()


def water_heights(
    water: WaterSurface, source: LasSource, points: laspy.ScaleAwarePointRecord
) -> FloatArray | None:
    """Return the heights of the water of a chunk, shape (n,), where they are a dimension."""
    return source.dimension(points, water.name) if isinstance(water, WaterDimension) else None


def _mark(
    new: laspy.ScaleAwarePointRecord,
    columns: tuple[Column, ...],
    correction: Correction,
    moved: npt.NDArray[np.int64],
    settings: Settings,
) -> None:
    """Fill the new dimensions, then set classes and flags."""
    withheld = np.asarray(new["withheld"]).astype(bool)
    withhold = settings.uncorrected == "withhold"
    fill(new, columns, correction, moved, changed_rows(correction, withheld, withhold=withhold))
    new.array["classification"][correction.corrected] = BATHYMETRIC_POINT
    if withhold:
        new["withheld"][:] = (withheld | correction.uncorrected).astype(np.uint8)

"""The calculation over a LAS or LAZ file: chunks in, chunks out, bounded memory."""

from __future__ import annotations

import json
import time
from dataclasses import asdict
from os import PathLike
from typing import TYPE_CHECKING

import numpy as np

import pcfix
from pcfix.errors import GeometryError, InputError
from pcfix.flow.points import check_above_water, correct_checked, refuse_under_water
from pcfix.flow.threads import threads
from pcfix.io.cameras import read_cameras
from pcfix.io.files import check_input, check_output, write_text
from pcfix.io.las.columns import TooNarrowError, changed_rows, columns_for, fill, shift_steps
from pcfix.io.las.formats import OutOfRangeError, shifted
from pcfix.io.las.headers import corrected_header, corrected_identity, output_evlrs
from pcfix.io.las.sink import LasSink, check_suffix
from pcfix.io.las.source import LasSource, centring_steps, coordinates
from pcfix.io.water import read_water
from pcfix.model import (
    DEFAULT_REFRACTIVE_INDEX,
    Cameras,
    Correction,
    Dimensions,
    Outcome,
    Settings,
    Summary,
    Uncorrected,
    WaterDimension,
    WaterMesh,
    WaterPlane,
    WaterSurface,
)
from pcfix.report.tally import Tally

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    import laspy
    import numpy.typing as npt

    from pcfix.io.las.columns import Column

    AnyPath = str | PathLike[str]

CHUNK_POINTS = 1_000_000
BATHYMETRIC_POINT = 40
"""ASPRS class of a point on the bed (LAS 1.4, topo-bathy lidar domain profile)."""


def correct_file(
    input: AnyPath,
    output: AnyPath,
    *,
    cameras: Cameras | AnyPath,
    water: WaterSurface | float | AnyPath,
    sensor: AnyPath | None = None,
    refractive_index: float = DEFAULT_REFRACTIVE_INDEX,
    max_angle_deg: float | None = None,
    max_cameras: int | None = None,
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
        See `pcfix.read_water`.
    sensor : path, optional
        See `pcfix.read_cameras`.
    refractive_index, max_angle_deg, max_cameras
        See `correct_points`.
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
    settings = Settings(refractive_index, max_angle_deg, max_cameras, uncorrected, dimensions)
    source_path = check_input(input)
    inputs = [p for p in (input, cameras, sensor, water) if isinstance(p, str | PathLike)]
    target = check_output(output, overwrite=overwrite, inputs=inputs)
    check_suffix(target)
    if summary is not None:
        check_output(summary, overwrite=overwrite, inputs=[*inputs, target])
    block = cameras if isinstance(cameras, Cameras) else read_cameras(cameras, sensor)
    surface = (
        water if isinstance(water, WaterPlane | WaterDimension | WaterMesh) else read_water(water)
    )
    check_above_water(block, surface)
    with threads(jobs):
        tally = _stream_until_it_fits(source_path, target, block, surface, settings, jobs, progress)
    result = _summarise(
        tally, block, surface, settings, source_path, target, time.perf_counter() - started
    )
    if summary is not None:
        write_text(summary, json.dumps(result.as_dict(), indent=2) + "\n", overwrite=overwrite)
    return result


def _stream_until_it_fits(
    source_path: Path,
    target: Path,
    cameras: Cameras,
    water: WaterSurface,
    settings: Settings,
    jobs: int | None,
    progress: Callable[[int, int], None] | None,
) -> Tally:
    """Write with narrow types and the input's offsets, and again where a cloud is beyond them."""
    wide = False
    steps: tuple[int, ...] = (0, 0, 0)
    while True:
        try:
            return _stream(
                source_path, target, cameras, water, settings, jobs, progress, wide, steps
            )
        except TooNarrowError:
            wide = True
        except OutOfRangeError as axis:
            old, steps = steps, centring_steps(source_path, jobs)
            if steps == old:
                raise InputError(
                    f"{source_path}: the scale of {axis} is too fine to hold the result in 32"
                    " bits; write the cloud with a coarser scale first."
                ) from axis


def _stream(
    source_path: Path,
    target: Path,
    cameras: Cameras,
    water: WaterSurface,
    settings: Settings,
    jobs: int | None,
    progress: Callable[[int, int], None] | None,
    wide: bool,
    steps: tuple[int, ...],
) -> Tally:
    """Read, correct and write chunk by chunk."""
    tally = Tally(len(cameras))
    columns = columns_for(settings.dimensions)
    content = {
        "pcfix": pcfix.__version__,
        "settings": asdict(settings),
        "water": str(water),
        "cameras": len(cameras),
    }
    with LasSource(source_path, jobs) as source:
        header = corrected_header(source, columns, content, wide=wide, steps=steps)
        evlrs, identity = output_evlrs(source), corrected_identity(source)
        with LasSink(target, header, evlrs, identity, jobs) as sink:
            for points in source.chunks(CHUNK_POINTS):
                xyz = coordinates(points)
                heights = (
                    source.dimension(points, water.name)
                    if isinstance(water, WaterDimension)
                    else None
                )
                correction = correct_checked(xyz, cameras, water, settings, heights)
                tally.add(xyz, correction)
                moved = shift_steps(correction, header.scales)
                new = shifted(points, header, moved + np.array(steps))
                _mark(new, columns, correction, moved, settings)
                if settings.uncorrected == "drop":
                    new = new[~(correction.submerged & ~correction.corrected)]
                sink.write(new)
                if progress is not None:
                    progress(tally.points, len(source))
            _check_fit(tally, cameras, water, settings, source_path)
    return tally


def _mark(
    new: laspy.ScaleAwarePointRecord,
    columns: tuple[Column, ...],
    correction: Correction,
    moved: npt.NDArray[np.int64],
    settings: Settings,
) -> None:
    """Fill the new dimensions, then set classes and flags."""
    withheld = np.asarray(new["withheld"]).astype(bool)
    fill(new, columns, correction, moved, changed_rows(correction, withheld))
    new.array["classification"][correction.corrected] = BATHYMETRIC_POINT
    if settings.uncorrected == "withhold":
        stuck = correction.submerged & ~correction.corrected
        new["withheld"][:] = (withheld | stuck).astype(np.uint8)


def _check_fit(
    tally: Tally, cameras: Cameras, water: WaterSurface, settings: Settings, path: Path
) -> None:
    """Refuse a result in which cloud, water and cameras did not meet."""
    if tally.submerged == 0:
        raise GeometryError(
            f"{path}: no point lies below the water ({water}); check the water's height, and"
            " that it has the cloud's vertical datum."
        )
    if isinstance(water, WaterDimension):
        refuse_under_water(cameras, tally.lowest_water_m, str(water))
    if tally.outcomes[Outcome.NO_CAMERA] == tally.submerged:
        middle = (tally.low + tally.high) / 2.0
        distance = float(np.hypot(*(cameras.centres - middle)[:, :2].T).min())
        limit = settings.max_angle_deg
        raise GeometryError(
            f"{path}: no camera has a submerged point in sight"
            + (f" within {limit:g} degrees" if limit else "")
            + f"; the nearest stands {_distance(distance)} in plan from the middle of the"
            f" {tally.submerged:,} submerged points; check that cameras and cloud have the same"
            " CRS, and that pitch 0 means straight down."
        )


def _distance(metres: float) -> str:
    return f"{metres / 1000.0:,.1f} km" if metres >= 10_000.0 else f"{metres:,.1f} m"


def _summarise(
    tally: Tally,
    cameras: Cameras,
    water: WaterSurface,
    settings: Settings,
    source: Path,
    target: Path,
    seconds: float,
) -> Summary:
    unused = [
        label for label, used in zip(cameras.labels, tally.camera_used, strict=True) if not used
    ]
    uncorrected = tally.uncorrected()
    return Summary(
        input=str(source),
        output=str(target),
        pcfix=pcfix.__version__,
        points=tally.points,
        submerged=tally.submerged,
        corrected=tally.corrected,
        uncorrected=uncorrected,
        dropped=sum(uncorrected.values()) if settings.uncorrected == "drop" else 0,
        water_unknown=tally.water_unknown,
        depth_m=tally.depth_m(),
        shift_z_m=tally.shift_z_m(),
        rays=tally.rays,
        cameras=len(cameras),
        cameras_used=len(cameras) - len(unused),
        cameras_unused=unused,
        water=str(water),
        settings=asdict(settings),
        seconds=round(seconds, 3),
        warnings=list(cameras.notes),
    )

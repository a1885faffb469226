"""Combine frames of one place into the image through calm water, with the water of each frame."""

import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pcfix.errors import GeometryError, InputError, PcfixWarning, SettingError, bad_file
from pcfix.flow.inputs import Inputs
from pcfix.flow.photos import check_kind, finished, photo_of, read_heights
from pcfix.flow.runner import Progress, check_summary
from pcfix.grid.lattice import Lattice
from pcfix.io.crs import parse_crs
from pcfix.io.files import scratch_arrays, temporary_output
from pcfix.io.photographs import Burst, check_calm, read_frames, write_photograph, write_spread
from pcfix.io.rasters import new_raster, write_bands
from pcfix.model import FloatArray, Lens, WaterRaster
from pcfix.options.declare import File, taken
from pcfix.options.steps import CalmOptions
from pcfix.photos.calm import corners_in, covered, median_of, register, warped
from pcfix.photos.mapping import Photo
from pcfix.photos.waves import Nodes, View, displacements, fit_waves, nodes_of, slopes_of
from pcfix.running import release, threads
from pcfix.sums import Figures
from pcfix.water.index import index_of
from pcfix.water.surface import surface_above


def calm_frames(
    frames: File,
    out: File,
    *,
    options: CalmOptions | None = None,
    progress: Progress | None = None,
    **keywords: Any,
) -> Figures:
    """Write the median of frames taken through waves; what ``pcfix calm`` runs.

    Parameters
    ----------
    frames : path
        Folder of photographs of one size, in the order of their names, or a video.
    out : path
        Image in the format of the frames, with the metadata of the first; PNG for a video. The
        spread is written next to it, and with `surface` a folder of rasters of the water.
    options, progress
        See `pcfix.correct_file`; progress is in frames, each of which is read twice, with `surface`
        three times.
    """
    given = taken(CalmOptions, options, keywords, "calm_frames")
    check_summary(given)
    started = time.perf_counter()
    found = read_frames(frames, given.every)
    interval = given.interval * given.every if given.interval else found.interval_s
    if given.surface and interval is None:
        sentence = "--surface needs the time between the frames. Give --interval."
        raise SettingError("option.missing", sentence, option="interval")
    target, spread_path = check_calm(out, found, overwrite=given.overwrite)
    folder = target.with_name(f"{target.stem}_water")
    if given.surface and folder.exists() and not given.overwrite:
        sentence = f"{folder}: exists. Add --overwrite to replace it."
        raise SettingError("output.exists", sentence, path=folder)
    total = len(found.names) * (1 + given.surface + (not given.still))
    done = 0

    def count(some: Iterable[Any]) -> Iterator[Any]:
        """Yield frames, and report each that was gone through."""
        nonlocal done
        for frame in some:
            yield frame
            release()
            done += 1
            if progress is not None:
                progress(done, total)

    with threads(given.jobs), scratch_arrays(target) as empty:
        view, crs = _view(given, found) if given.surface else (None, None)
        homographies, scatter = np.tile(np.eye(3), (len(found.names), 1, 1)), np.empty(0)
        if not given.still:
            homographies, scatter = register(np.stack(list(corners_in(count(found)))))
            lost = np.flatnonzero(~np.isfinite(homographies).all(axis=(1, 2)))
            if len(lost):
                names = [found.names[row] for row in lost]
                sentence = f"{', '.join(names[:3])}: do not match the first frame. Omit these"
                raise InputError("frames.no_overlap", f"{sentence} frames.", frames=names)
        median, spread, stack = _median(found, homographies, empty, count(found))
        notes, water = list[PcfixWarning](), None
        if view is not None and interval is not None:
            nodes = nodes_of(view, given.resolution)
            shifts, weights = displacements(median, view, nodes, count(stack))
            waters, water = _water(view, nodes, shifts, weights, interval)
            water.folder = str(folder)
            with temporary_output(folder, is_folder=True) as draft:
                _write_waters(draft, found.names, view.level_m, nodes.lattice, waters, crs)
            if water.explained < 0.5:
                words = (
                    f"Waves explain only {100 * water.explained:.0f} % of the slopes (a current,"
                    " glints, a wrong interval or depth). Do not rely on the surfaces."
                )
                notes.append(PcfixWarning("waves.explained", words, explained=water.explained))
    source = found.photographs[0] if found.photographs else found.path  # of the metadata
    write_photograph(source, target, median, np.ones(median.shape[:2], bool))
    write_spread(spread_path, spread)
    middle = np.array([0.5 * found.columns, 0.5 * found.rows, 1.0])
    moved = homographies @ middle
    return finished(
        given,
        started,
        notes,
        input=str(frames),
        output=str(out),
        spread_file=str(spread_path),
        frames=len(found.names),
        columns=found.columns,
        rows=found.rows,
        corners=len(scatter),  # by which the frames were registered
        # of a corner along an axis, median
        scatter_px=round(float(np.median(scatter)) if len(scatter) else 0.0, 3),
        # largest movement of the frame's centre
        moved_px=round(float(np.hypot(*(moved[:, :2] / moved[:, 2:] - middle[:2]).T).max()), 2),
        spread=round(float(np.nanmedian(spread)), 2),  # of the frames, median, grey values
        water=water,
    )


def _median(
    frames: Burst, homographies: FloatArray, empty: Callable[..., Any], images: Iterable[Any]
) -> tuple[npt.NDArray[Any], FloatArray, Any]:
    """Return the median, its spread, and the registered frames, which are on disk."""
    stack: Any = None
    for number, frame in enumerate(images):
        if stack is None:
            stack = empty((len(frames.names), *frame.shape), frame.dtype)
        check_kind(frames.names[number], frame, stack[0])
        same = np.array_equal(homographies[number], np.eye(3))
        stack[number] = frame if same else warped(frame, homographies[number])
    shape = stack.shape[1:3]
    median = np.empty(stack.shape[1:], stack.dtype)
    spread = np.empty(shape, np.float32)
    at_once = max(1, 50_000_000 // stack[:, 0].size)  # rows whose values take 200 MB to sort
    for top in range(0, shape[0], at_once):
        bottom = min(top + at_once, shape[0])
        known = np.stack([covered(one, shape, top, bottom) for one in homographies])
        median[top:bottom], spread[top:bottom] = median_of(stack[:, top:bottom], known)
        release()
    return median, spread, stack


def _view(given: CalmOptions, frames: Burst) -> tuple[View, str | None]:
    """Return camera, water and bed as given, and the CRS."""
    bed, crs = _bed(given)
    index, level = index_of(given.index, given.index_formula)[0], given.level
    size = frames.columns, frames.rows
    if given.gsd is not None:
        # a camera so far away that its rays are nearly parallel
        lens = Lens(1e5 * max(size), *size, 0.5 * size[0], 0.5 * size[1])
        centre = given.gsd * np.array([0.5 * size[0], -0.5 * size[1], lens.focal])
        centre[2] += level
        return View(Photo("gsd", centre, np.diag([1.0, -1.0, -1.0]), lens), level, index, bed), crs
    cameras, _ = Inputs(
        cameras=given.cameras, sensor=given.sensor, angles=given.angles, water=level,
        cameras_crs=given.cameras_crs, cameras_offset=given.cameras_offset,
    ).block(crs)  # fmt: skip
    first = frames.names[0]
    rows = [row for row, label in enumerate(cameras.labels) if Path(label).stem == first]
    rows = [0] if len(cameras.labels) == 1 else rows
    if len(rows) != 1 or cameras.rotations is None or cameras.lenses is None:
        sentence = f"has no single pose with angles and a lens for {first}. Give one such row."
        raise bad_file(given.cameras, "photos.no_pose", sentence, photograph=first)
    photo = photo_of(frames.path, cameras, rows[0], size)
    return View(photo, level, index, bed), crs or cameras.crs


def _bed(given: CalmOptions) -> tuple[Callable[[FloatArray], FloatArray], str | None]:
    """Return the height of the true bed by place, and the CRS of its raster."""
    level, depth = given.level, np.nan
    with suppress(ValueError):
        depth = float(given.depth)
    if np.isfinite(depth):
        if not depth > 0.0:
            sentence = f"depth {depth:g} is not positive. Give metres below the level."
            raise SettingError("option.range", sentence, option="depth", value=depth)
        return lambda xy: np.full(len(xy), level - depth), None
    with tempfile.TemporaryDirectory() as scratch:
        found = read_heights(given.depth, given.resolution, Path(scratch))
    height, (left, top, cell), crs, corrected = found
    if not corrected:
        index = index_of(given.index, given.index_formula)[0]
        height = np.where(height < level, level - index * (level - height), height)
    raster = WaterRaster(height, left, top, (cell, cell), "bed")
    return lambda xy: surface_above(raster, xy).height_m, crs


def _water(
    view: View, nodes: Nodes, shifts: FloatArray, weights: FloatArray, interval_s: float
) -> tuple[list[tuple[FloatArray, FloatArray]], Figures]:
    """Fit the water of all frames; return heights and standard errors of each, and a summary."""
    times, seen = np.arange(len(shifts), dtype=np.float64) * interval_s, nodes.seen
    depth = float(np.nanmedian(view.level_m - view.bed(nodes.xy[seen])))
    heights = np.full(shifts.shape[:2], view.level_m)
    for _ in range(2):  # the heights of the piercing points follow from the first pass
        both = zip(heights, shifts, strict=True)
        slope = np.stack([slopes_of(view, nodes.xy, *one) for one in both])
        weight = np.where(np.isfinite(slope.sum(axis=2)), weights, 0.0)
        slope = np.nan_to_num(slope)
        if not (weight > 0.0).any():
            sentence = "No part of the image shows a bed under moving water. Check depth and level."
            raise GeometryError("frames.no_water", sentence, depth_m=depth)
        waves = fit_waves(nodes, slope, weight, times, depth)
        found = [waves.at(nodes, time_s) for time_s in times]
        heights = view.level_m + np.stack([height for height, _ in found])
    energy = float((weight[..., None] * slope**2).sum() / (2.0 * weight.sum()))
    summary = Figures(
        folder="", waves=len(waves.number),
        slope_deg=round(float(np.degrees(np.sqrt(energy))), 3),
        height_m=round(float(np.std([one[0][seen] for one in found])), 4),
        sigma_m=round(float(np.sqrt(np.mean([one[1][seen] ** 2 for one in found]))), 4),
        explained=round(waves.explained, 3),
    )  # fmt: skip
    return found, summary


def _write_waters(
    folder: Path, names: tuple[str, ...], level_m: float, lattice: Lattice, waters: Any,
    crs: str | None,
) -> None:  # fmt: skip
    """Write a raster of the water of each frame, and its standard error in a folder of those."""
    (folder / "sigma").mkdir()
    parsed = None if crs is None else parse_crs(crs, "the bed")
    for name, (height, sigma) in zip(names, waters, strict=True):
        for path, band, values in (
            (folder / f"{name}.tif", "height", level_m + height),
            (folder / "sigma" / f"{name}.tif", "standard error", sigma),
        ):
            with new_raster(path, lattice, parsed, {band: "m"}) as target:
                write_bands(target, [values.reshape(lattice.height, -1)], lattice.window)

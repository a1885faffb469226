"""A sequence of one place to the image through calm water, and to the water of each frame."""

from __future__ import annotations

import json
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pcfix.blocks import let_go
from pcfix.errors import GeometryError, InputError, PcfixWarning, SettingError
from pcfix.flow.dsm import grid_dsm
from pcfix.flow.inputs import Inputs
from pcfix.flow.photos import lens_of
from pcfix.flow.runner import Progress, check_summary, write_summary
from pcfix.grid.lattice import Lattice
from pcfix.io.crs import parse_crs
from pcfix.io.drafts import folder_when_whole, replaced_when_whole
from pcfix.io.files import scratch_arrays
from pcfix.io.frames import Frames, check_calm, read_frames, write_calm, write_spread
from pcfix.io.rasters import filled_heights, new_raster, open_raster, write_part
from pcfix.kernels import threads
from pcfix.model import FloatArray, Lens, WaterRaster
from pcfix.options.declare import File, taken
from pcfix.options.photos import CalmOptions
from pcfix.photos.calm import (
    LEAST_CORNERS,
    CalmSummary,
    Follower,
    Registration,
    WaterFound,
    covered,
    laid,
    median_of,
    register,
    strip_rows,
)
from pcfix.photos.mapping import Photo
from pcfix.photos.waves import (
    Displacements,
    Nodes,
    Slopes,
    View,
    Waves,
    fit_waves,
    nodes_of,
    slopes_of,
    still,
)
from pcfix.water.index import index_of
from pcfix.water.surface import surface_above

DOWN = np.diag([1.0, -1.0, -1.0])
FAR_PX = 1e5
"""Focal length of the camera that stands for parallel rays, pixels per pixel of the image."""
PASSES = 2
"""Over the surface: the height at which the rays meet it follows from the first."""
LEAST_EXPLAINED = 0.5
"""Of the slopes; waves that explain less are worth a warning."""


def calm_frames(
    frames: File,
    out: File,
    *,
    options: CalmOptions | None = None,
    progress: Progress | None = None,
    **keywords: Any,
) -> CalmSummary:
    """Write the median of a sequence through waves; what ``pcfix calm`` runs.

    Parameters
    ----------
    frames : path
        Folder of photographs of one size, in the order of their names, or a video.
    out : path
        Image of the frames' format, with the metadata of the first; PNG of a video. The spread is
        written beside it, and with `surface` a folder of rasters of the water.
    options : CalmOptions, optional
        Or its attributes as keywords.
    progress : callable, optional
        Called with (frames done, frames in all); each is gone through twice, with `surface` thrice.

    Returns
    -------
    CalmSummary

    Raises
    ------
    PcfixError
        With one sentence on what to mend.
    """
    given = taken(CalmOptions, options, keywords, "calm_frames")
    check_summary(given)
    started = time.perf_counter()
    found = read_frames(frames, given.every)
    target, beside = check_calm(out, found, overwrite=given.overwrite)
    folder = target.with_name(f"{target.stem}_water")
    if given.surface and folder.exists() and not given.overwrite:
        raise SettingError(f"{folder}: the output exists; add --overwrite to replace it.")
    count = _Counted(progress, len(found.names) * (1 + given.surface + (not given.still)))
    with threads(given.jobs), scratch_arrays(target) as empty:
        view, crs = _view(given, found) if given.surface else (None, None)
        way = _standing(len(found.names)) if given.still else _registered(found, count)
        median, spread, stack = _median(found, way, empty, count)
        notes: list[str] = []
        water = None
        if view is not None:
            waters, nodes, water = _water(given, found, view, count, median=median, stack=stack)
            with folder_when_whole(folder) as draft:
                _write_waters(draft, found.names, view.level_m, nodes, waters, crs)
            water = water._replace(folder=str(folder))
            notes = _notes_of(water, tied=bool(given.interval or found.interval_s))
    write_calm(target, found, median)
    write_spread(beside, spread)
    middle = np.array([0.5 * found.columns, 0.5 * found.rows, 1.0])
    moved = way.homography @ middle
    for note in notes:
        warnings.warn(note, PcfixWarning, stacklevel=2)
    summary = CalmSummary(
        input=str(frames), output=str(out), spread_file=str(beside), frames=len(found.names),
        columns=found.columns, rows=found.rows, corners=len(way.scatter_px),
        scatter_px=round(float(np.median(way.scatter_px)) if len(way.scatter_px) else 0.0, 3),
        moved_px=round(float(np.hypot(*(moved[:, :2] / moved[:, 2:] - middle[:2]).T).max()), 2),
        spread=round(float(np.nanmedian(spread)), 2),
        seconds=round(time.perf_counter() - started, 3), water=water, notes=tuple(notes),
    )  # fmt: skip
    write_summary(given, asdict(summary) | {"water": None if water is None else water._asdict()})
    return summary


class _Counted:
    """Counts frames as they are gone through."""

    def __init__(self, progress: Progress | None, total: int) -> None:
        self._progress, self._total, self._done = progress, total, 0

    def __call__(self, frames: Any) -> Iterator[Any]:
        for frame in frames:
            yield frame
            self._done += 1
            if self._progress is not None:
                self._progress(self._done, self._total)


def _standing(frames: int) -> Registration:
    return Registration(np.tile(np.eye(3), (frames, 1, 1)), np.empty(0))


def _registered(frames: Frames, count: _Counted) -> Registration:
    follower: Follower | None = None
    places: list[FloatArray] = []
    for frame in count(frames):
        follower = follower or Follower(frame)
        places.append(follower.follow(frame) if places else follower.full(follower.at))
    way = register(np.stack(places))
    lost = np.flatnonzero(~np.isfinite(way.homography).all(axis=(1, 2)))
    if len(lost):
        raise InputError(
            f"{frames.path}: {len(lost)} frames cannot be laid onto the first, with which they"
            f" share fewer than {LEAST_CORNERS} corners: {frames.names[lost[0]]}; leave them"
            " out, or begin with another."
        )
    return way


def _median(
    frames: Frames, way: Registration, empty: Callable[..., Any], count: _Counted
) -> tuple[npt.NDArray[Any], FloatArray, Any]:
    """Return the median, its spread, and the frames as they lie on the first, in a file."""
    stack: Any = None
    for number, frame in enumerate(count(frames)):
        if stack is None:
            stack = empty((len(frames.names), *frame.shape), frame.dtype)
        if frame.shape != stack.shape[1:] or frame.dtype != stack.dtype:
            raise InputError(
                f"{frames.names[number]}: has {frame.shape[2]} bands of {frame.dtype}, and the"
                f" first frame {stack.shape[3]} of {stack.dtype}; a sequence is of one kind."
            )
        same = np.array_equal(way.homography[number], np.eye(3))
        stack[number] = frame if same else laid(frame, way.homography[number])
        let_go()
    shape = stack.shape[1:3]
    median = np.empty(stack.shape[1:], stack.dtype)
    spread = np.empty(shape, np.float32)
    at_once = strip_rows(len(stack), shape[1], stack.shape[3])
    for top in range(0, shape[0], at_once):
        bottom = min(top + at_once, shape[0])
        known = np.stack([covered(one, shape, top, bottom) for one in way.homography])
        median[top:bottom], spread[top:bottom] = median_of(stack[:, top:bottom], known)
        let_go()
    return median, spread, stack


def _view(given: CalmOptions, frames: Frames) -> tuple[View, str | None]:
    """Return what the frames are of, as the options have it, and the CRS."""
    bed, crs = _bed(given)
    index, level = index_of(given.index, given.index_formula)[0], given.level
    size = frames.columns, frames.rows
    if given.gsd is not None:
        lens = Lens(FAR_PX * max(size), *size, 0.5 * size[0], 0.5 * size[1])
        centre = given.gsd * np.array([0.5 * size[0], -0.5 * size[1], lens.focal])
        centre[2] += level
        return View(Photo("gsd", centre, DOWN, lens), level, index, bed), crs
    cameras, _ = Inputs(
        cameras=given.cameras, sensor=given.sensor, angles=given.angles, water=level,
        cameras_crs=given.cameras_crs, cameras_offset=given.cameras_offset,
    ).block(crs)  # fmt: skip
    first = frames.names[0] if frames.photographs else frames.path.stem
    rows = [row for row, label in enumerate(cameras.labels) if Path(label).stem == first]
    rows = [0] if len(cameras.labels) == 1 else rows
    if len(rows) != 1 or cameras.rotations is None or cameras.lenses is None:
        raise InputError(
            f"{given.cameras}: has no one pose with angles and a lens for {first}; give one row of"
            " that name."
        )
    row = rows[0]
    lens = lens_of(frames.path, cameras, row, size)
    photo = Photo(cameras.labels[row], cameras.centres[row], cameras.rotations[row], lens)
    return View(photo, level, index, bed), crs or cameras.crs


def _bed(given: CalmOptions) -> tuple[Callable[[FloatArray], FloatArray], str | None]:
    """Return the height of the true bed by place, and the CRS of its raster."""
    level, crs = given.level, None
    try:
        depth = float(given.depth)
    except ValueError:
        depth = np.nan
    if np.isfinite(depth):
        if not depth > 0.0:
            raise SettingError(f"depth {depth:g} is not positive; give metres under the level.")
        return lambda xy: np.full(len(xy), level - depth), None
    path = Path(given.depth)
    with tempfile.TemporaryDirectory() as scratch:
        if path.suffix.lower() in (".las", ".laz"):
            grid_dsm(path, Path(scratch) / "bed.tif", resolution=given.resolution)
            path = Path(scratch) / "bed.tif"
        with open_raster(path) as source:
            t, tags = source.transform, source.tags()
            crs = None if source.crs is None else source.crs.to_wkt()
            height = filled_heights(source, fill=True)
    if not (t.a > 0.0 > t.e and t.b == t.d == 0.0):
        raise InputError(f"{given.depth}: is not north up; warp it first.")
    if not json.loads(tags.get("PCFIX", "{}")).get("corrected"):
        index = index_of(given.index, given.index_formula)[0]
        height = np.where(height < level, level - index * (level - height), height)
    raster = WaterRaster(height, t.c, t.f, (t.a, -t.e), "bed")
    return lambda xy: surface_above(raster, xy).height_m, crs


def _water(
    given: CalmOptions, frames: Frames, view: View, count: _Counted, *, median: Any, stack: Any
) -> tuple[list[tuple[FloatArray, FloatArray]], Nodes, WaterFound]:
    """Return heights and standard errors of the water in each frame."""
    nodes = nodes_of(view, given.resolution)
    measure = Displacements(median, view, nodes)
    interval = given.interval * given.every if given.interval else frames.interval_s
    times = np.arange(len(stack), dtype=np.float64) * (interval or 0.0)
    shifts, weights = (
        np.zeros((len(stack), len(nodes.xy), 2)),
        np.zeros((len(stack), len(nodes.xy))),
    )
    for number, frame in enumerate(count(stack)):
        shifts[number], weights[number] = measure.of(frame)
        let_go()
    weights[:, still(shifts, weights)] = 0.0
    middle = nodes.xy.mean(axis=0)
    depth = float(np.nanmedian(view.level_m - view.bed(nodes.xy[nodes.seen])))
    heights = np.full((len(stack), len(nodes.xy)), view.level_m)
    found: list[tuple[FloatArray, FloatArray]] = []
    for _ in range(PASSES):
        slope = np.stack(
            [slopes_of(view, nodes.xy, *one) for one in zip(heights, shifts, strict=True)]
        )
        known = np.isfinite(slope.sum(axis=2))
        if not (known & (weights > 0.0)).any():
            raise GeometryError("no part of the image shows a bed under moving water; check depth.")
        data = Slopes(
            np.nan_to_num(slope), np.where(known, weights, 0.0), times,
            nodes.xy - middle, nodes.shape, nodes.cell_m,
        )  # fmt: skip
        waves = _waves(data, depth, tied=interval is not None)
        found = [w.at(nodes.xy - middle, t) for w, t in zip(waves, times, strict=True)]
        heights = view.level_m + np.stack([height for height, _ in found])
    seen = nodes.seen
    weight = data.weight[..., None]
    energy = float((weight * data.slope**2).sum() / (2.0 * weight.sum()))
    summary = WaterFound(
        folder="", waves=max(len(one.number) for one in waves),
        slope_deg=round(float(np.degrees(np.sqrt(energy))), 3),
        height_m=round(float(np.std([one[0][seen] for one in found])), 4),
        sigma_m=round(float(np.sqrt(np.mean([one[1][seen] ** 2 for one in found]))), 4),
        explained=round(float(np.mean([one.explained for one in waves])), 3),
    )  # fmt: skip
    return found, nodes, summary


def _waves(data: Slopes, depth_m: float, *, tied: bool) -> list[Waves]:
    """Return the waves of each frame: the same ones where time ties the frames together."""
    if tied:
        return [fit_waves(data, depth_m)] * len(data.time_s)
    return [
        fit_waves(data._replace(slope=s[None], weight=w[None], time_s=np.zeros(1)), depth_m)
        for s, w in zip(data.slope, data.weight, strict=True)
    ]


def _write_waters(
    folder: Path, names: tuple[str, ...], level_m: float, nodes: Nodes, waters: Any, crs: str | None
) -> None:
    """Write a raster of the water of each frame, and its standard error in a folder of those."""
    (folder / "sigma").mkdir()
    size = nodes.cell_m
    lattice = Lattice(
        size, round(nodes.left_m / size), -round(nodes.top_m / size), *nodes.shape[::-1]
    )
    parsed = None if crs is None else parse_crs(crs, "the bed")
    for name, (height, sigma) in zip(names, waters, strict=True):
        for path, band, values in (
            (folder / f"{name}.tif", "height", level_m + height),
            (folder / "sigma" / f"{name}.tif", "standard error", sigma),
        ):
            with (
                replaced_when_whole(path) as draft,
                new_raster(draft, lattice, parsed, {band: "m"}) as target,
            ):
                write_part(target, values.reshape(nodes.shape), lattice.window, 1)


def _notes_of(water: WaterFound, *, tied: bool) -> list[str]:
    notes = []
    if not tied:
        notes.append(
            "the time between frames is not known, so that each frame's water is found alone; give"
            " interval."
        )
    if water.explained < LEAST_EXPLAINED:
        notes.append(
            f"waves explain {100 * water.explained:.0f} % of the slopes alone: a current, glints, a"
            " wrong interval or depth; do not rely on the surfaces."
        )
    return notes

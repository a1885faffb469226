"""Labelling as a step of its own: classes for points, in arrays and in files of any size."""

from __future__ import annotations

import json
import time
from dataclasses import asdict, astuple
from os import PathLike
from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import SettingError
from pcfix.flow.files import file_points, water_heights
from pcfix.flow.inputs import file_of, mask_of
from pcfix.flow.job import parts_of
from pcfix.flow.points import CHUNK_POINTS
from pcfix.flow.surfaces import WaterWords, find_surface, view_of
from pcfix.io.files import check_input, check_output, write_text
from pcfix.io.las.columns import convert
from pcfix.io.las.source import LasSource, coordinates
from pcfix.io.las.writing import (
    LasSink,
    check_suffix,
    corrected_identity,
    labelling_vlr,
    noted_header,
    output_evlrs,
)
from pcfix.label.labelling import Labelling, LabelSummary, Part, sets_class
from pcfix.model import WaterPlane
from pcfix.options import LabelSettings
from pcfix.threads import threads
from pcfix.version import __version__
from pcfix.water.checks import as_surface, check_submerged, check_tilt, checked_points
from pcfix.water.surface import surface_above

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    import laspy
    import numpy.typing as npt

    from pcfix.flow.surfaces import WaterModel
    from pcfix.label.areas import WaterMask
    from pcfix.label.labelling import Labels
    from pcfix.model import FloatArray, WaterSurface

    AnyPath = str | PathLike[str]
    Classes = npt.NDArray[np.uint8]


class Counts:
    """Adds up what becomes of points, under the names of `LabelSummary`."""

    def __init__(self) -> None:
        self.submerged = self.water_surface = self.stale = self.water_unknown = self.points = 0

    def add(self, part: Part, labels: Labels) -> None:
        """Add some points and what they become."""
        self.points += len(part.classes)
        self.submerged += int(labels.submerged.sum())
        self.water_surface += int(labels.at_surface.sum())
        labelled = labels.submerged | labels.at_surface
        self.stale += int((sets_class(part.classes) & ~labelled).sum())
        self.water_unknown += int(np.isnan(part.surface.height_m).sum())


def label_points(
    xyz: npt.ArrayLike,
    water: WaterSurface | float | npt.ArrayLike,
    *,
    classes: npt.ArrayLike | None = None,
    water_mask: WaterMask | AnyPath | None = None,
    crs: str | None = None,
    settings: LabelSettings | None = None,
) -> Classes:
    """Return the classes of points, 40 where they are submerged.

    Parameters
    ----------
    xyz : array, shape (n, 3)
        Points, metres, world frame.
    water : WaterSurface, float, or array of shape (n,)
        See `pcfix.correct_points`.
    classes : array of uint8, shape (n,), optional
        That they come with. Default: 0, never classified.
    water_mask : WaterMask or path, optional
        See `label_file`.
    crs : str, optional
        Of the points, for a mask from a file.
    settings : LabelSettings, optional

    Returns
    -------
    array of uint8, shape (n,)

    Raises
    ------
    PcfixError
        If an argument is outside its rule, or the mask cannot be used.

    Examples
    --------
    >>> from pcfix.flow.label import label_points
    >>> label_points([[0, 0, 1.0], [5, 0, -1.0]], 0.0).tolist()
    [0, 40]
    """
    points = checked_points(xyz)
    given = np.zeros(len(points), np.uint8) if classes is None else np.asarray(classes)
    if given.shape != (len(points),) or given.dtype != np.uint8:
        raise SettingError(
            f"classes must be {len(points)} values of uint8, not {given.dtype} of shape"
            f" {given.shape}."
        )
    surface, heights = as_surface(water, len(points))
    if water_mask is None or isinstance(water_mask, str | PathLike):
        water_mask = mask_of(water_mask, crs, *corners(points))
    labelling = Labelling(settings or LabelSettings(), water_mask)
    part = Part(points, surface_above(surface, points, heights), given)
    if labelling.looks_around:
        labelling.look_around(lambda: [part], *corners(points))
    return labelling.labels(part).classes


def corners(xyz: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the south-west and north-east corner of points, shapes (2,); NaN where there are none.

    They are metres, as the points are, shape (n, 3).
    """
    if not len(xyz):
        return np.full(2, np.nan), np.full(2, np.nan)
    # axis by axis: numpy is slow along the short one
    low = np.array([xyz[:, 0].min(), xyz[:, 1].min()])
    return low, np.array([xyz[:, 0].max(), xyz[:, 1].max()])


def label_file(
    input: AnyPath,
    output: AnyPath,
    *,
    water: WaterSurface | float | AnyPath,
    water_model: WaterModel = "auto",
    water_crs: str | None = None,
    water_mask: AnyPath | None = None,
    settings: LabelSettings | None = None,
    summary: AnyPath | None = None,
    overwrite: bool = False,
    jobs: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> LabelSummary:
    """Give the submerged points of a LAS or LAZ cloud class 40; what ``pcfix label`` runs.

    Nothing else changes, but for class 41 where a band is asked for, and points that come as 40
    or 41 and are neither, which become class 1 with ``reset``. Ground and all other classes above
    the water stay, and so do the classes 42 to 45 there, which say what others knew of the water.

    Parameters
    ----------
    input, output : path
        The names end in ``.las`` or ``.laz``; the output is LAS 1.4, see `correct_file`.
    water, water_model, water_crs
        See `pcfix.flow.surfaces.WaterWords`.
    water_mask : path, optional
        Polygons (GeoPackage, Shapefile, GeoJSON, WKT), outside which, and in whose holes, no
        point is submerged. A point on the border is inside. They are brought to the cloud's CRS.
    settings : LabelSettings, optional
        Band, dead band, connectivity and classes to respect. With a dead band or connectivity
        the cloud is read twice. The result does not depend on the size of chunks.
    summary, overwrite, jobs, progress
        See `correct_file`.

    Returns
    -------
    LabelSummary

    Raises
    ------
    PcfixError
        With one sentence on what to mend; no output is left behind.
    """
    started = time.perf_counter()
    settings = settings or LabelSettings()
    path = check_input(input)
    given = [file_of(one) for one in (input, water) if isinstance(one, str | PathLike)]
    given += [] if water_mask is None else [file_of(water_mask)]
    target = check_output(output, overwrite=overwrite, inputs=given)
    check_suffix(target)
    if summary is not None:
        check_output(summary, overwrite=overwrite, inputs=[*given, target])
    with threads(jobs):
        words = WaterWords(water, water_model, water_crs)
        surface, labelling = _surface_and_rules(path, words, water_mask, settings, jobs)
        counts = _write(path, target, surface, labelling, jobs, progress)
    result = LabelSummary(
        input=str(path),
        output=str(target),
        pcfix=__version__,
        **vars(counts),
        water=str(surface),
        settings=asdict(settings),
        labelling=labelling.report(),
        seconds=round(time.perf_counter() - started, 3),
        warnings=list(labelling.notes),
    )
    if summary is not None:
        write_text(summary, json.dumps(result.as_dict(), indent=2) + "\n", overwrite=overwrite)
    return result


def _surface_and_rules(
    path: Path,
    words: WaterWords,
    water_mask: AnyPath | None,
    settings: LabelSettings,
    jobs: int | None,
) -> tuple[WaterSurface, Labelling]:
    """Return the water and the rules, with the surroundings of all points where they need them."""
    view = view_of(path)
    surface = find_surface(words, view).surface
    check_tilt(surface)
    labelling = Labelling(settings, mask_of(water_mask, view.crs, view.low, view.high))
    if labelling.looks_around:
        labelling.look_around(
            lambda: parts_of(file_points(path, surface, jobs), surface), view.low, view.high
        )
    return surface, labelling


def _write(
    path: Path,
    target: Path,
    water: WaterSurface,
    labelling: Labelling,
    jobs: int | None,
    progress: Callable[[int, int], None] | None,
) -> Counts:
    """Read, label and write chunk by chunk."""
    counts = Counts()
    with LasSource(path, jobs) as source:
        header = _labelled_header(source, water, labelling)
        evlrs, identity = output_evlrs(source), corrected_identity(source)
        with LasSink(target, header, evlrs, identity, jobs) as sink:
            for points in source.chunks(CHUNK_POINTS):
                part = _part(points, water, source)
                labels = labelling.labels(part)
                counts.add(part, labels)
                new = convert(points, header.point_format)
                new.array["classification"] = labels.classes
                sink.write(new)
                if progress is not None:
                    progress(counts.points, len(source))
            labelling.check(str(path))
            check_submerged(counts.submerged + counts.water_surface, str(path), water)
    return counts


def _part(points: laspy.ScaleAwarePointRecord, water: WaterSurface, source: LasSource) -> Part:
    xyz = coordinates(points)
    surface = surface_above(water, xyz, water_heights(water, source, points))
    return Part(xyz, surface, np.asarray(points["classification"]))


def _labelled_header(
    source: LasSource, water: WaterSurface, labelling: Labelling
) -> laspy.LasHeader:
    """Return the header of a labelled file, with a record of what was done."""
    mask = labelling.mask
    content = {
        "pcfix": __version__,
        "settings": asdict(labelling.settings),
        "water": str(water),
        "water_plane": list(astuple(water)) if isinstance(water, WaterPlane) else None,
        "water_mask": None if mask is None else mask.name,
    }
    return noted_header(source, labelling_vlr(content))

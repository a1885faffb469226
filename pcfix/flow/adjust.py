"""Refractive bundle adjustment from files into a folder: one call for all doors."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pcfix.adjust.gather import LEAST_VIEWS
from pcfix.adjust.gather import taken as taken_ties
from pcfix.adjust.problem import Progress
from pcfix.adjust.result import Adjusted
from pcfix.adjust.ways import unknowns_of
from pcfix.errors import InputError, SettingError
from pcfix.flow.adjust_job import Survey, adjusted, read_job
from pcfix.flow.inputs import Inputs
from pcfix.flow.next_steps import WATER
from pcfix.flow.surfaces import view_of
from pcfix.io.cameras.colmap.writing import write_colmap
from pcfix.io.cameras.opensfm.models import write_opensfm
from pcfix.io.cameras.table.sensor import write_table
from pcfix.io.drafts import folder_when_whole
from pcfix.io.files import write_text
from pcfix.io.members import write_members
from pcfix.io.tiles import Clouds, cloud_of
from pcfix.io.water_rasters import write_water_raster
from pcfix.model import Cameras, TiePoints, Views, WaterRaster
from pcfix.options.declare import File, taken
from pcfix.options.survey import AdjustOptions, AdjustRules

SUMMARY = "adjustment.json"


def adjust_cameras(
    model: File | Cameras,
    out_dir: File | None = None,
    *,
    options: AdjustOptions | None = None,
    progress: Progress | None = None,
    **keywords: Any,
) -> Adjusted:
    """Adjust the poses of a block with the water in the light's way; ``pcfix adjust``.

    Parameters
    ----------
    model : path or Cameras
        See `pcfix.read_cameras`; with tie points, or together with the cloud that it made.
    out_dir : path, optional
        A new folder: the adjusted model as ``colmap/`` and ``opensfm/``, where one lens will do
        as ``cameras.csv``, ``ensemble.npz`` (see `pcfix.adjust.members`), ``adjustment.json`` and
        ``report.html``; water that is no plane and was free as ``water.tif``. Nothing is written
        without.
    options : AdjustOptions, optional
        Or its attributes as keywords, as of ``pcfix adjust``: water (or port), cloud (apparent;
        some of its points stand for tie points where there are none), gcps, gnss, lens (held
        fixed unless lens_unknowns say otherwise) and others.
    progress : callable, optional
        Called with the `LogRow` of each step.

    Returns
    -------
    Adjusted

    Raises
    ------
    PcfixError
        If an input cannot be read or does not fit, the block has no datum, or the unknowns cannot
        be told apart. Nothing is written then.
    """
    if "free_network" in keywords:  # what was true or false is one of two words now
        keywords["free_network"] = "free" if keywords["free_network"] else "observed"
    given = taken(AdjustOptions, options, keywords, "adjust_cameras")
    inputs = replace(given.part(Inputs), cameras=model)
    survey = Survey(given.gcps, given.gnss, given.lens, given.gcps_crs, given.gnss_crs)
    target = None if out_dir is None else Path(out_dir)
    return adjust_into(
        target, inputs, survey, given.part(AdjustRules), given.cloud,
        overwrite=given.overwrite, progress=progress,
    )  # fmt: skip


def adjust_into(
    folder: Path | None, inputs: Inputs, survey: Survey, rules: AdjustRules,
    cloud: Clouds | None = None, *, overwrite: bool = False, progress: Progress | None = None,
) -> Adjusted:  # fmt: skip
    """Adjust cameras with what was read of the options; see `adjust_cameras`."""
    unknowns_of(rules, ())
    target = None if folder is None else checked_folder(folder, overwrite, inputs.paths())
    view = None if cloud is None else view_of(cloud_of(cloud))
    found = adjusted(read_job(inputs, rules, view, survey), progress)
    if target is not None:
        write_adjustment(target, found, str(inputs.cameras))
    return found


def checked_folder(folder: Path, overwrite: bool, inputs: list[Any]) -> Path:
    """Return a folder that may be written.

    Raises
    ------
    SettingError
        If it exists and is not an earlier adjustment that may be replaced.
    """
    if any(folder.exists() and Path(one).exists() and folder.samefile(one) for one in inputs):
        raise SettingError(f"{folder}: output and model are the same; give another folder.")
    if folder.exists() and not folder.is_dir():
        raise SettingError(f"{folder}: is a file; give a folder.")
    if folder.is_dir() and any(folder.iterdir()):
        if not overwrite:
            raise SettingError(f"{folder}: the output exists; add --overwrite to replace it.")
        if not (folder / SUMMARY).is_file():
            raise SettingError(
                f"{folder}: holds other files than an adjustment's; give an empty or new folder."
            )
    if not folder.resolve().parent.is_dir():
        raise SettingError(f"{folder}: the folder {folder.parent} does not exist; make it first.")
    return folder


def write_adjustment(folder: Path, found: Adjusted, model: str) -> None:
    """Write an adjusted block: model, camera files, summary, report; all or nothing."""
    from pcfix.report.adjustment import adjustment_dict, adjustment_page, before_of

    before = before_of(found)
    with folder_when_whole(folder) as draft:
        _write_models(draft, found)
        moved = found.unknowns.level_sigma_m or found.unknowns.shape_sigma
        if moved and isinstance(found.water, WaterRaster):
            write_water_raster(draft / WATER, found.water, found.cameras.crs)
        if found.precision is not None and found.precision.members is not None:
            write_members(draft, found.precision.members)
        summary = {"model": model, **adjustment_dict(found, before)}
        text = json.dumps(summary, indent=2, allow_nan=False) + "\n"
        write_text(draft / SUMMARY, text, overwrite=False)
        write_text(draft / "report.html", adjustment_page(found, before), overwrite=False)


def _write_models(folder: Path, found: Adjusted) -> None:
    """Write the model in each form that holds its lenses exactly."""
    ties, cameras, opensfm = adjusted_ties(found), found.cameras, folder / "opensfm"
    writers = {
        "colmap": partial(write_colmap, folder / "colmap", cameras, ties, crs=cameras.crs),
        "opensfm": partial(write_opensfm, opensfm / "reconstruction.json", cameras, ties),
        "cameras.csv": partial(write_table, folder, cameras),
    }
    failed = []
    opensfm.mkdir()
    for name, write in writers.items():
        try:
            write()
        except InputError as error:
            failed.append(str(error).replace(f"{folder}/", ""))
            if name != "cameras.csv":  # a table is a convenience for blocks of one plain lens
                found.notes.append(f"{name} is not written: {failed[-1]}")
    if not any(opensfm.iterdir()):
        opensfm.rmdir()
    if len(failed) == len(writers):
        raise InputError("no form of camera file holds these lenses: " + " ".join(failed))


def adjusted_ties(found: Adjusted) -> TiePoints | None:
    """Return the adjusted tie points without outliers; None where points of the cloud stood in."""
    if found.source == "cloud":
        return None
    block = found.block
    m = len(block.xyz) - len(block.control_names)
    owner = block.owner
    kept = found.used & (owner < m)
    counts = np.bincount(owner[kept], minlength=m)[:m]
    start = np.concatenate([[0], np.cumsum(counts)])
    ties = TiePoints(found.xyz[:m], Views(start, block.camera[kept]), block.image_xy[kept])
    return taken_ties(ties, np.flatnonzero(counts >= LEAST_VIEWS))

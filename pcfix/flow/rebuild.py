"""Rebuild a cloud in rounds: photographs without water, a cloud from them, its DSM, and again.

The workflow of Fig 10 of Skarlatos & Agrafiotis 2018, until a DSM differs from the one before by
less than a threshold (a ground pixel). Here the mean difference under water counts, as single cells
scatter by the noise of the matcher. Each round starts from the original images
and the DSM of the round before. With the mapping ``exact`` and the true bed, one round is enough.
"""

from __future__ import annotations

import shlex
import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from pcfix.errors import InputError, SettingError
from pcfix.flow.dsm import grid_dsm
from pcfix.flow.photos import PhotoBlock, block_of, finished, map_photos
from pcfix.flow.runner import Progress, check_summary, json_text, key_of
from pcfix.io.clouds import is_cloud
from pcfix.io.files import read_json, run_logged, write_text
from pcfix.io.las.writing import write_points
from pcfix.io.photographs import photographs_in, read_colours
from pcfix.io.rasters import open_raster, place_of, read_masked, write_dod
from pcfix.options.declare import File, taken
from pcfix.options.steps import PhotosOptions, RebuildOptions
from pcfix.photos.ortho import Picture, blank_in
from pcfix.photos.stereo import stereo_cloud
from pcfix.running import threads
from pcfix.sums import Figures
from pcfix.water.surface import surface_above

RECORD = "pcfix-rebuild.json"
COMMAND_ONLY = ("overwrite", "jobs", "summary", "rebuild", "until_gsd", "most_rounds")
"""Options that a later call may change and still resume."""


def rebuild_rounds(
    images: File,
    out: File,
    *,
    options: PhotosOptions | None = None,
    progress: Progress | None = None,
    say: Callable[[str], None] | None = None,
    **keywords: Any,
) -> Figures:
    """Rebuild the cloud in rounds; what ``pcfix photos --rebuild`` runs.

    Parameters
    ----------
    images : path
        Folder of photographs, as for `pcfix.flow.photos.map_photos`.
    out : path
        Folder, created if needed. Each round writes ``images``, ``cloud.laz``, ``dsm.tif`` and
        ``difference.tif`` (from the DSM before) in a folder ``round1``, ``round2`` ... Rounds that
        an equal call has finished are skipped.
    options : PhotosOptions, optional
        Or its attributes as keywords, rebuild among them.
    progress : callable, optional
        Called with (photographs or pairs done, those in all).
    say : callable, optional
        Called with a line for each round.
    """
    started = time.perf_counter()
    given = taken(PhotosOptions, options, keywords, "rebuild_rounds")
    if given.rebuild is None:
        sentence = "--rebuild is missing. Give stereo, or a command."
        raise SettingError("option.missing", sentence, option="rebuild")
    paths, target = photographs_in(Path(images)), Path(out)
    check_summary(given)
    target.mkdir(parents=True, exist_ok=True)
    folders = list(target.glob("round[0-9]*"))
    while given.overwrite and folders:
        shutil.rmtree(folders.pop())
    place, key = target / RECORD, key_of("rebuild", given, ignored=COMMAND_ONLY)
    if folders and place.exists() and read_json(place) != {"key": key}:
        sentence = (
            f"{target}: has rounds of other options or inputs. Add --overwrite to replace them."
        )
        raise SettingError("output.exists", sentence, path=target)
    write_text(place, json_text({"key": key}), overwrite=True)
    if is_cloud(Path(given.dsm)):  # it is gridded to the folder
        raster = target / "dsm.tif"
        if not (folders and raster.exists()):
            grid_dsm(given.dsm, raster, resolution=given.resolution, overwrite=True)
        given = replace(given, dsm=raster, resolution=None)
    with threads(given.jobs), TemporaryDirectory() as scratch:
        block = block_of(given, paths, Path(scratch))
    threshold_m = round(given.until_gsd * block.gsd_m, 5)
    rounds, done_before = list[Figures](), 0
    # each round starts from the original images
    how = replace(given, resolution=None, summary=None, **RebuildOptions().as_dict())
    while len(rounds) < given.most_rounds and not (rounds and abs(rounds[-1].mean_m) < threshold_m):
        number, before = len(rounds) + 1, Path(rounds[-1].dsm if rounds else given.dsm)
        folder = target / f"round{number}"
        cloud, dsm = folder / "cloud.laz", folder / "dsm.tif"
        if dsm.exists():
            done_before += 1
        else:
            how = replace(how, dsm=before, overwrite=True)
            map_photos(images, folder / "images", options=how, progress=progress)
            with threads(given.jobs):
                _reconstruct(given, block, number, folder / "images", cloud, progress)
            grid_dsm(cloud, dsm, resolution=block.scene.ground.cell_m)
        one = _difference(block, cloud, dsm, before)
        rounds.append(one)
        if say is not None:
            say(
                f"Round {number}: the bed moved by {one.mean_m:+.3f} m (standard deviation"
                f" {one.sd_m:.3f} m), {100 * one.within_gsd:.0f} % of it by at most one pixel"
            )
    return finished(
        given,
        started,
        [],
        rounds=rounds,
        done_before=done_before,  # rounds that an earlier call finished
        converged=abs(rounds[-1].mean_m) < threshold_m,
        gsd_m=round(block.gsd_m, 5),
        threshold_m=threshold_m,
        mapping=given.mapping,
        rebuild=str(given.rebuild),
    )


def _reconstruct(
    given: PhotosOptions, block: PhotoBlock, number: int, images: Path, cloud: Path,
    progress: Progress | None,
) -> None:  # fmt: skip
    """Make the cloud of a round, by a program of the user's or by stereo pairs."""
    if given.rebuild == "stereo":
        import cv2

        @lru_cache(maxsize=16)
        def picture(row: int) -> Picture:
            pixels = read_colours(images / block.paths[row].name)
            grey = pixels[..., 0]
            if pixels.shape[2] >= 3:
                grey = cv2.cvtColor(np.ascontiguousarray(pixels[..., :3]), cv2.COLOR_RGB2GRAY)
            if grey.dtype == np.uint16:
                grey = (grey >> 8).astype(np.uint8)
            return Picture(np.ascontiguousarray(grey), blank=blank_in(pixels))

        side = 2.0 * block.gsd_m
        xyz = stereo_cloud(block.photos, block.scene.ground, side, picture, progress)
        write_points(cloud, xyz, (block.crs, 0.001))
        return
    cloud.unlink(missing_ok=True)
    words = shlex.split(given.rebuild or "")
    for name, place in ("images", images), ("cameras", given.cameras), ("cloud", cloud):
        words = [word.replace(f"{{{name}}}", str(Path(place).resolve())) for word in words]
    log = cloud.with_name("rebuild.log")
    code, last = run_logged(words, log)
    if code or not cloud.exists():
        wrong = f"ended with code {code}" if code else f"wrote no {cloud}"
        raise InputError(
            "rebuild.failed",
            f"--rebuild {wrong} in round {number}: {' / '.join(last) or 'no message'} (see {log})."
            " Correct it and run the same command again; it resumes here.",
            exit_code=code, round=number, log=log,
        )  # fmt: skip


def _difference(block: PhotoBlock, cloud: Path, dsm: Path, before: Path) -> Figures:
    """Return by how much the DSM of a round differs from that before, under water."""
    raster = dsm.with_name("difference.tif")
    write_dod(dsm, before, raster)  # an error if they do not overlap
    with open_raster(raster) as source, open_raster(dsm) as heights:
        change, z, transform = read_masked(source), read_masked(heights), source.transform
    row, column = np.nonzero(np.isfinite(change))
    moved, z = change[row, column], z[row, column]
    x, y = place_of(transform, column + 0.5, row + 0.5)
    wet = surface_above(block.scene.water, np.column_stack([x, y, z])).height_m > z
    moved = moved[wet] if wet.any() else moved
    return Figures(
        cloud=str(cloud),
        dsm=str(dsm),
        # its DSM minus the one before, over submerged cells
        cells=len(moved),
        mean_m=round(float(moved.mean()), 5),
        sd_m=round(float(moved.std()), 5),
        within_gsd=round(float((np.abs(moved) <= block.gsd_m).mean()), 5),
    )

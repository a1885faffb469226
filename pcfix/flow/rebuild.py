"""Rounds: photographs without water, a cloud from them, its DSM, and again until the bed stays.

The workflow of Fig 10 of Skarlatos & Agrafiotis 2018. Each round starts from the photographs as
they were taken, and from the DSM of the round before. With the mapping ``exact`` and the true bed
the first round ends it: the rebuilt cloud is free of refraction, and lies where the DSM does.
"""

from __future__ import annotations

import json
import shlex
import shutil
import time
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from pcfix.errors import InputError, PcfixError, PcfixWarning, SettingError
from pcfix.flow.compare import compare_clouds
from pcfix.flow.dsm import grid_dsm
from pcfix.flow.photos import Block, block_of, map_photos
from pcfix.flow.runner import Progress, check_summary, json_text, write_summary
from pcfix.io.files import check_input, file_state, read_json, run_logged, write_text
from pcfix.io.las.writing import write_points
from pcfix.io.photographs import photographs_in, read_colours
from pcfix.io.rasters import open_raster, place_of, read_masked, write_dod
from pcfix.kernels import threads
from pcfix.options.declare import File, taken
from pcfix.options.photos import PhotosOptions, RebuildOptions
from pcfix.photos.ortho import blank_in
from pcfix.photos.rounds import PAPER_ROUNDS, RebuildSummary, Round, paper_excess, round_of
from pcfix.photos.stereo import Grey, stereo_cloud
from pcfix.version import __version__
from pcfix.water.surface import surface_above

RECORD = "pcfix-rebuild.json"
STEREO_CELL_PIXELS = 2.0
STEREO_STEP_M = 0.001
CACHED_PHOTOGRAPHS = 16
COMMAND_ONLY = ("overwrite", "jobs", "summary", "rebuild", "until_gsd", "most_rounds", "reference")
"""Options that a later call may change and still go on from the rounds that are there."""
NOT_SAID = ".*does not say that it is of a cloud.*"
"""Said of the DSM given; those of later rounds are pcfix's own."""


def rebuild_rounds(
    images: File,
    out: File,
    *,
    options: PhotosOptions | None = None,
    progress: Progress | None = None,
    say: Callable[[str], None] | None = None,
    **keywords: Any,
) -> RebuildSummary:
    """Rebuild the cloud in rounds; what ``pcfix photos --rebuild`` runs.

    Parameters
    ----------
    images : path
        Folder of photographs, as of `pcfix.flow.photos.map_photos`.
    out : path
        Folder, made where it is missing. Each round leaves ``images``, ``cloud.laz``, ``dsm.tif``
        and ``difference.tif`` (from the DSM before) in a folder ``round1``, ``round2`` ...; rounds
        that an equal call has finished are not repeated.
    options : PhotosOptions, optional
        Or its attributes as keywords, rebuild among them.
    progress : callable, optional
        Called with (photographs or pairs done, those in all).
    say : callable, optional
        Called with a line for each round.

    Returns
    -------
    RebuildSummary

    Raises
    ------
    PcfixError
        With one sentence on what to mend; rounds that were finished stay.
    """
    started = time.perf_counter()
    given = taken(PhotosOptions, options, keywords, "rebuild_rounds")
    if given.rebuild is None:
        raise SettingError("rebuild is missing: give stereo, or a command.")
    paths, target = photographs_in(Path(images)), Path(out)
    check_summary(given)
    if given.reference is not None:
        check_input(given.reference)
    target.mkdir(parents=True, exist_ok=True)
    record = _Record.opened(target, given)
    given = _with_raster(given, target)
    with threads(given.jobs), TemporaryDirectory() as scratch:
        block = block_of(given, paths, Path(scratch))
    run = _Run(Path(images), target, given, block, progress)
    rounds, notes, settled = run.all(record, say or (lambda text: None))
    compare = _compare_words(rounds, record.start_cloud, given, target)
    compared = _compared(rounds, record.start_cloud, given, target)
    summary = RebuildSummary(
        tuple(rounds), record.finished, settled, round(block.gsd_m, 5), run.threshold_m,
        round(time.perf_counter() - started, 3), given.mapping, given.rebuild or "",
        shlex.join(compare), compared, tuple(notes),
    )  # fmt: skip
    write_summary(given, asdict(summary))
    return summary


@dataclass
class _Record:
    """What is kept of the rounds: what was asked, and what each has left."""

    path: Path
    content: dict[str, Any]
    finished: int
    start_cloud: str | None

    @classmethod
    def opened(cls, target: Path, given: PhotosOptions) -> _Record:
        """Return the record of a folder, a new one where there is none or it is replaced."""
        path = target / RECORD
        asked = {k: str(v) for k, v in given.as_dict().items() if k not in COMMAND_ONLY}
        files = [given.cameras, given.dsm, given.sensor, given.water]
        known = [Path(str(f)) for f in files if f is not None and Path(str(f)).exists()]
        states = [file_state(one) for one in known]
        new = {"pcfix": __version__, "asked": asked, "files": states}
        is_cloud = Path(given.dsm).suffix.lower() in (".las", ".laz")
        start = str(given.dsm) if is_cloud else None
        old = read_json(path) if path.exists() and not given.overwrite else None
        if old is None:
            for folder in target.glob("round[0-9]*"):
                if not given.overwrite:
                    raise SettingError(
                        f"{folder}: exists; add --overwrite, or give another folder."
                    )
                shutil.rmtree(folder)
            write_text(path, json_text(new | {"rounds": []}), overwrite=True)
            return cls(path, new | {"rounds": []}, 0, start)
        if {k: old.get(k) for k in new} != json.loads(json.dumps(new)):
            raise SettingError(
                f"{target}: holds the rounds of another call; add --overwrite to replace them, or"
                " give another folder."
            )
        whole = [one for one in old["rounds"] if "mean_m" in one]
        return cls(path, old, len(whole), start)

    def of(self, number: int) -> dict[str, Any]:
        """Return what a round has left so far."""
        rounds = self.content["rounds"]
        return dict(rounds[number - 1]) if number <= len(rounds) else {}

    def keep(self, number: int, left: dict[str, Any]) -> None:
        """Keep what a round has left."""
        self.content["rounds"][number - 1 :] = [left]
        write_text(self.path, json_text(self.content), overwrite=True)


def _with_raster(given: PhotosOptions, target: Path) -> PhotosOptions:
    """Return options whose DSM is a raster: that of a cloud stays in the folder."""
    if Path(given.dsm).suffix.lower() not in (".las", ".laz"):
        return given
    raster = target / "dsm.tif"
    fresh = raster.exists() and raster.stat().st_mtime_ns > Path(given.dsm).stat().st_mtime_ns
    if given.overwrite or not fresh:
        grid_dsm(given.dsm, raster, resolution=given.resolution, overwrite=True)
    return replace(given, dsm=raster, resolution=None)


@dataclass(frozen=True)
class _Run:
    """Photographs, where their rounds go, and how."""

    images: Path
    target: Path
    given: PhotosOptions
    block: Block
    progress: Progress | None

    @property
    def threshold_m(self) -> float:
        """How little the bed may move for the last time."""
        return round(self.given.until_gsd * self.block.gsd_m, 5)

    def all(
        self, record: _Record, say: Callable[[str], None]
    ) -> tuple[list[Round], list[str], bool]:
        """Return the rounds, notes on them, and whether the last one settled it."""
        rounds: list[Round] = []
        notes: list[str] = []
        before = Path(self.given.dsm)
        while len(rounds) < self.given.most_rounds:
            number = len(rounds) + 1
            one = self.round(number, before, record)
            rounds.append(one)
            before = Path(one.dsm)
            say(
                f"round {number}: the bed moved by {one.mean_m:+.3f} m (sd {one.sd_m:.3f} m),"
                f" {100 * one.within_gsd:.0f} % of it by less than a ground pixel"
            )
            if number == PAPER_ROUNDS and self.given.mapping == "paper":
                notes.append(self._paper_note())
                warnings.warn(notes[-1], PcfixWarning, stacklevel=3)
            if abs(one.mean_m) < self.threshold_m:
                return rounds, notes, True
        return rounds, notes, False

    def round(self, number: int, before: Path, record: _Record) -> Round:
        """Return a round, made anew where it was not finished."""
        folder = self.target / f"round{number}"
        cloud, dsm = folder / "cloud.laz", folder / "dsm.tif"
        left = record.of(number)
        made = cloud.exists() and left.get("state") == file_state(cloud)
        if made and "mean_m" in left and dsm.exists():
            return Round(**{name: left[name] for name in Round.__dataclass_fields__})
        record.finished = min(record.finished, number - 1)
        with warnings.catch_warnings():
            if number > 1:
                warnings.filterwarnings("ignore", NOT_SAID, PcfixWarning)
            if not made:
                self._photographs(folder / "images", before)
                self._cloud(number, folder / "images", cloud)
                record.keep(number, {"command": self.given.rebuild, "state": file_state(cloud)})
            cell = self.block.scene.ground.cell_m
            grid_dsm(cloud, dsm, resolution=cell, overwrite=True)
        one = self._difference(cloud, dsm, before)
        record.keep(number, {**record.of(number), **asdict(one)})
        return one

    def _photographs(self, folder: Path, before: Path) -> None:
        plain = RebuildOptions().as_dict()
        how = replace(self.given, dsm=before, resolution=None, summary=None, **plain)
        map_photos(self.images, folder, options=how, progress=self.progress)

    def _cloud(self, number: int, images: Path, cloud: Path) -> None:
        """Make the cloud, by a program of the user's or by stereo pairs."""
        if self.given.rebuild == "stereo":
            with threads(self.given.jobs):
                return self._stereo(images, cloud)
        cloud.unlink(missing_ok=True)
        places = {"images": images, "cameras": self.given.cameras, "cloud": cloud}
        words = shlex.split(self.given.rebuild or "")
        for name, place in places.items():
            words = [word.replace(f"{{{name}}}", str(Path(place).resolve())) for word in words]
        log = cloud.with_name("rebuild.log")
        code, last = run_logged(words, log)
        if code == 0 and cloud.exists():
            return None
        wrong = f"ended with code {code}" if code else f"left no {cloud}"
        raise InputError(
            f"--rebuild {wrong} in round {number}, and said: {' / '.join(last) or 'nothing'} (all"
            f" of it in {log}); mend it and call again, which goes on from {images}."
        )

    def _stereo(self, images: Path, cloud: Path) -> None:
        import cv2

        @lru_cache(maxsize=CACHED_PHOTOGRAPHS)
        def picture(row: int) -> Grey:
            pixels = read_colours(images / self.block.paths[row].name)
            blank = blank_in(pixels)
            grey = pixels[..., 0] if pixels.shape[2] < 3 else None
            if grey is None:
                grey = cv2.cvtColor(np.ascontiguousarray(pixels[..., :3]), cv2.COLOR_RGB2GRAY)
            if grey.dtype == np.uint16:
                grey = (grey >> 8).astype(np.uint8)
            return Grey(np.ascontiguousarray(grey), blank)

        ground = self.block.scene.ground
        side = STEREO_CELL_PIXELS * self.block.gsd_m
        xyz = stereo_cloud(self.block.photos, ground, side, picture, self.progress)
        write_points(cloud, xyz, (self.block.crs, STEREO_STEP_M))

    def _difference(self, cloud: Path, dsm: Path, before: Path) -> Round:
        """Return by how much the DSM of a round differs from that before, under water."""
        raster = dsm.with_name("difference.tif")
        write_dod(dsm, before, raster, overwrite=True)
        with open_raster(raster) as source, open_raster(dsm) as heights:
            moved, z, transform = read_masked(source), read_masked(heights), source.transform
        row, column = np.nonzero(np.isfinite(moved))
        x, y = place_of(transform, column + 0.5, row + 0.5)
        xyz = np.column_stack([x, y, z[row, column]])
        wet = np.zeros(moved.shape, bool)
        water = surface_above(self.block.scene.water, xyz).height_m
        wet[row, column] = np.nan_to_num(water - xyz[:, 2], nan=0.0) > 0.0
        return round_of((str(cloud), str(dsm)), moved, wet, self.block.gsd_m)

    def _paper_note(self) -> str:
        index = self.block.scene.refractive_index
        return (
            "--mapping paper tends to the apparent depth over 2 - n, not to n times it: with n ="
            f" {index:g} the bed ends up to {100 * paper_excess(index):.0f} % of its depth too"
            " deep; correct the cloud and take --mapping exact for the true one."
        )


def _others(rounds: list[Round], start: str | None) -> dict[str, str]:
    """Return the clouds but for the last, by names for tables and sections."""
    named = {f"round{k}": one.cloud for k, one in enumerate(rounds[:-1], start=1)}
    return ({} if start is None else {"round0": start}) | named


def _compare_words(
    rounds: list[Round], start: str | None, given: PhotosOptions, target: Path
) -> list[str]:
    """Return the command that gives Figs 16, 18 and 20; the first cloud as reference 15 and 17."""
    reference = "REFERENCE" if given.reference is None else str(given.reference)
    words = ["pcfix", "compare", rounds[-1].cloud, reference, "--water", str(given.water)]
    words += ["--submerged", "--out-dir", str(target / "compare")]
    for name, cloud in _others(rounds, start).items():
        words += ["--also", f"{name}={cloud}"]
    return words


def _compared(
    rounds: list[Round], start: str | None, given: PhotosOptions, target: Path
) -> str | None:
    """Compare the clouds with a reference, where one was named; a failure loses no round."""
    if given.reference is None:
        return None
    folder = target / "compare"
    try:
        compare_clouds(
            rounds[-1].cloud, given.reference, water=given.water, submerged=True, out_dir=folder,
            also=_others(rounds, start), overwrite=True,
        )  # fmt: skip
    except PcfixError as error:
        warnings.warn(f"the rounds are done, but {error}", PcfixWarning, stacklevel=3)
        return None
    return str(folder)

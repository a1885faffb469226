"""The folder of a run: its inputs, the files that it writes, and the record of its steps."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any

from pcfix.errors import PcfixWarning, bad_file
from pcfix.flow.adjust import FOLDER
from pcfix.flow.inputs import Inputs, paths_in, read_blocks
from pcfix.flow.runner import HOW, json_text
from pcfix.flow.surfaces import view_of
from pcfix.io.clouds import is_cloud, own_water, reference_of
from pcfix.io.files import belonging, file_state, files_in, read_json, refusing, write_text
from pcfix.io.rasters import open_raster
from pcfix.io.tiles import (
    CloudFiles,
    Tiles,
    band_of,
    cloud_of,
    inputs_of,
    open_cloud,
    tiles_from,
    tiles_of,
)
from pcfix.model import Cameras, WaterSurface
from pcfix.options.correct import RunOptions
from pcfix.options.declare import options_of
from pcfix.options.steps import DistanceOptions
from pcfix.version import __version__

RECORD, SURFACE = "run.json", "surface.tif"
STEPS = ("adjust", "correct", "clean", "dsm", "compare", "map", "report")
"""The steps in order; each depends on those before it."""
LATER = {
    **{one.name: "compare" for one in options_of(DistanceOptions)},
    "reference": "compare", "resolution": "dsm", "project": "report", "date": "report",
}  # fmt: skip
"""The first step that depends on an option, for options that do not affect all steps."""


@dataclass(frozen=True)
class RunFolder:
    """A run: its folder, its cloud (for many files see `tiles_of`), and its options."""

    folder: Path
    input: str | tuple[str, ...]
    options: RunOptions

    @cached_property
    def source(self) -> CloudFiles:
        """The cloud, in one file or many, or the cells of a raster."""
        return tiles_of(self.input) or band_of(Path(str(self.input)), self.options)

    @cached_property
    def reference(self) -> Path | Tiles:
        """The reference, in one file or many."""
        return reference_of(self.options.reference or "")

    @property
    def has_surface(self) -> bool:
        """Whether the reference is a surface, not check points."""
        suffix = Path(str(self.options.reference)).suffix.lower()
        return is_cloud(self.reference) or suffix in (".tif", ".tiff")

    def with_adjusted(self, step: dict[str, Any]) -> RunFolder:
        """Return the run for the next steps, with the adjusted cameras if there are any."""
        if step["model"] is None:
            return self
        cameras = str(self.folder / FOLDER / step["model"])
        options = replace(
            self.options, cameras=cameras, adjusted_from=self.options.cameras,
            adjust="no", gcps=None, gnss=None, lens=None,
        )  # fmt: skip
        return replace(self, options=options)

    def files(self) -> dict[str, list[Path]]:
        """Return the input files by the first step that reads them; each exists."""
        found = [*_files_of(self.source), *(one for path in self._named for one in files_in(path))]
        found += [Path(self.options.water)] if Path(self.options.water).is_file() else []
        compared = [] if self.options.reference is None else _files_of(self.reference)
        compared += [path for _, one in self.options.also for path in _files_of(cloud_of(one))]
        return {"adjust": found, "compare": compared}

    @property
    def _named(self) -> list[Path]:
        """The files of the first step, except cloud and water."""
        return paths_in(self.options, but=("water", "reference"))

    def settings(self) -> dict[str, Any]:
        """Return plain values of all that the results depend on, besides the files."""
        values = {name: one for name, one in self.options.as_dict().items() if name not in HOW}
        return {"input": self.input, **values, "pcfix": __version__}

    def keys(self) -> dict[str, str]:
        """Return a hash for each step, of its options, its input files and the step before it."""
        settings, files, results = self.settings(), self.files(), self.folder.resolve()
        # files that are read with a named one, such as sensor.csv, may appear later
        read_too = {one for path in self._named for one in belonging(path)}
        files["adjust"] += sorted(one for one in read_too if results not in one.resolve().parents)
        keys, key = dict[str, str](), ""
        for step in STEPS:
            options = sorted(one for one in settings.items() if LATER.get(one[0], "adjust") == step)
            states = [file_state(one) for one in files.get(step, [])]
            key = keys[step] = sha256(json.dumps([key, options, states]).encode()).hexdigest()
        return keys

    # Results

    def cloud_files(self, name: str) -> list[Path]:
        """Return the files of a cloud of the run: one, or as many as the input has."""
        path, tiles = self.path_of(name), self.source
        return [path / one.name for one in tiles.paths] if isinstance(tiles, Tiles) else [path]

    def path_of(self, name: str) -> Path:
        """Return the path of the cloud corrected or cleaned, a folder for many files."""
        return self.folder / (name if isinstance(self.source, Tiles) else f"{name}.laz")

    def cloud(self, name: str) -> Path | Tiles:
        """Return the cloud corrected or cleaned, which must exist."""
        path, files = self.path_of(name), self.cloud_files(name)
        with _shown_before():
            return tiles_from(str(path), files) if isinstance(self.source, Tiles) else path

    @property
    def resolution_m(self) -> float:
        """Cell size of the rasters; they must exist."""
        with open_raster(self.folder / SURFACE) as dsm:
            return float(dsm.res[0])

    @property
    def inputs(self) -> Inputs:
        """The inputs of the correction, without the view list."""
        return replace(self.options, views=None).part(Inputs)

    @cached_property
    def cameras(self) -> Cameras:
        """The cameras in the CRS of the cloud."""
        with _shown_before():
            return read_blocks(self.inputs, view_of(self.cloud("corrected"))).cameras

    @cached_property
    def water(self) -> WaterSurface:
        """The water surface: as recorded in the corrected cloud, else as requested."""
        with _shown_before():
            cloud = self.cloud("corrected")
            with open_cloud(cloud) as source:
                stated = own_water(source)
            return stated or self.inputs.surface(view_of(cloud)).surface


def _files_of(cloud: CloudFiles) -> list[Path]:
    return files_in(cloud) if isinstance(cloud, Path) else inputs_of(cloud)


def _shown_before() -> AbstractContextManager[Any]:
    """Ignore warnings that were shown when the cloud was corrected."""
    return warnings.catch_warnings(action="ignore", category=PcfixWarning)


class Record:
    """The file run.json: the options of a run, and the steps that are done.

    A step is skipped if an earlier run did it with the same key (see `RunFolder.keys`), its outputs
    have not changed, and no step before it is done again. The file is written after each step.
    """

    def __init__(self, run: RunFolder) -> None:
        self._path, self._keys = run.folder / RECORD, run.keys()
        self._content: dict[str, Any] = {"options": run.settings(), "steps": {}}
        self._earlier = read_steps(self._path) if self._path.exists() else {}
        self.resumes = self._has(STEPS[0])
        """Whether there is an earlier run whose corrected cloud remains valid."""

    def _has(self, step: str) -> bool:
        return bool(self._earlier.get(step, {}).get("key") == self._keys[step])

    def step(self, name: str, outputs: Sequence[Path], work: Callable[[], Any]) -> tuple[Any, bool]:
        """Do a step, or skip it; return its result and whether it was skipped.

        `outputs` are all files that `work` writes. `work` returns what later steps need, in the
        types of JSON.
        """
        done = self._earlier.get(name, {})
        was_done = self._has(name) and done["outputs"] == [file_state(one) for one in outputs]
        if not was_done:
            self._earlier = {}  # later steps must be done again
            result = json.loads(json.dumps(work()))
            states = [file_state(one) for one in outputs]
            done = {"key": self._keys[name], "outputs": states, "result": result}
        self._content["steps"][name] = done
        write_text(self._path, json_text(self._content), overwrite=True)
        return done["result"], was_done


def read_steps(path: Path) -> dict[str, Any]:
    """Return the steps of a record by name."""
    sentence = "is not the record of a run ({}). Remove it, or give another folder."
    with refusing(path, "run.record", sentence):
        steps: dict[str, Any] = read_json(path)["steps"]
        _ = [(one["key"], one["outputs"], one["result"]) for one in steps.values()]
    return steps


def finished_steps(folder: Path) -> dict[str, Any]:
    """Return the result of each step of a finished run by name."""
    path = folder / RECORD
    if not path.is_file():
        raise bad_file(path, "run.no_file", "the run has not written it.")
    steps = read_steps(path)
    if STEPS[-1] not in steps:
        raise bad_file(
            folder, "run.unfinished", "the run did not finish. Run it again; it resumes."
        )
    return {name: step["result"] for name, step in steps.items()}

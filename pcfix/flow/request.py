"""The request of a run, the files that it reads and writes, and the record of its steps."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any

from pcfix.errors import PcfixWarning, SettingError, bad_file
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
from pcfix.options.declare import named, options_of
from pcfix.options.steps import DistanceOptions
from pcfix.version import __version__
from pcfix.water.index import with_index

SURFACE = "surface.tif"
STEPS = ("adjust", "correct", "clean", "dsm", "compare", "map", "report")
"""The steps in order; each depends on those before it."""


class Request(RunOptions):
    """Everything that the results of a run depend on; ``run.json`` records it."""

    input: str | tuple[str, ...] = ""
    """The cloud; for many files see `tiles_of`."""

    @cached_property
    def source(self) -> CloudFiles:
        """The cloud, in one file or many, or the cells of a raster."""
        return tiles_of(self.input) or band_of(Path(str(self.input)), self)

    @cached_property
    def surveyed(self) -> Path | Tiles:
        """The reference, in one file or many."""
        return reference_of(self.reference or "")

    @property
    def has_surface(self) -> bool:
        """Whether the reference is a surface, not check points."""
        suffix = Path(str(self.reference)).suffix.lower()
        return is_cloud(self.surveyed) or suffix in (".tif", ".tiff")

    def check(self) -> None:
        """Raise SettingError for options that exclude each other."""
        wrong = ""
        if self.adjust == "no" and self.only_to_adjust:
            wrong = f"{self.only_to_adjust[0]} is for an adjustment only. Remove it, or use auto."
        elif self.adjust == "yes" and self.why_not_adjust:
            wrong = f"{self.why_not_adjust}. Remove one of the two options."
        if wrong:
            wrong = f"--adjust {self.adjust}: {wrong}"
            raise SettingError("option.conflict", wrong, option="adjust", value=self.adjust)
        if self.water is None:
            raise SettingError("water.missing", "water is missing: give the water surface.")
        with_index(self.part(RunOptions))

    @property
    def only_to_adjust(self) -> list[str]:
        """The given options that only an adjustment uses."""
        return [name for name in ("gcps", "gnss", "lens") if getattr(self, name) is not None]

    @property
    def why_not_adjust(self) -> str:
        """Why an adjustment is impossible with the other options; empty if it is possible."""
        if self.cameras is None:
            return "there are no cameras to adjust"
        if self.adjusted_from is not None:
            return "with adjusted-from the cameras are adjusted already"
        if self.tide is not None:
            return "a tide gives each image its own water level, and an adjustment has one"
        return ""

    def with_adjusted(self, folder: Path, step: dict[str, Any]) -> Request:
        """Return the request for the next steps, with the adjusted cameras if there are any."""
        if step["model"] is None:
            return self
        return replace(
            self,
            cameras=str(folder / FOLDER / step["model"]),
            adjusted_from=self.cameras,
            adjust="no", gcps=None, gnss=None, lens=None,
        )  # fmt: skip

    def record(self) -> dict[str, Any]:
        """Return plain values of the options that the results depend on."""
        values = {name: value for name, value in self.as_dict().items() if name not in HOW}
        return {**values, "pcfix": __version__}

    def files(self) -> dict[str, list[Path]]:
        """Return the input files by the first step that reads them; each exists."""
        found = [*_files_of(self.source), *(one for path in self._named for one in files_in(path))]
        found += [Path(self.water)] if Path(self.water).is_file() else []
        compared = [] if self.reference is None else _files_of(self.surveyed)
        compared += [path for _, one in self.also for path in _files_of(cloud_of(one))]
        return {"adjust": found, "compare": compared}

    def watched(self, results: Path) -> dict[str, list[Path]]:
        """Return the input files and the files that belong to them, except those in the results."""
        read, own = self.files(), results.resolve()
        more = {one for path in self._named for one in belonging(path)}
        outside = sorted(one for one in more if own not in one.resolve().parents)
        return {**read, "adjust": list(dict.fromkeys([*read["adjust"], *outside]))}

    @property
    def _named(self) -> list[Path]:
        """The files of the first step, except cloud and water."""
        return paths_in(self, but=("water", "reference"))


def _files_of(cloud: CloudFiles) -> list[Path]:
    return files_in(cloud) if isinstance(cloud, Path) else inputs_of(cloud)


LATER = {
    **{one.name: "compare" for one in options_of(DistanceOptions)},
    "reference": "compare", "resolution": "dsm", "project": "report", "date": "report",
}  # fmt: skip
"""The first step that depends on an option, for options that do not affect all steps."""


class Record:
    """The file run.json: the request, its input files, and the steps that are done.

    Each step has a key: a hash of its options, its input files and the key of the step before it.
    A step is skipped if the record has it with the same key, its outputs have not changed, and no
    earlier step was done again. The file is written after each step.

    `request` has all options that the results depend on, and `inputs` the input files by the first
    step that reads them.
    """

    def __init__(
        self, path: Path, request: dict[str, Any], inputs: Mapping[str, Sequence[Path]]
    ) -> None:
        self._path = path
        states = {step: [file_state(one) for one in some] for step, some in inputs.items()}
        self._content: dict[str, Any] = {"request": request, "inputs": states, "steps": {}}
        self._keys: dict[str, str] = {}
        key = ""
        # A chain: the key of a step changes with those of all steps before it.
        for step in STEPS:
            options = [one for one in request.items() if LATER.get(one[0], STEPS[0]) == step]
            depends = json.dumps([key, sorted(options), states.get(step)])
            key = self._keys[step] = sha256(depends.encode()).hexdigest()
        earlier = read_record(path) if path.exists() else {"request": request, "steps": {}}
        self._earlier: dict[str, Any] = earlier["steps"]
        self.resumes = self._has(STEPS[0])
        """Whether there is an earlier run whose corrected cloud remains valid."""
        plain = json.loads(json.dumps(request))
        self.changed = [one for one in plain if plain[one] != earlier["request"].get(one)]
        """The options that had other values in the earlier run."""

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


def read_record(path: Path) -> dict[str, Any]:
    """Return the content of a record."""
    with refusing(path, "run.record", _NO_RECORD):
        content: dict[str, Any] = read_json(path)
        _ = content["request"], content["inputs"], content["steps"]
    return content


_NO_RECORD = "is not the record of a run ({}). Give the run.json of an earlier run, or remove it."


def request_of(record: Path) -> Request:
    """Return the request of an earlier run from its ``run.json``."""
    asked = {**read_record(record)["request"]}
    input = asked.pop("input", "")
    for name in ("index_from", "pcfix"):
        asked.pop(name, None)
    try:
        values = named(asked, options_of(RunOptions), str(record))
        return Request(input=tuple(input) if isinstance(input, list) else input, **values)
    except (SettingError, TypeError) as error:
        raise bad_file(record, "run.record", _NO_RECORD.replace("{}", str(error))) from error


class RunFolder:
    """The folder of a run: its request and the files that it writes."""

    def __init__(self, folder: Path, request: Request) -> None:
        self.folder, self.request = folder, request
        tiles = request.source
        self._tiles = [one.name for one in tiles.paths] if isinstance(tiles, Tiles) else None
        ending = ".laz" if self._tiles is None else ""
        self.corrected, self.cleaned = folder / f"corrected{ending}", folder / f"cleaned{ending}"
        self.compare = folder / "compare"
        self.regression, self.dod = folder / "regression.json", self.compare / "dod.tif"

    def files_of(self, cloud: Path) -> list[Path]:
        """Return the files of a cloud in the folder: one, or as many as the input has."""
        return [cloud] if self._tiles is None else [cloud / name for name in self._tiles]

    @cached_property
    def corrected_cloud(self) -> Path | Tiles:
        """The corrected cloud; it must exist."""
        return self._cloud(self.corrected)

    @cached_property
    def cleaned_cloud(self) -> Path | Tiles:
        """The cleaned cloud; it must exist."""
        return self._cloud(self.cleaned)

    def _cloud(self, path: Path) -> Path | Tiles:
        with _shown_before():
            return path if self._tiles is None else tiles_from(str(path), self.files_of(path))

    @property
    def resolution_m(self) -> float:
        """Cell size of the rasters; they must exist."""
        with open_raster(self.folder / SURFACE) as dsm:
            return float(dsm.res[0])

    @property
    def inputs(self) -> Inputs:
        """The inputs of the correction, without the view list."""
        return replace(self.request, views=None).part(Inputs)

    @cached_property
    def cameras(self) -> Cameras:
        """The cameras in the CRS of the cloud."""
        with _shown_before():
            return read_blocks(self.inputs, view_of(self.corrected_cloud).crs).cameras

    @cached_property
    def water(self) -> WaterSurface:
        """The water surface: as recorded in the corrected cloud, else as requested."""
        with _shown_before():
            with open_cloud(self.corrected_cloud) as source:
                stated = own_water(source)
            return stated or self.inputs.surface(view_of(self.corrected_cloud)).surface


def _shown_before() -> AbstractContextManager[Any]:
    """Ignore warnings that were shown when the cloud was corrected."""
    return warnings.catch_warnings(action="ignore", category=PcfixWarning)

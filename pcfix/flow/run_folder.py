"""The folder of a run: its inputs, the files that it writes, and the record of its steps."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any

from pcfix.errors import SettingError, silently
from pcfix.flow.adjust import FOLDER
from pcfix.flow.inputs import Inputs, paths_in, read_blocks
from pcfix.flow.runner import HOW, Bar, Progress, json_text, no_bar
from pcfix.flow.surfaces import view_of
from pcfix.io.clouds import (
    CloudFiles,
    Tiles,
    band_of,
    cloud_of,
    inputs_of,
    is_cloud,
    open_cloud,
    own_water,
    reference_of,
    tiles_from,
)
from pcfix.io.files import (
    belonging,
    check_input,
    file_state,
    files_in,
    read_json,
    refusing,
    write_text,
)
from pcfix.model import Cameras, WaterSurface
from pcfix.options.correct import RunOptions
from pcfix.options.declare import options_of
from pcfix.options.steps import DistanceOptions
from pcfix.report.text import Plain
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
        return band_of(cloud_of(self.input), self.options)

    @cached_property
    def reference(self) -> Path | Tiles:
        """The reference, in one file or many."""
        return reference_of(self.options.reference or "")

    @property
    def has_surface(self) -> bool:
        """Whether the reference is a surface, not check points."""
        suffix = Path(str(self.options.reference)).suffix.lower()
        return is_cloud(self.reference) or suffix in (".tif", ".tiff")

    def with_adjusted(self, model: str | None) -> RunFolder:
        """Return the run for the next steps, with the adjusted cameras if there are any."""
        if model is None:
            return self
        options = replace(
            self.options, cameras=str(self.folder / FOLDER / model),
            adjusted_from=self.options.cameras, adjust="no", gcps=None, gnss=None, lens=None,
        )  # fmt: skip
        return replace(self, options=options)

    @cached_property
    def files(self) -> dict[str, list[Path]]:
        """The input files by the first step that reads them; each exists."""
        water = Path(self.options.water)
        first = [check_input(one) for one in inputs_of(self.source)]
        first += [one for path in self._named for one in files_in(path)]
        first += [water] if water.is_file() else []
        compared = [] if self.options.reference is None else [self.reference]
        compared += [cloud_of(path) for _, path in self.options.also]
        later = [check_input(path) for cloud in compared for path in inputs_of(cloud)]
        return {"adjust": first, "compare": later}

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
        settings, results = self.settings(), self.folder.resolve()
        # files that are read with a named one, such as sensor.csv, may appear later
        more = {one for path in self._named for one in belonging(path)}
        more = {one for one in more if results not in one.resolve().parents}
        files = {**self.files, "adjust": [*self.files["adjust"], *sorted(more)]}
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
        with silently():  # this and other warnings were shown when the cloud was corrected
            return tiles_from(str(path), files) if isinstance(self.source, Tiles) else path

    @cached_property
    def cameras(self) -> Cameras:
        """The cameras in the CRS of the cloud."""
        inputs = replace(self.options, views=None).part(Inputs)
        with silently():
            return read_blocks(inputs, view_of(self.cloud("corrected"))).cameras

    @cached_property
    def water(self) -> WaterSurface:
        """The water surface: as recorded in the corrected cloud, else as requested."""
        cloud = self.cloud("corrected")
        with silently(), open_cloud(cloud) as source:
            stated = own_water(source)
            return stated or self.options.part(Inputs).surface(view_of(cloud)).surface


class Record:
    """The file run.json: the options of a run, and the steps that are done.

    A step is skipped if an earlier run did it with the same key (see `RunFolder.keys`), its outputs
    have not changed, and no step before it is done again. The file is written after each step.
    """

    def __init__(self, run: RunFolder, say: Callable[[str], None], bar: Bar = no_bar) -> None:
        """Make the folder, or refuse one of another run.

        `say` is called with a line on each step, and `bar` shows the progress of one.
        """
        folder = run.folder
        if not folder.parent.is_dir():
            sentence = f"{folder}: the folder {folder.parent} does not exist. Create it first."
            raise SettingError("output.no_folder", sentence, path=folder)
        folder.mkdir(exist_ok=True)
        self._path, self._keys, self._say, self._bar = folder / RECORD, run.keys(), say, bar
        self._content: dict[str, Any] = {"options": run.settings(), "steps": {}}
        self._earlier = read_steps(self._path) if self._path.exists() else {}
        resumes = self._has(STEPS[0])
        if not (run.options.overwrite or resumes) and any(folder.iterdir()):
            sentence = f"{folder}: holds a run with other options or input files, or other files."
            sentence += " Add --overwrite to replace them, or give another folder."
            raise SettingError("run.other", sentence, path=folder)

    def _has(self, step: str) -> bool:
        return bool(self._earlier.get(step, {}).get("key") == self._keys[step])

    def step(
        self, name: str, title: str, outputs: Sequence[Path],
        work: Callable[[Progress | None], Plain | None], text: str = "{main}",
        main: Path | None = None,
    ) -> Plain:  # fmt: skip
        """Do a step unless it is done, and return its result.

        `outputs` are all files that `work` writes, and `main` is shown to the user, by default the
        first; with the `text`, in which values of the result have their names. The result has what
        later steps need, in the types of JSON.
        """
        done, how = self._earlier.get(name, {}), "already done"
        if not self._has(name) or done["outputs"] != [file_state(one) for one in outputs]:
            self._earlier, how = {}, "done"  # later steps must be done again
            with self._bar(title) as progress:
                found = json.loads(json.dumps(work(progress)))
            states = [file_state(one) for one in outputs]
            done = {"key": self._keys[name], "outputs": states, "result": found}
        self._content["steps"][name] = done
        write_text(self._path, json_text(self._content), overwrite=True)
        result: Plain = done["result"] or {}
        if name != "adjust" or result["model"] is not None:
            words = text.format(main=main or outputs[0], **result)
            self._say(f"{name:<9} {how}: {words}")
        return result


def read_steps(path: Path) -> dict[str, Any]:
    """Return the steps of a record by name."""
    sentence = "is not the record of a run ({}). Remove it, or give another folder."
    with refusing(path, "run.record", sentence):
        steps: dict[str, Any] = read_json(path)["steps"]
        _ = [(one["key"], one["outputs"], one["result"]) for one in steps.values()]
    return steps

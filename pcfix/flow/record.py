"""The file run.json: what a run was asked for, and which of its steps are done."""

from __future__ import annotations

import glob
import json
from collections.abc import Callable, Mapping, Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any

from pcfix.errors import InputError
from pcfix.flow.runner import json_text
from pcfix.io.files import file_state, files_around, read_json, write_text
from pcfix.options.declare import File

VERSION = "pcfix"
"""Of a request: which version of pcfix did it."""
STEPS = ("adjust", "correct", "clean", "dsm", "compare", "map", "report")
"""In their order; each depends on those before it."""


class Record:
    """What was asked for, from which files, and which steps are done.

    Each step has a key: a hash of its options, its input files and the key of the step before it.
    A step is done if the record has it with the same key, its outputs are as it left them, and no
    step before it had to be done. The JSON file at `path` is written after each step.

    Parameters
    ----------
    path : Path
    request : dict
        Everything that the results depend on.
    inputs : dict
        Input files, by the first step that reads them.
    since : callable
        Returns the first step that an option of the request matters to.
    """

    def __init__(
        self,
        path: Path,
        request: dict[str, Any],
        inputs: Mapping[str, Sequence[Path]],
        since: Callable[[str], str],
    ) -> None:
        self._path = path
        states = {step: [file_state(one) for one in some] for step, some in inputs.items()}
        self._content: dict[str, Any] = {
            "request": request,
            "inputs": [{**one, "step": step} for step, some in states.items() for one in some],
            "steps": {},
        }
        self._keys: dict[str, str] = {}
        key = ""
        # A chain: the key of a step changes with those of all steps before it.
        for step in STEPS:
            options = {name: value for name, value in request.items() if since(name) == step}
            depends = json.dumps([key, options, states.get(step)], sort_keys=True)
            key = self._keys[step] = sha256(depends.encode()).hexdigest()
        earlier = read_record(path) if path.exists() else {"request": request, "steps": {}}
        self._earlier: dict[str, Any] = earlier["steps"]
        self.resumes = self._has("correct" if "correct" in self._earlier else "adjust")
        """Whether there is an earlier run whose corrected cloud is not replaced."""
        plain = json.loads(json.dumps(request))
        self.changed = [one for one in plain if plain[one] != earlier["request"].get(one)]
        """The options that the earlier run had otherwise."""

    def _has(self, step: str) -> bool:
        return bool(self._earlier.get(step, {}).get("key") == self._keys[step])

    def step(self, name: str, outputs: Sequence[Path], work: Callable[[], Any]) -> tuple[Any, bool]:
        """Do a step unless it is done; return its result and whether it was done.

        `outputs` are all files that `work` leaves; it returns what later steps need, as JSON can
        hold it.
        """
        was_done = self._has(name) and self._earlier[name]["outputs"] == list(
            map(file_state, outputs)
        )
        if was_done:
            done = self._earlier[name]
        else:
            self._earlier = {}  # the later steps read other files now
            result = json.loads(json.dumps(work()))
            done = {
                "key": self._keys[name],
                "outputs": [file_state(one) for one in outputs],
                "result": result,
            }
        self._content["steps"][name] = done
        write_text(self._path, json_text(self._content), overwrite=True)
        return done["result"], was_done


def read_record(path: Path) -> dict[str, Any]:
    """Return the content of a record."""
    try:
        content: dict[str, Any] = read_json(path)
        _ = content["request"], content["inputs"], content["steps"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            "run.record",
            f"{path}: is not the record of a run ({error}). Give the run.json of an earlier run, or"
            " remove it.",
            path=path,
        ) from error
    return content


def belonging(path: File) -> list[Path]:
    """Return a file or folder with what may be read with it: files of the same stem, and others.

    The others are a sensor.csv beside it, all files of a folder, and the folder of a project.
    """
    found = files_around(path)
    alike = (
        [] if Path(path).is_dir() else Path(path).parent.glob(f"{glob.escape(Path(path).stem)}.*")
    )
    return sorted({*found, *(one for one in alike if one.is_file())})

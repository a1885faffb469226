"""What a run was asked for and which of its steps are done, in a file, so that it can go on."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from pcfix.errors import InputError
from pcfix.flow.runner import json_text
from pcfix.io.files import file_state, read_json, write_text


class Record:
    """What was asked for, from which files, and which steps are done.

    A step counts as done while the request and the input files are those of the record, every
    step before it was found done, and its own files are as it left them. The JSON file at `path`
    is written after each step; the request has everything that the results depend on.
    """

    def __init__(self, path: Path, request: dict[str, Any], inputs: Sequence[Path]) -> None:
        self._path = path
        self._content: dict[str, Any] = {
            "request": request,
            "inputs": [file_state(p) for p in inputs],
            "steps": {},
        }
        self._earlier = self._read()

    @property
    def resumes(self) -> bool:
        """Whether there is an earlier run that was asked for the same."""
        return bool(self._earlier)

    def _read(self) -> dict[str, Any]:
        """Return the steps of an earlier run that was asked for the same."""
        if not self._path.exists():
            return {}
        earlier = read_record(self._path)
        plain = json.loads(json.dumps(self._content))
        same = all(earlier.get(key) == plain[key] for key in ("request", "inputs"))
        steps: dict[str, Any] = earlier["steps"] if same else {}
        return steps

    def step(self, name: str, outputs: Sequence[Path], work: Callable[[], Any]) -> tuple[Any, bool]:
        """Do a step unless it is done; return its result and whether it was done.

        `outputs` are all files that `work` leaves; it returns what later steps need, as JSON can
        hold it.
        """
        earlier = self._earlier.get(name)
        if earlier is not None and earlier["outputs"] == [file_state(p) for p in outputs]:
            self._note(name, earlier)
            return earlier["result"], True
        self._earlier = {}  # what follows was made from other files
        result = work()
        self._note(name, {"outputs": [file_state(p) for p in outputs], "result": result})
        return json.loads(json.dumps(result)), False

    def _note(self, name: str, step: dict[str, Any]) -> None:
        self._content["steps"][name] = step
        write_text(self._path, json_text(self._content), overwrite=True)


def read_record(path: Path) -> dict[str, Any]:
    """Return the content of a record.

    Raises
    ------
    InputError
        If the file is none.
    """
    try:
        content: dict[str, Any] = read_json(path)
        _ = content["request"], content["inputs"], content["steps"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path}: is not the record of a run ({error}); give the run.json of an earlier run,"
            " or remove it."
        ) from error
    return content

"""What a run was asked for and which of its steps are done, in a file, so that it can go on."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pcfix.errors import InputError
from pcfix.flow.runner import json_text
from pcfix.io.files import file_state, read_json, write_text
from pcfix.io.opened import files_opened, of_inputs

VERSION = "pcfix"
"""Of a request: which version of pcfix did it."""
STEPS = ("adjust", "correct", "clean", "dsm", "compare", "map", "report")
"""In their order; each depends on those before it."""


class Record:
    """What was asked for, from which files, and which steps are done.

    A step counts as done while the request and the input files are those of the record, but for
    what matters to later steps only, every step before it was found done, and its own files are as
    it left them; files that it opened beside the inputs count as these do. The JSON file at `path`
    is written after each step.

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
        self._path, self._since = path, since
        states = [{**file_state(p), "step": step} for step, some in inputs.items() for p in some]
        self._content: dict[str, Any] = {"request": request, "inputs": states, "steps": {}}
        self._earlier: dict[str, Any] = {}
        self.changed: list[str] = []
        """What an earlier run was asked otherwise: options, or else files."""
        self.first: str | None = None
        """The first step of an earlier run that is not kept for that."""
        self.resumes = path.exists() and self._kept(read_record(path))
        """Whether there is an earlier run whose corrected cloud is not replaced."""

    def _kept(self, earlier: dict[str, Any]) -> bool:
        """Keep the steps of an earlier run that nothing changed for."""
        plain = json.loads(json.dumps(self._content))
        now, then = plain["request"], earlier["request"]
        names = [one for one in {**now, **then} if now.get(one) != then.get(one)]
        both = [*plain["inputs"], *earlier["inputs"]]
        files = [one for one in both if both.count(one) == 1]
        files += [
            {**one, "step": step}
            for step, done in earlier["steps"].items()
            for one in done.get("read", ())
            if file_state(Path(one["path"])) != one
        ]
        self.changed = [
            "version of pcfix" if name == VERSION else f"--{name.replace('_', '-')}"
            for name in names
        ]
        self.changed = self.changed or list(dict.fromkeys(Path(one["path"]).name for one in files))
        firsts = [*map(self._since, names), *(one.get("step", STEPS[0]) for one in files)]
        self.first = min(firsts, key=STEPS.index, default=None)
        kept = STEPS[: STEPS.index(self.first)] if self.first else STEPS
        self._earlier = {step: done for step, done in earlier["steps"].items() if step in kept}
        return "correct" in kept and bool(self._earlier)

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
        with files_opened() as opened:
            result = work()
        inputs = [Path(one["path"]) for one in self._content["inputs"]]
        known = {path.resolve() for path in inputs}
        read = of_inputs(opened, inputs, self._path.parent)
        self._note(name, {
            "outputs": [file_state(p) for p in outputs],
            "read": [file_state(p) for p in read if p.resolve() not in known],
            "result": result,
        })  # fmt: skip
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

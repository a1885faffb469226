"""One step over a file: open, check, read in chunks, write beside the target, rename."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from pcfix.io.files import check_input, check_output, write_text
from pcfix.io.las.source import LasSource
from pcfix.io.las.writing import LasSink, check_suffix, corrected_identity, output_evlrs
from pcfix.options.declare import File

if TYPE_CHECKING:
    import laspy

Progress = Callable[[int, int], None]


class Step(Protocol):
    """What happens to the points of a file."""

    def header(self, source: LasSource) -> laspy.LasHeader:
        """Return the header of the output, and be ready for the first chunk."""

    def chunk(
        self, points: laspy.ScaleAwarePointRecord, source: LasSource, header: laspy.LasHeader
    ) -> laspy.ScaleAwarePointRecord:
        """Return what becomes of some points."""

    def finish(self) -> None:
        """Refuse a result that cannot be right; nothing is left behind then."""


@dataclass(frozen=True)
class FileTask:
    """A cloud to read, a cloud to write, and how.

    Attributes
    ----------
    source, target : Path
    summary : path or None
        Where the summary goes, as JSON.
    overwrite : bool
    jobs : int or None
    progress : callable or None
        Called with (points done, points in all) after each chunk.
    started : float
        `time.perf_counter` then.
    """

    source: Path
    target: Path
    summary: File | None = None
    overwrite: bool = False
    jobs: int | None = None
    progress: Progress | None = None
    started: float = field(default_factory=time.perf_counter)

    @property
    def seconds(self) -> float:
        """How long it has taken so far."""
        return time.perf_counter() - self.started

    def run(self, step: Step) -> None:
        """Take every chunk through a step; the target appears when all went well."""
        with LasSource(self.source, self.jobs) as source:
            header = step.header(source)
            identity = getattr(step, "identity", None) or corrected_identity(source)
            with LasSink(self.target, header, output_evlrs(source), identity, self.jobs) as sink:
                done = 0
                for points in source.chunks():
                    count = len(points)
                    sink.write(step.chunk(points, source, header))
                    done += count
                    if self.progress is not None:
                        self.progress(done, len(source))
                step.finish()

    def tell(self, summary: dict[str, Any]) -> None:
        """Write the summary, where one is wanted."""
        write_summary(self, summary)


def write_summary(options: Any, summary: dict[str, Any]) -> None:
    """Write a summary as JSON where the options, with overwrite, name a file for it."""
    if options.summary is not None:
        text = json.dumps(summary, indent=2) + "\n"
        write_text(options.summary, text, overwrite=options.overwrite)


def file_task(
    input: File,
    output: File,
    options: Any,
    *,
    reads: Iterable[Any] = (),
    progress: Progress | None = None,
) -> FileTask:
    """Return the task of a command, once its files may be read and written.

    Parameters
    ----------
    input, output : path
    options : OptionSet
        With overwrite, and where the command has them summary and jobs.
    reads : iterable
        What else is read; values that are no paths do not count.
    progress : callable, optional

    Raises
    ------
    PcfixError
        If a file is missing, or would be replaced.
    """
    started = time.perf_counter()
    source = check_input(input)
    given = [one for one in (input, *reads) if isinstance(one, str | PathLike)]
    target = check_output(output, overwrite=options.overwrite, inputs=given)
    check_suffix(target)
    summary = getattr(options, "summary", None)
    if summary is not None:
        check_output(summary, overwrite=options.overwrite, inputs=[*given, target])
    return FileTask(source, target, summary, options.overwrite, options.jobs, progress, started)

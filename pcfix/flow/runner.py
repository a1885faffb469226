"""The loop of every command that rewrites a cloud: read a chunk, compute, write, add up.

A `Command` plans once for a whole cloud; then each file goes through `stream`, chunk by chunk, with
the next chunk being read and the last one written meanwhile. `run_command` does that for one file,
`pcfix.flow.tiles` for many.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

from pcfix.io.files import check_input, check_output, write_bytes, write_text
from pcfix.io.las.source import CloudPart, LasSource
from pcfix.io.las.writing import check_suffix, las_writer
from pcfix.io.tiles import Tiles, check_one_file, inputs_of, open_cloud, part_of
from pcfix.options.declare import File
from pcfix.running import running

if TYPE_CHECKING:
    import laspy
    from matplotlib.figure import Figure

Chunk: TypeAlias = "laspy.ScaleAwarePointRecord"
Header: TypeAlias = "laspy.LasHeader"
Progress: TypeAlias = Callable[[int, int], None]
Bar: TypeAlias = Callable[[str], AbstractContextManager[Progress | None]]
"""Shows the progress of a step, given its title."""
Check: TypeAlias = Callable[[Any], Any]
"""Refuses the statistics of a whole cloud that cannot be right, else returns its findings."""


def no_bar(title: str) -> AbstractContextManager[None]:
    """Show nothing."""
    return nullcontext()


class FileWork(Protocol):
    """What a command does to one file."""

    header: Header
    identity: bytes
    """The bytes of the header that name the software of the output."""

    def compute(self, points: Chunk, row: int) -> tuple[Any, Any]:
        """Return the result for a chunk that begins at a row of the cloud, and its statistics."""

    def apply(self, points: Chunk, result: Any) -> Chunk:
        """Return the points of the output; runs while the next chunk is computed."""


@dataclass(frozen=True)
class Command:
    """A command that rewrites clouds, as functions.

    `plan` takes a cloud, the path of the output, and chunks to keep in memory (`FileTask.kept`),
    and returns all that the points have in common, which can be pickled. `process` takes one file
    through a plan (plan, task, first row of the cloud, check or None), and returns the statistics
    and the findings of the check; see `stream`. `check` refuses, by plan and statistics of the
    whole cloud, what cannot be right. `summarize` makes the result of plan, statistics, findings
    and `Ends`.
    """

    name: str
    plan: Callable[[Any, Path, list[Chunk] | None], Any]
    process: Callable[[Any, FileTask, int, Check | None], tuple[Any, Any]]
    check: Callable[[Any, Any], Any]
    summarize: Callable[[Any, Any, Any, Ends], Any]


@dataclass(frozen=True)
class Ends:
    """The names of input and output for a summary, the part that was read, and the time so far."""

    input: str
    output: str
    seconds: float
    part: dict[str, Any] | None = None


@dataclass(frozen=True)
class FileTask:
    """A cloud to read, a cloud to write, and how."""

    source: Path | CloudPart
    target: Path
    summary: File | None = None  # JSON file
    overwrite: bool = False
    jobs: int | None = None
    progress: Progress | None = None  # called with (points done, points in all)
    started: float = field(default_factory=time.perf_counter)
    kept: list[Chunk] = field(default_factory=list)  # of a small cloud that is read several times

    @property
    def seconds(self) -> float:
        """Time since the start."""
        return time.perf_counter() - self.started


def stream(
    work: Callable[[Any, LasSource], FileWork],
    plan: Any,
    task: FileTask,
    row: int = 0,
    check: Check | None = None,
) -> tuple[Any, Any]:
    """Take every chunk of a file through a command; the target appears when all went well.

    `work` returns what is done to the opened file by the plan; the file begins at a row of the
    whole cloud. Returns the statistics, and the findings of the check.
    """
    with open_cloud(task.source, task.jobs, kept=task.kept or None) as source:
        own, total = work(plan, source), len(source)
        tally, findings = None, None
        done, end, reached = 0, 0, 0.0  # points before and after the chunk, and those reported
        # the index of a COPC file would be wrong
        evlrs = [one for one in source.evlrs if one.user_id != "copc"]
        last = evlrs, own.identity, task.jobs
        with las_writer(task.target, own.header, *last) as append, _thread(task.jobs) as writer:

            def write(points: Chunk, result: Any) -> None:
                append(own.apply(points, result))

            def report(points: float) -> None:
                nonlocal reached
                reached = min(reached + points, end)
                if task.progress is not None:
                    task.progress(round(reached), total)

            written: Future[None] | None = None
            for points in read_ahead(source.chunks(), task.jobs):
                end = done + len(points)
                with running(report=report):
                    result, one = own.compute(points, row + done)
                if written is not None:
                    written.result()  # at most one chunk waits, which bounds the memory
                written = writer.submit(write, points, result)
                tally = one if tally is None else tally + one
                done = end
                report(len(points))
            if written is not None:
                written.result()
            if check is not None:  # before the temporary file is renamed
                findings = check(tally)
    return tally, findings


def read_ahead(chunks: Iterator[Any], jobs: int | None) -> Iterator[Any]:
    """Yield chunks while the next one is read; with one job without a thread."""
    with _thread(jobs) as reader:
        following = reader.submit(next, chunks, None)
        while (one := following.result()) is not None:
            following = reader.submit(next, chunks, None)
            yield one


def _thread(jobs: int | None) -> Executor:
    """Return another thread, or this one for a single job."""
    return _ThisThread() if jobs == 1 else ThreadPoolExecutor(1)


class _ThisThread(Executor):
    """Runs each call at once, so that Ctrl-C ends a process of many without other threads."""

    def submit(self, call: Any, /, *given: Any, **keywords: Any) -> Future[Any]:
        """Return what a call gave."""
        future: Future[Any] = Future()
        future.set_result(call(*given, **keywords))
        return future


def json_text(content: dict[str, Any]) -> str:
    """Return plain values as pcfix writes them."""
    return json.dumps(content, indent=2) + "\n"


def check_summary(options: Any, inputs: Iterable[File] = ()) -> None:
    """Refuse small outputs that could not be written, before the work begins."""
    known = list(inputs)
    for name in ("plot", "summary", "save_regression"):
        path = getattr(options, name, None)
        if path is not None:
            known.append(check_output(path, overwrite=options.overwrite, inputs=known))


def write_summary(
    options: Any, summary: dict[str, Any], figure: Callable[[], Figure] | None = None
) -> None:
    """Write a summary as JSON and its figure as PNG, if the options name files for them."""
    if figure is not None and options.plot is not None:
        from pcfix.report.page import png_of

        write_bytes(options.plot, png_of(figure()), overwrite=options.overwrite)
    if options.summary is not None:
        write_text(options.summary, json_text(summary), overwrite=options.overwrite)


def check_cloud(path: File, *, overwrite: bool, inputs: Iterable[File] = ()) -> Path:
    """Return the path of a cloud that may be written, by its suffix and `check_output`."""
    target = check_output(path, overwrite=overwrite, inputs=inputs)
    check_suffix(target)
    return target


def file_task(
    input: File | Tiles,
    output: File,
    options: Any,
    *,
    reads: Iterable[Any] = (),
    more: Iterable[File] = (),
    check: Callable[..., Path] = check_cloud,
    progress: Progress | None = None,
) -> FileTask:
    """Return the task of a command after checking that its files may be read and written.

    The input may be many files; `options` has overwrite and, if the command has them, summary and
    jobs. `reads` are further inputs, of which values that are no paths do not count; `more` are
    further outputs, checked like the output, by `check`.
    """
    started = time.perf_counter()
    check_one_file(input, options)
    source = Path(str(input)) if isinstance(input, Tiles) else check_input(input)
    known = [one for one in (*inputs_of(input), *reads) if isinstance(one, str | PathLike)]
    for path in (output, *more):
        known.append(check(path, overwrite=options.overwrite, inputs=known))
    check_summary(options, known)
    summary, jobs = (getattr(options, name, None) for name in ("summary", "jobs"))
    cloud, target = part_of(source, options), Path(output)
    return FileTask(cloud, target, summary, options.overwrite, jobs, progress, started=started)

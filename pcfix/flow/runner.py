"""The loop of every command that rewrites a cloud: read a chunk, compute, write, add up.

A `Command` plans once for a whole cloud; then each file goes through `stream`, chunk by chunk, with
the next chunk being read and the last one written meanwhile. `pcfix.flow.tiles` does that for one
file or many.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, TypeAlias, TypeVar

from pcfix.errors import SettingError
from pcfix.io.files import check_input, check_output, write_bytes, write_text
from pcfix.io.las.source import LasSource
from pcfix.io.las.writing import check_suffix, corrected_identity, las_writer
from pcfix.io.tiles import Tiles, check_one_file, inputs_of, open_cloud, part_of
from pcfix.options.declare import File
from pcfix.running import running

if TYPE_CHECKING:
    import laspy
    from matplotlib.figure import Figure

Result = TypeVar("Result")
Chunk: TypeAlias = "laspy.ScaleAwarePointRecord"
Progress: TypeAlias = Callable[[int, int], None]
Bar: TypeAlias = Callable[[str], AbstractContextManager[Progress | None]]
"""Shows the progress of a step, given its title."""
Finish: TypeAlias = Callable[[Any], Any]
"""Takes the statistics of a whole cloud; refuses what cannot be right, else returns the result."""


def no_bar(title: str) -> AbstractContextManager[None]:
    """Show nothing."""
    return nullcontext()


class FileWork(NamedTuple):
    """What a command does to one file.

    `compute` takes a chunk and the row of the cloud at which it begins, and returns a result and
    statistics. `apply` takes the chunk and the result, and returns the points of the output; it
    runs while the next chunk is computed.
    """

    header: laspy.LasHeader
    compute: Callable[[Chunk, int], tuple[Any, Any]]
    apply: Callable[[Chunk, Any], Chunk]
    identity: bytes = b""  # of the software in the header; by default that of pcfix


@dataclass(frozen=True)
class FileTask:
    """A cloud to read, a cloud to write, and how."""

    source: Any  # path, part, or many files; a name in a pipeline of PDAL
    target: Path
    jobs: int | None = None
    progress: Progress | None = None  # called with (points done, points in all)
    started: float = field(default_factory=time.perf_counter)
    kept: list[Chunk] = field(default_factory=list)  # of a small cloud that is read several times

    @property
    def seconds(self) -> float:
        """Time since the start."""
        return round(time.perf_counter() - self.started, 3)


@dataclass(frozen=True)
class Command(Generic[Result]):
    """A command that rewrites clouds, as functions.

    `plan` takes a task for the whole cloud, and returns all that its points have in common, which
    can be pickled. `process` takes one file through a plan, and returns statistics and result; see
    `stream`. `finish` takes the plan, the task and the statistics of the whole cloud; it refuses
    what cannot be right, and returns the result of the command.
    """

    name: str
    plan: Callable[[FileTask], Any]
    process: Callable[[Any, FileTask, int, Finish], tuple[Any, Any]]
    finish: Callable[[Any, FileTask, Any], Result]


def stream(
    work: Callable[[Any, LasSource], FileWork], plan: Any, task: FileTask, row: int, finish: Finish
) -> tuple[Any, Any]:
    """Take every chunk of a file through a command; the target appears when all went well.

    `work` returns what is done to the opened file by the plan; the file begins at a row of the
    whole cloud. Returns the statistics, and what `finish` makes of them.
    """
    with open_cloud(task.source, task.jobs, kept=task.kept or None) as source:
        own, total = work(plan, source), len(source)
        tally, done, end, reached = None, 0, 0, 0.0  # points before and after, and those reported
        # the index of a COPC file would be wrong
        evlrs = [one for one in source.evlrs if one.user_id != "copc"]
        last = evlrs, own.identity or corrected_identity(source), task.jobs
        with las_writer(task.target, own.header, *last) as append, ThreadPoolExecutor(1) as writer:

            def write(points: Chunk, result: Any) -> None:
                append(own.apply(points, result))

            def report(points: float) -> None:
                nonlocal reached
                reached = min(reached + points, end)
                if task.progress is not None:
                    task.progress(round(reached), total)

            written: Future[None] | None = None
            for points in read_ahead(source.chunks()):
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
            return tally, finish(tally)  # before the temporary file is renamed


def read_ahead(chunks: Iterator[Any]) -> Iterator[Any]:
    """Yield chunks while the next one is read."""
    with ThreadPoolExecutor(1) as reader:
        following = reader.submit(next, chunks, None)
        while (one := following.result()) is not None:
            following = reader.submit(next, chunks, None)
            yield one


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


def check_folder(
    folder: Path, inputs: Iterable[Any] = (), *, mark: str = "", overwrite: bool = True
) -> None:
    """Refuse a folder for outputs that is the folder of an input.

    One that replaces the folder of an earlier call, which has a file `mark`, must not have inputs
    at any depth, or anything else. Values of `inputs` that are no paths do not count.
    """
    place, code, wrong = folder.resolve(), "output.is_input", ""
    paths = [Path(one).resolve() for one in inputs if isinstance(one, str | PathLike)]
    inside = [one for one in paths if place in (one, *(one.parents if mark else one.parents[:1]))]
    if inside:
        wrong = f"is the folder of the input {inside[0].name}. Give another one"
    elif folder.exists() and not folder.is_dir():
        code, wrong = "output.exists" if mark else "output.folder", "is a file. Give a folder"
    elif mark and not place.parent.is_dir():
        code, wrong = "output.no_folder", f"its folder {folder.parent} does not exist. Create it"
    elif mark and folder.is_dir() and any(folder.iterdir()):
        code = "output.exists"
        if not overwrite:
            wrong = "exists. Add --overwrite to replace it"
        elif not (folder / mark).is_file():
            wrong = f"holds other files, and no {mark}. Give an empty or new folder"
    if wrong:
        raise SettingError(code, f"{folder}: {wrong}.", path=folder)


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
    source: Any = input if isinstance(input, Tiles) else check_input(input)
    known = [one for one in (*inputs_of(input), *reads) if isinstance(one, str | PathLike)]
    for path in (output, *more):
        known.append(check(path, overwrite=options.overwrite, inputs=known))
    check_summary(options, known)
    if not isinstance(source, Tiles):
        source = part_of(source, options)
    jobs = getattr(options, "jobs", None)
    return FileTask(source, Path(output), jobs, progress, started)

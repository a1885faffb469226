"""One step over a file: open, check, read in chunks, write beside the target, rename."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

from pcfix.io.files import check_input, check_output, write_text
from pcfix.io.las.part import cloud_part
from pcfix.io.las.source import LasSource
from pcfix.io.las.writing import LasSink, check_suffix, corrected_identity, output_evlrs
from pcfix.io.tiles import Tiles, check_one_file, inputs_of
from pcfix.kernels import telling
from pcfix.options.declare import File

if TYPE_CHECKING:
    import laspy

Chunk: TypeAlias = "laspy.ScaleAwarePointRecord"
Header: TypeAlias = "laspy.LasHeader"
Progress: TypeAlias = Callable[[int, int], None]
Bar: TypeAlias = Callable[[str], AbstractContextManager[Progress | None]]
"""Of the name of a step: what shows, while it runs, how far it is."""


def no_bar(title: str) -> AbstractContextManager[None]:
    """Show nothing."""
    return nullcontext()


def part_of(progress: Progress | None, number: int, count: int) -> Progress | None:
    """Return what a job tells that is one of several alike."""
    if progress is None:
        return None
    return lambda done, total: progress(number * total + done, count * total)


class Step(Protocol):
    """What happens to the points of a file."""

    identity: bytes | None = None
    """Of the output, by its first bytes; None for that of every corrected file."""

    def header(self, source: LasSource) -> Header:
        """Return the header of the output, and be ready for the first chunk."""

    def chunk(self, points: Chunk, source: LasSource, header: Header) -> Callable[[], Chunk]:
        """Return what turns some points into those of the output; it may run beside the next."""

    def finish(self) -> None:
        """Refuse a result that cannot be right; nothing is left behind then."""
        return

    def run(self, task: FileTask) -> None:
        """Process a file."""
        task.run(self)


@dataclass(frozen=True)
class FileTask:
    """A cloud to read, a cloud to write, and how.

    Attributes
    ----------
    summary : path or None
        Where the summary goes, as JSON.
    progress : callable or None
        Called with (points done, points in all), after each chunk and while it is corrected.
    is_tile : bool
        Whether it is a part of a cloud; `Step.finish` is about a whole one.
    started : float
        `time.perf_counter` then.
    kept : list
        The chunks of a small cloud that is gone through more than once; see `LasSource`.
    """

    source: Path
    target: Path
    summary: File | None = None
    overwrite: bool = False
    jobs: int | None = None
    progress: Progress | None = None
    is_tile: bool = False
    started: float = field(default_factory=time.perf_counter)
    kept: list[Chunk] = field(default_factory=list)

    @property
    def seconds(self) -> float:
        """How long it has taken so far."""
        return time.perf_counter() - self.started

    def run(self, step: Step) -> None:
        """Take every chunk through a step; the target appears when all went well."""
        with LasSource(self.source, self.jobs, kept=self.kept or None) as source:
            header = step.header(source)
            identity = step.identity or corrected_identity(source)
            last = output_evlrs(source), identity, self.jobs
            with LasSink(self.target, header, *last) as sink:
                done = 0
                with written_behind(sink.write, self.jobs) as write:
                    for points in read_ahead(source.chunks(), self.jobs):
                        count = len(points)
                        with telling(partial(self._tell, done, count, len(source))):
                            write(step.chunk(points, source, header))
                        done += count
                        self._tell(done, 0, len(source))
                if not self.is_tile:
                    step.finish()

    def _tell(self, done: int, chunk: int, total: int, of_chunk: int = 0) -> None:
        """Show that so many points are done, and so many of a chunk, which may go twice."""
        if self.progress is not None:
            self.progress(done + min(of_chunk, chunk), total)

    def tell(self, summary: dict[str, Any]) -> None:
        """Write the summary, where one is wanted."""
        write_summary(self, summary)


def read_ahead(chunks: Iterator[Any], jobs: int | None) -> Iterator[Any]:
    """Yield chunks, of which the next is being read meanwhile, but with one job."""
    if jobs == 1:
        yield from chunks
        return
    with ThreadPoolExecutor(1) as reader:
        following = reader.submit(next, chunks, None)
        while (one := following.result()) is not None:
            following = reader.submit(next, chunks, None)
            yield one


@contextmanager
def written_behind(write: Callable[[Any], None], jobs: int | None) -> Iterator[Callable[..., None]]:
    """Give a function that makes and writes chunks in order, while others are computed."""

    def made(make: Callable[[], Any]) -> None:
        write(make())

    if jobs == 1:
        yield made
        return
    with ThreadPoolExecutor(1) as writer:
        last: Future[None] | None = None

        def later(make: Callable[[], Any]) -> None:
            nonlocal last
            if last is not None:
                last.result()
            last = writer.submit(made, make)

        yield later
        if last is not None:
            last.result()


def json_text(content: dict[str, Any]) -> str:
    """Return plain values as pcfix writes them."""
    return json.dumps(content, indent=2) + "\n"


def check_summary(options: Any, inputs: Iterable[File] = ()) -> None:
    """Refuse a summary, or a line, that could not be written, before anything is computed."""
    known = list(inputs)
    for name in ("summary", "save_regression"):
        path = getattr(options, name, None)
        if path is not None:
            known.append(check_output(path, overwrite=options.overwrite, inputs=known))


def write_summary(options: Any, summary: dict[str, Any]) -> None:
    """Write a summary as JSON where the options, with overwrite, name a file for it."""
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
    """Return the task of a command, once its files may be read and written.

    Parameters
    ----------
    input, output : path
        The input may be many files.
    options : OptionSet
        With overwrite, and where the command has them summary and jobs.
    reads : iterable
        What else is read; values that are no paths do not count.
    more : iterable of path
        What else is written, by the rule of the output.
    check : callable
        Returns the path of an output; see `check_cloud`.
    progress : callable, optional

    Raises
    ------
    PcfixError
        If a file is missing, or would be replaced.
    """
    started = time.perf_counter()
    check_one_file(input, options)
    source = Path(str(input)) if isinstance(input, Tiles) else check_input(input)
    source = cloud_part(source, options)
    known = [one for one in (*inputs_of(input), *reads) if isinstance(one, str | PathLike)]
    for path in (output, *more):
        known.append(check(path, overwrite=options.overwrite, inputs=known))
    check_summary(options, known)
    target = Path(output)
    summary, jobs = (getattr(options, name, None) for name in ("summary", "jobs"))
    return FileTask(source, target, summary, options.overwrite, jobs, progress, started=started)

"""How a command goes over a cloud: in one file, or in many on several processes or a cluster.

A command plans once for a cloud; then each file goes through `stream`, chunk by chunk, with
the next chunk being read and the last one written meanwhile. Each of many files is a task that
writes its output, and its statistics in the folder `RECORDS`. A file whose output exists with the
same key (a hash of options and input files) is skipped.
"""

import json
import multiprocessing
import pickle
import signal
import sys
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures import as_completed as completed
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial, reduce
from hashlib import sha256
from itertools import accumulate
from operator import add
from os import PathLike
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias, TypeVar, cast

from pcfix import version
from pcfix.errors import InputError, PcfixError, SettingError, optional_library, silently
from pcfix.flow.raster import raster_outputs, raster_writer
from pcfix.io import files
from pcfix.io.clouds import Clouds, Tiles, band_of, inputs_of, open_cloud, tiles_of
from pcfix.io.files import all_or_none, write_bytes, write_text
from pcfix.io.las.source import LasSource
from pcfix.io.las.writing import check_cloud, corrected_identity, las_writer
from pcfix.io.rasters import check_tif
from pcfix.io.vectors import LAYER_MARK
from pcfix.options.declare import File, options_of
from pcfix.running import current, running, threads

if TYPE_CHECKING:
    import laspy

Result = TypeVar("Result")
Chunk: TypeAlias = "laspy.ScaleAwarePointRecord"
Progress: TypeAlias = Callable[[int, int], None]
Bar: TypeAlias = Callable[[str], AbstractContextManager[Progress | None]]  # shows progress
RECORDS = ".pcfix"
HOW = ("overwrite", "jobs", "scheduler", "summary")  # options on which no output depends
WAIT_S = 10  # for a scheduler to answer, and for its first worker
POINTS_A_PROCESS = 500_000  # these take about as long as another process takes to start


def no_bar(title: str) -> AbstractContextManager[None]:
    """Show nothing."""
    return nullcontext()


class FileWork(NamedTuple):
    """What a command does to one file.

    `compute` takes a chunk and the row of the cloud at which it begins, and returns a result and
    statistics. `apply` takes the chunk and the result, and returns the points of the output; it
    runs while the next chunk is computed.
    """

    header: "laspy.LasHeader"
    compute: Callable[[Chunk, int], tuple[Any, Any]]
    apply: Callable[[Chunk, Any], Chunk]
    identity: bytes = b""  # of the software in the header; by default that of pcfix


Work: TypeAlias = Callable[[Any, LasSource], FileWork]  # of the plan and an opened file


@dataclass(frozen=True, eq=False)
class FileTask:
    """A cloud to read, a cloud to write, and how."""

    source: Any  # path, part, or many files; a name in a pipeline of PDAL
    target: Path
    jobs: int | None = None
    progress: Progress | None = None  # called with (points done, points in all)
    started: float = field(default_factory=time.perf_counter)
    rasters: Mapping[str, Path] = field(default_factory=dict)  # instead of a cloud
    # of one of many files: its points, the first as a row of all files, a checksum of all
    # that the output depends on, and the version that must process it
    points: int = 0
    row: int = 0
    key: str = ""
    pcfix: str = version.__version__

    @property
    def seconds(self) -> float:
        """Time since the start."""
        return round(time.perf_counter() - self.started, 3)

    @property
    def record(self) -> Path:
        """The file with its key and statistics, written just after its output."""
        return self.target.parent / RECORDS / f"{self.target.name}.tally"

    @property
    def is_finished(self) -> bool:
        """Whether the output exists, with the same key."""
        return self.target.is_file() and files.read_tally(self.record)[0] == self.key


def run_command(
    name: str,
    input: Clouds,
    output: File,
    options: Any,
    *,
    plan: Callable[[FileTask], Any],
    work: Work,
    finish: Callable[[Any, FileTask, Any], Result],
    reads: Iterable[Any] = (),
    progress: Progress | None = None,
) -> Result:
    """Run a command that rewrites clouds over one file or many, and return its result.

    `plan` takes a task for all files, and returns all that its points have in common, which can be
    pickled. `work` returns what is done to one opened file by the plan. `finish` takes the plan,
    the task and the statistics of all points; it refuses what cannot be right, else returns the
    result. `reads` are further inputs. With many files, `progress` is called after each.
    """
    targets, tiles = raster_outputs(name, input, output, options), tiles_of(input)
    if tiles is None:
        check = check_tif if targets else check_cloud
        task = file_task(
            cast("File", input), output, options,
            reads=reads, more=list(targets.values())[1:], check=check, progress=progress,
        )  # fmt: skip
        task = replace(task, rasters=targets)
        with threads(task.jobs), running(clouds={}), all_or_none():
            planned = plan(task)
            # the output appears when the block ends, if `finish` does not refuse it
            result = finish(planned, task, stream(work, planned, task))
            write_summary(options, result)
        return result
    # Many files: check all, plan for them as one cloud, and do a task for each
    folder = files.path_of(output)
    task = FileTask(tiles, folder)
    check_folder(folder, tiles.paths)
    named = Path(tiles.name)
    if named.is_dir() and folder.resolve().is_relative_to(named.resolve()):
        sentence = f"{folder}: is inside the folder of the inputs. Give one outside of it."
        raise SettingError("output.is_input", sentence, path=folder)
    check_summary(options, tiles.paths)
    key, first_rows = key_of(name, options, tiles.paths), accumulate(tiles.points, initial=0)
    tasks = [
        FileTask(path.resolve(), folder.resolve() / path.name, points=points, row=row, key=key)
        for path, points, row in zip(tiles.paths, tiles.points, first_rows, strict=False)
    ]
    todo = [one for one in tasks if not one.is_finished]
    for one in todo if folder.exists() else ():
        check_cloud(one.target, overwrite=options.overwrite, inputs=tiles.paths)
    points, failed = sum(one.points for one in todo), list[str]()
    with threads(options.jobs), machines(options.scheduler, options.jobs, points) as run:
        planned = plan(task)
        try:
            (folder / RECORDS).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            sentence = f"{folder}: cannot be created ({error.strerror})."
            raise InputError("output.folder", sentence) from error
        done = len(tiles) - points
        for one, why in run(pickle.dumps((work, planned)), todo):
            failed += [why] if why else []
            done += 0 if why else one.points
            if progress is not None:
                progress(done, len(tiles))
        if failed:
            sentence = f"{tiles}: {len(failed)} of {len(tasks)} files failed. The same command"
            sentence += " continues with them; if files have changed, add --overwrite."
            raise InputError("tiles.failed", "\n  ".join([sentence, *failed]), failed=failed)
        # in the order of the files, so that no sum depends on which was first
        tallies = [files.read_tally(one.record)[1] for one in tasks]
        tally = reduce(add, tallies) if tallies[0] is not None else None
        # Only the statistics of all points show whether cameras and water fit.
        try:
            result = finish(planned, task, tally)
        except PcfixError:
            for one in tasks:
                one.record.unlink(missing_ok=True)
                one.target.unlink(missing_ok=True)
            raise
        write_summary(options, result)
    return result


def stream(work: Work, plan: Any, task: FileTask) -> Any:
    """Take every chunk of a file through a command, and return the statistics of all points."""
    with open_cloud(task.source, task.jobs) as source:
        own, total = work(plan, source), len(source)
        tally, done, end, reached = None, 0, 0, 0.0  # points before and after, and those reported
        # the index of a COPC file would be wrong
        evlrs = [one for one in source.evlrs if one.user_id != "copc"]
        last = evlrs, own.identity or corrected_identity(source), task.jobs
        output = (
            raster_writer(source, own.header, task.rasters, task.progress)
            if task.rasters
            else las_writer(task.target, own.header, *last)
        )
        with output as append, ThreadPoolExecutor(1) as writer:

            def write(points: Chunk, result: Any) -> None:
                append(own.apply(points, result))

            def report(points: float) -> None:
                nonlocal reached
                reached = min(reached + points, end)
                if task.progress is not None:
                    task.progress(round(reached), total)

            written: Future[Any] = writer.submit(bool)  # nothing yet
            for points in read_ahead(source.chunks()):
                end = done + len(points)
                with running(report=report):
                    result, one = own.compute(points, task.row + done)
                written.result()  # at most one chunk waits, which bounds the memory
                written = writer.submit(write, points, result)
                tally = one if tally is None else tally + one
                done = end
                report(len(points))
            written.result()
    return tally


def read_ahead(chunks: Iterator[Any]) -> Iterator[Any]:
    """Yield chunks while the next one is read."""
    with ThreadPoolExecutor(1) as reader:
        following = reader.submit(next, chunks, None)
        while (one := following.result()) is not None:
            following = reader.submit(next, chunks, None)
            yield one


def key_of(
    name: str, options: Any, inputs: Iterable[Path] = (), ignored: Collection[str] = HOW
) -> str:
    """Return a checksum of all that the outputs of a command depend on."""
    asked: dict[str, Any] = {}
    for option in (one.name for one in options_of(type(options)) if one.name not in ignored):
        asked[option] = value = getattr(options, option)
        if isinstance(value, str | PathLike):  # with the size and time of each file of a path
            path = Path(str(value).partition(LAYER_MARK)[0])
            found = files.belonging(path) if path.exists() else []
            asked[option] = [str(value), *map(files.file_state, found)]
    depends = [version.__version__, name, asked, [files.file_state(path) for path in inputs]]
    # objects, such as cameras, are pickled
    text = json.dumps(depends, sort_keys=True, default=lambda one: pickle.dumps(one).hex())
    return sha256(text.encode()).hexdigest()


# Many files, on processes or a cluster


def do_task(pickled: bytes, task: FileTask, jobs: int | None = None) -> str:
    """Process one file, here or on a worker; return the error, if there was one."""
    try:
        if task.pcfix != version.__version__:
            sentence = f"{task.source}: this worker has pcfix {version.__version__}, not"
            raise InputError("cluster.version", f"{sentence} {task.pcfix}. Install that there.")
        if task.is_finished:  # by a worker that was lost before it could say so
            return ""
        work, plan = pickle.loads(pickled)
        with threads(jobs), silently():  # warnings were shown when the plan was made
            task.record.unlink(missing_ok=True)  # that of an older output
            with all_or_none():
                tally = stream(work, plan, replace(task, jobs=jobs))
                write_bytes(task.record, pickle.dumps((task.key, tally)), overwrite=True)
    except PcfixError as error:
        return str(error)
    return ""


def in_processes(
    work: Callable[..., str], shared: bytes, tasks: Sequence[Any], most: int, jobs: int | None
) -> Iterator[tuple[Any, str]]:
    """Do tasks in processes of this machine, and yield each with its error as it is done.

    At most `most` processes share `jobs` threads, all cores by default. A single one is this
    process. `shared` is for all tasks.
    """
    jobs = jobs or current().threads
    most = min(most, jobs, len(tasks))
    if most <= 1:
        for task in tasks:
            yield task, work(shared, task, jobs)
        return
    context, main = multiprocessing.get_context("spawn"), sys.modules["__main__"]
    with ProcessPoolExecutor(most, context, initializer=_begin_process) as pool:
        # without the user's script, which each process would run again
        sys.modules["__main__"] = ModuleType("__main__")
        try:
            futures = {pool.submit(work, shared, task, jobs // most): task for task in tasks}
        finally:
            sys.modules["__main__"] = main
        try:
            yield from _finished(futures)
        except BaseException:
            for process in multiprocessing.active_children():
                process.terminate()
            pool.shutdown(cancel_futures=True)
            raise


def _begin_process() -> None:
    """Ignore Ctrl-C: the parent ends its processes, which remove their temporary files."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())


def _finished(futures: dict[Future[str], Any]) -> Iterator[tuple[Any, str]]:
    """Yield tasks with their errors as they are done."""
    for future in completed(futures):
        task = futures[future]
        try:
            yield task, future.result()
        except Exception as error:  # of processes and clusters; those of pcfix are results
            name, memory = getattr(task, "source", task), "With fewer --jobs each has more memory"
            yield task, f"{name}: its process ended suddenly ({error}) {memory}."


@contextmanager
def machines(
    address: str | None, jobs: int | None, points: int
) -> Iterator[Callable[[bytes, Sequence[FileTask]], Iterator[tuple[FileTask, str]]]]:
    """Give a function that does `do_task` for tasks of this number of points in all.

    It takes what is pickled for all tasks, and yields each with its error as it is done. It uses
    processes of this machine, or the workers of the scheduler at an address.
    """
    if address is None:
        most = jobs or 1 + points // POINTS_A_PROCESS
        yield partial(in_processes, do_task, most=most, jobs=jobs)
        return
    distributed = optional_library("distributed", "cluster", f"--scheduler {address}")
    try:
        client = distributed.Client(address, timeout=WAIT_S, set_as_default=False)
    except (OSError, ValueError) as error:  # TimeoutError is an OSError
        sentence = f"scheduler {address}: does not answer within {WAIT_S} s ({error}). Check the"
        sentence += " address, and that 'dask scheduler' runs there."
        raise InputError("cluster.no_answer", sentence, address=address) from error
    with client:
        try:
            client.wait_for_workers(1, timeout=WAIT_S)
        except TimeoutError as error:
            sentence = f"scheduler {address}: has no workers. Start 'dask worker {address}'."
            raise InputError("cluster.no_workers", sentence, address=address) from error

        def run(shared: bytes, tasks: Sequence[FileTask]) -> Iterator[tuple[FileTask, str]]:
            everywhere = client.scatter(shared, broadcast=True)  # a lost worker loses its own copy
            executor: Executor = client.get_executor(pure=False)
            try:
                futures = {executor.submit(do_task, everywhere, one, 1): one for one in tasks}
                yield from _finished(futures)
            finally:
                executor.shutdown(wait=False)

        yield run


# Files that a command reads and writes


def json_text(content: dict[str, Any]) -> str:
    """Return plain values as pcfix writes them."""
    return json.dumps(content, indent=2) + "\n"


def check_summary(options: Any, inputs: Iterable[File] = ()) -> None:
    """Refuse small outputs that could not be written, before the work begins."""
    known = list(inputs)
    for name in ("plot", "summary"):
        path = getattr(options, name, None)
        if path is not None:
            known.append(files.check_output(path, overwrite=options.overwrite, inputs=known))


def write_summary(options: Any, summary: Any) -> None:
    """Write a summary, a dict or with a method `as_dict`, as JSON if the options name a file."""
    path = getattr(options, "summary", None)
    if path is not None:
        values = summary if isinstance(summary, dict) else summary.as_dict()
        write_text(path, json_text(values), overwrite=options.overwrite)


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
            wrong = f"contains other files but no {mark}. Give an empty or new folder"
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
    source: Any = input if isinstance(input, Tiles) else files.check_input(input)
    known = [one for one in (*inputs_of(input), *reads) if isinstance(one, str | PathLike)]
    for path in (output, *more):
        known.append(check(path, overwrite=options.overwrite, inputs=known))
    check_summary(options, known)
    jobs = getattr(options, "jobs", None)
    return FileTask(band_of(source, options), Path(output), jobs, progress)

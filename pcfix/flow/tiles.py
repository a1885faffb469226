"""A command over many files as over one cloud: in processes of this machine, or on a cluster.

The plan is made once, for the whole cloud; then each file is a task that writes its output, and
its statistics beside it, in the folder `RECORDS`. A file whose output exists with the same key (a
hash of options and input files) is skipped.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import pickle
import signal
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial, reduce
from hashlib import sha256
from operator import add
from pathlib import Path
from types import ModuleType
from typing import Any, cast

from pcfix import version
from pcfix.errors import InputError, PcfixError, PcfixWarning, SettingError
from pcfix.flow.runner import (
    Command,
    FileTask,
    Progress,
    Result,
    check_cloud,
    check_folder,
    check_summary,
    file_task,
    write_summary,
)
from pcfix.io.atomic import all_or_none
from pcfix.io.files import belonging, file_state, path_of, read_tally, write_tally
from pcfix.io.tiles import BrokenTileError, Clouds, Tiles, check_one_file, tiles_of
from pcfix.io.vectors import LAYER_MARK
from pcfix.libraries import optional_library
from pcfix.options.declare import File, options_of
from pcfix.running import current, threads

RECORDS = ".pcfix"
HOW = ("overwrite", "jobs", "scheduler", "summary")
"""Options on which no output depends."""
WAIT_S = 10
"""For a scheduler to answer, and for its first worker."""
Work = Callable[..., str]
Run = Callable[[Work, bytes, Sequence[Any]], Iterator[tuple[Any, str]]]
POINTS_A_PROCESS = 500_000
"""These take about as long as another process takes to start."""


@dataclass(frozen=True)
class Tile:
    """A file to process, and its output.

    `row` is its first of the whole cloud, `key` a checksum of everything that the output depends
    on, and `pcfix` the version that must process it.
    """

    source: Path
    target: Path
    points: int
    row: int
    key: str
    pcfix: str

    def __str__(self) -> str:
        return str(self.source)

    @property
    def record(self) -> Path:
        """The file with its statistics, written just before its output appears."""
        return self.target.parent / RECORDS / f"{self.target.name}.tally"

    @property
    def is_finished(self) -> bool:
        """Whether the output exists, with the same key."""
        return self.target.is_file() and read_tally(self.record)[0] == self.key

    def keep(self, tally: Any) -> None:
        """Write the statistics; an older output must not be taken for the one that follows."""
        self.target.unlink(missing_ok=True)
        write_tally(self.record, self.key, tally)


def do_tile(pickled: bytes, tile: Tile, jobs: int | None = None) -> str:
    """Process one file, here or on a worker; return the error, if there was one."""
    try:
        if tile.pcfix != version.__version__:
            raise InputError(
                "cluster.version",
                f"{tile.source}: this worker has pcfix {version.__version__}, not {tile.pcfix}."
                " Install that there.",
            )
        if tile.is_finished:  # by a worker that was lost before it could say so
            return ""
        process, plan = pickle.loads(pickled)
        with threads(jobs), warnings.catch_warnings():
            warnings.simplefilter("ignore", PcfixWarning)  # shown when the plan was made
            process(plan, FileTask(tile.source, tile.target, jobs), tile.row, tile.keep)
    except PcfixError as error:
        return str(error)
    return ""


def run_command(
    command: Command[Result],
    input: Clouds,
    output: File,
    options: Any,
    *,
    reads: Iterable[Any] = (),
    progress: Progress | None = None,
) -> Result:
    """Run a command over one file or many; `reads` are further inputs. Returns its result.

    With many files, `progress` is called with (points done, points in all) after each.
    """
    tiles = tiles_of(input)
    if tiles is not None:
        return _run_tiles(command, tiles, output, options, progress)
    task = file_task(cast("File", input), output, options, reads=reads, progress=progress)
    with threads(task.jobs), all_or_none():
        plan = command.plan(task)
        _, result = command.process(plan, task, 0, partial(command.finish, plan, task))
        _write_summary(options, result)
    return cast("Result", result)


def _write_summary(options: Any, result: Any) -> None:
    """Write the summary of a command, if it has one and its options name a file."""
    if getattr(options, "summary", None) is not None:
        write_summary(options, result.as_dict())


def _run_tiles(
    command: Command[Result], tiles: Tiles, output: File, options: Any, progress: Progress | None
) -> Result:
    """Run a command over all files that are not finished yet, and return its result."""
    folder = path_of(output)
    task = FileTask(tiles, folder)
    check_one_file(tiles, options)
    check_folder(folder, tiles.paths)
    named = Path(tiles.name)
    if named.is_dir() and folder.resolve().is_relative_to(named.resolve()):
        sentence = f"{folder}: is inside the folder of the inputs. Give one outside of it."
        raise SettingError("output.is_input", sentence, path=folder)
    check_summary(options, tiles.paths)
    work = _work(command.name, tiles, folder, options)
    # A tile is finished if its output exists with the key of these options and inputs.
    done = {tile for tile in work.values() if tile.is_finished}
    todo = [tile for tile in work.values() if tile not in done]
    for tile in todo if folder.exists() else ():
        check_cloud(tile.target, overwrite=options.overwrite, inputs=tiles.paths)
    result, points = None, sum(one.points for one in todo)
    with threads(options.jobs), machines(options.scheduler, options.jobs, points) as run:
        plan, readable = _planned(command, tiles, folder)
        try:
            (folder / RECORDS).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                "output.folder", f"{folder}: cannot be made ({error.strerror})."
            ) from error
        todo = [work[path] for path in readable.paths if work[path] not in done]
        failed = list(readable.broken.values())
        for tile, why in run(do_tile, pickle.dumps((command.process, plan)), todo):
            if why:
                failed.append(why)
            else:
                done.add(tile)
            if progress is not None:
                progress(sum(one.points for one in done), sum(tiles.points))
        if done:
            # in the order of the files, so that no sum depends on which was first
            tallies = [read_tally(tile.record)[1] for tile in work.values() if tile in done]
            tally = reduce(add, tallies) if tallies[0] is not None else None
            # Only the statistics of the whole cloud show whether cameras and water fit.
            try:
                result = command.finish(plan, task, tally)
            except PcfixError:
                for tile in todo:
                    tile.record.unlink(missing_ok=True)
                    tile.target.unlink(missing_ok=True)
                raise
            _write_summary(options, result)
    if failed:
        count = len(work) + len(readable.broken)
        raise InputError(
            "tiles.failed",
            f"{tiles}: {len(failed)} of {count} files failed. The same command continues with them;"
            " if files have changed, add --overwrite.\n" + "\n".join(f"  {one}" for one in failed),
            failed=failed,
        )
    return cast("Result", result)


def _work(name: str, tiles: Tiles, folder: Path, options: Any) -> dict[Path, Tile]:
    """Return a tile for each file, in their order."""
    asked = {
        one.name: _plain(getattr(options, one.name))
        for one in options_of(type(options))
        if one.name not in HOW
    }
    states = [file_state(path) for path in (*tiles.paths, *tiles.broken)]
    depends = [version.__version__, name, asked, states]
    key = sha256(json.dumps(depends, sort_keys=True).encode()).hexdigest()
    work, row = {}, 0
    for path, points in zip(tiles.paths, tiles.points, strict=True):
        target = folder.resolve() / path.name
        work[path] = Tile(path.resolve(), target, points, row, key, version.__version__)
        row += points
    return work


def _plain(value: Any) -> Any:
    """Return an option as JSON holds it; of files their size and time."""
    if isinstance(value, str) or hasattr(value, "joinpath"):
        path = Path(str(value).partition(LAYER_MARK)[0])
        return [file_state(one) for one in belonging(path)] if path.exists() else str(value)
    if value is None or isinstance(value, int | float | tuple):
        return value
    return sha256(pickle.dumps(value)).hexdigest()


def _planned(command: Command[Any], tiles: Tiles, folder: Path) -> tuple[Any, Tiles]:
    """Return the plan, and the tiles that could be read for it."""
    while True:
        try:
            return command.plan(FileTask(tiles, folder)), tiles
        except BrokenTileError as error:
            tiles = tiles.without(error.path, str(error))


def in_processes(
    work: Work, shared: bytes, tasks: Sequence[Any], most: int, jobs: int | None
) -> Iterator[tuple[Any, str]]:
    """Yield tasks with their errors as they are done, with the same `shared` for all.

    At most `most` processes share `jobs` threads, all cores by default. A single one is this
    process. If a process dies, the tasks that are not done continue one at a time, each in its own
    process: so only those whose process dies again have an error.
    """
    jobs = jobs or current().threads
    most = min(most, jobs, len(tasks))
    if most <= 1:
        for task in tasks:
            yield task, work(shared, task, jobs)
        return
    groups = [list(tasks)]
    for group in groups:
        count = min(most, len(group))
        with _processes(count) as pool:
            given = work, shared, max(1, jobs // count)
            futures = {pool.submit(_interruptible, *given, task): task for task in group}
            for future in as_completed(futures):
                task = futures[future]
                try:
                    yield task, future.result()
                except BrokenProcessPool:
                    if len(group) > 1:
                        groups.append([task])
                    else:
                        words = "its process ended suddenly, probably for lack of memory."
                        yield task, f"{task}: {words}"


@contextmanager
def _processes(count: int) -> Iterator[Executor]:
    """Give an executor of new processes, which Ctrl-C interrupts in their tasks."""
    context, main = multiprocessing.get_context("spawn"), sys.modules["__main__"]
    with ProcessPoolExecutor(count, context, initializer=_ignore_interrupts) as pool:
        # without the user's script, which each process would run again
        sys.modules["__main__"] = ModuleType("__main__")
        try:
            pool.submit(int)  # starts all processes
        finally:
            sys.modules["__main__"] = main
        try:
            yield pool
        except BaseException:
            for process in multiprocessing.active_children():
                if process.pid is not None:  # it is not started yet
                    os.kill(process.pid, signal.SIGINT)
            pool.shutdown(cancel_futures=True)
            raise


def _ignore_interrupts() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _interruptible(work: Work, shared: bytes, jobs: int, task: Any) -> str:
    """Do a task that Ctrl-C ends; between tasks a process waits for its parent to end it."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        return work(shared, task, jobs)
    finally:
        _ignore_interrupts()


def on_cluster(
    client: Any, work: Work, shared: bytes, tasks: Sequence[Any]
) -> Iterator[tuple[Any, str]]:
    """Yield tasks with their errors as they are done on the workers of a cluster."""
    everywhere = client.scatter(shared, broadcast=True)  # a lost worker loses its own copy only
    executor: Executor = client.get_executor(pure=False)
    futures: dict[Future[str], Any] = {
        executor.submit(work, everywhere, task, 1): task for task in tasks
    }
    try:
        for future in as_completed(futures):
            task = futures[future]
            try:
                yield task, future.result()
            except Exception as error:  # of the cluster; those of pcfix are results
                yield task, f"{task}: the cluster gave up ({error})."
    finally:
        executor.shutdown(wait=False)


@contextmanager
def machines(scheduler: str | None, jobs: int | None, points: int) -> Iterator[Run]:
    """Give the function that runs a task for each file, with this number of points in all."""
    if scheduler is None:
        yield partial(in_processes, most=jobs or 1 + points // POINTS_A_PROCESS, jobs=jobs)
        return
    with _client_of(scheduler) as client:
        yield partial(on_cluster, client)


@contextmanager
def _client_of(address: str) -> Iterator[Any]:
    """Connect to a scheduler that has workers."""
    distributed = optional_library("distributed", "cluster", f"--scheduler {address}")
    try:
        client = distributed.Client(address, timeout=WAIT_S, set_as_default=False)
    except (OSError, ValueError) as error:  # TimeoutError is an OSError
        raise InputError(
            "cluster.no_answer",
            f"scheduler {address}: does not answer within {WAIT_S} s ({error}). Check the address,"
            " and that 'dask scheduler' runs there.",
            address=address,
        ) from error
    with client:
        try:
            client.wait_for_workers(1, timeout=WAIT_S)
        except TimeoutError as error:
            raise InputError(
                "cluster.no_workers",
                f"scheduler {address}: has no workers. Start some with 'dask worker {address}'.",
                address=address,
            ) from error
        yield client

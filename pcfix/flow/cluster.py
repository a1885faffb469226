"""Where the tiles of a cloud are processed: here, in processes, or on a Dask cluster."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from types import ModuleType
from typing import Any

from pcfix.errors import InputError
from pcfix.kernels import cores
from pcfix.libraries import optional_library

WAIT_S = 10
"""For a scheduler to answer, and for its first worker."""

Work = Callable[..., str]
Run = Callable[[Work, bytes, Sequence[Any]], Iterator[tuple[Any, str]]]

POINTS_A_PROCESS = 500_000
"""These take about as long as another process takes to start."""


def in_processes(
    work: Work, shared: bytes, tasks: Sequence[Any], most: int, jobs: int | None
) -> Iterator[tuple[Any, str]]:
    """Yield tasks with their errors as they are done, with the same `shared` for all.

    At most `most` processes share `jobs` threads, all cores by default. A single one is this
    process.
    """
    count = min(most, jobs or cores(), len(tasks))
    if count <= 1:
        for task in tasks:
            yield task, work(shared, task, jobs)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(count, context, initializer=_ignore_interrupts) as pool:
        with _without_main():
            given = shared, max(1, (jobs or cores()) // count)
            futures = {pool.submit(_interruptible, work, given, task): task for task in tasks}
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
        except BrokenProcessPool as error:
            raise InputError(
                "tiles.process_ended",
                "A process ended suddenly, probably for lack of memory. Run the same command with"
                " fewer --jobs; it continues.",
            ) from error
        except BaseException:
            for process in multiprocessing.active_children():
                if process.pid is not None:  # it is not started yet
                    os.kill(process.pid, signal.SIGINT)
            pool.shutdown(cancel_futures=True)
            raise


def _ignore_interrupts() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _interruptible(work: Work, given: tuple[bytes, int], task: Any) -> str:
    """Do a task that Ctrl-C ends; between tasks a process waits for its parent to end it."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        return work(given[0], task, given[1])
    finally:
        _ignore_interrupts()


@contextmanager
def _without_main() -> Iterator[None]:
    """Let processes start without the user's script, which each would run again."""
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


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

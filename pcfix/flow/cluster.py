"""Where tasks run: in processes of this machine, or on the workers of a Dask cluster."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from multiprocessing import get_context
from types import ModuleType
from typing import Any, TypeVar

from pcfix.errors import InputError
from pcfix.kernels import cores
from pcfix.libraries import optional_library

Task = TypeVar("Task")
Result = TypeVar("Result")
Work = Callable[[bytes, Task, int | None], Result]
Run = Callable[..., Iterator[Any]]

WAIT_S = 10
"""For a scheduler to answer, and for its first worker."""


def in_processes(
    jobs: int | None, most: int, work: Work[Task, Result], shared: bytes, tasks: Sequence[Task]
) -> Iterator[tuple[Task, Result | str]]:
    """Yield tasks with their results as they are done, with the same `shared` for all.

    At most `most` processes share `jobs` threads, all cores by default. A single one is this
    process.
    """
    count = min(most, jobs or cores(), len(tasks))
    if count <= 1:
        for task in tasks:
            yield task, work(shared, task, jobs)
        return
    each = max(1, (jobs or cores()) // count)
    context = get_context("spawn")
    with ProcessPoolExecutor(count, context, initializer=_ignore_interrupts) as pool:
        with _without_main():
            futures: dict[Future[Result], Task] = {
                pool.submit(_interruptible, work, shared, task, each): task for task in tasks
            }
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
            for process in list((pool._processes or {}).values()):
                if process.pid is not None:  # it is not started yet
                    os.kill(process.pid, signal.SIGINT)
            pool.shutdown(cancel_futures=True)
            raise


def _ignore_interrupts() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _interruptible(work: Callable[..., Result], *given: Any) -> Result:
    """Do a task that Ctrl-C ends; between tasks a process waits for its parent to end it."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        return work(*given)
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


@contextmanager
def on_cluster(address: str) -> Iterator[Run]:
    """Give what runs tasks on the workers of a cluster; see `in_processes`.

    Raises
    ------
    InputError
        If the scheduler does not answer, or has no workers.
    """
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
        yield partial(_on_workers, client, distributed.as_completed)


def _on_workers(
    client: Any, as_completed: Any, work: Work[Task, Result], shared: bytes, tasks: Sequence[Task]
) -> Iterator[tuple[Task, Result | str]]:
    everywhere = client.scatter(shared, broadcast=True)  # a lost worker loses only its own copy
    futures = {client.submit(work, everywhere, one, 1, pure=False): one for one in tasks}
    try:
        done = as_completed(list(futures), loop=client.loop)
        for future in done:
            task = futures[future]
            if future.status == "finished":
                yield task, future.result()
            elif future.status in ("lost", "pending"):  # its result was lost with a worker: again
                done.add(future)
            else:
                why = future.exception() if future.status == "error" else future.status
                yield task, f"{task}: the cluster gave up ({why})."
    finally:
        client.cancel(list(futures))

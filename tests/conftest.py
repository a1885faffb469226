"""How much is tried, in which order, and what a quick test may not do (tests/README.md)."""

import os
import subprocess
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

import pytest
from hypothesis import settings
from numba.core import event

from pcfix.running import threads

# By day each run has the same examples, so that a change fails and not luck; at night others.
settings.register_profile("default", max_examples=20, deadline=None, derandomize=True)
settings.register_profile("nightly", max_examples=250, deadline=None, derandomize=False)
settings.load_profile("default")

# Each of two processes (-n 2 --dist worksteal) begins with one half of the tests. Each half begins
# with rooms whose kernels the other does not need at once, so that none is compiled twice, and
# ends with many short tests, which are easily shared out.
BEGIN = (("adjust", "points", "grid", "compare", "flow"), ("refract", "port", "water"))
SHORT = "io"


def pytest_configure(config: pytest.Config) -> None:
    """Use no cached kernels with ``-m quick``, so that the guard below sees every kernel call."""
    if config.option.markexpr == "quick":
        empty = tempfile.TemporaryDirectory(prefix="pcfix-no-kernels-")
        config.add_cleanup(empty.cleanup)
        os.environ["NUMBA_CACHE_DIR"] = empty.name


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the quick tests of files with `quick_but`, and bring all into the order above."""
    rooms: dict[str, list[pytest.Item]] = {}
    for item in items:
        others = item.get_closest_marker("quick_but")
        if others and getattr(item, "originalname", item.name) not in others.args:
            item.add_marker("quick")
        room = item.path.relative_to(Path(__file__).parent).parts[0]
        rooms.setdefault(room, []).append(item)
    one, two = ([item for room in begin for item in rooms.pop(room, [])] for begin in BEGIN)
    short = rooms.pop(SHORT, [])
    two += [item for others in rooms.values() for item in others]
    middle = max(0, len(items) // 2 - len(one))
    items[:] = [*one, *short[:middle], *two, *short[middle:]]


@pytest.fixture
def one_thread() -> Iterator[None]:
    """Small blocks lose more by waking a second thread than they gain."""
    with threads(1):
        yield


class NoCompilation(event.Listener):
    """Fails the test in which numba compiles a kernel."""

    compiled = False

    def on_start(self, event: event.Event) -> None:
        self.compiled = True
        if threading.current_thread() is threading.main_thread():
            pytest.fail("a quick test may not call a kernel")

    def on_end(self, event: event.Event) -> None:
        pass


def _no_process(*words: object, **options: object) -> None:
    pytest.fail("a quick test may not start a process")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup(item: pytest.Item) -> Iterator[None]:
    with _guarded(item):
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    with _guarded(item):
        return (yield)


@contextmanager
def _guarded(item: pytest.Item) -> Iterator[None]:
    """Fail a quick test or its fixtures where they start a process or compile a kernel."""
    if item.get_closest_marker("quick") is None:
        yield
        return
    listener = NoCompilation()
    with (
        mock.patch.object(subprocess.Popen, "__init__", _no_process),
        event.install_listener("numba:compile", listener),
    ):
        yield
    if listener.compiled:  # in another thread, which waits for nobody's exception
        pytest.fail("a quick test may not call a kernel")

"""How much is tried, and in which order (tests/README.md)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from hypothesis import settings

if TYPE_CHECKING:
    import pytest

# By day each run has the same examples, so that a change fails and not luck; at night others.
settings.register_profile("default", max_examples=20, deadline=None, derandomize=True)
settings.register_profile("nightly", max_examples=250, deadline=None, derandomize=False)
settings.load_profile("default")

# Of two processes (-n 2 --dist worksteal) each begins with one half of the tests. Each half begins
# with rooms whose kernels the other does not need at once, so that none is compiled twice, and
# ends with many quick tests, which are easily shared out.
BEGIN = (("adjust", "clean", "grid", "compare", "flow"), ("refract", "port", "label", "water"))
QUICK = "io"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Bring the tests into that order."""
    rooms: dict[str, list[pytest.Item]] = {}
    for item in items:
        room = item.path.relative_to(Path(__file__).parent).parts[0]
        rooms.setdefault(room, []).append(item)
    one, two = ([item for room in begin for item in rooms.pop(room, [])] for begin in BEGIN)
    quick = rooms.pop(QUICK, [])
    two += [item for others in rooms.values() for item in others]
    middle = max(0, len(items) // 2 - len(one))
    items[:] = [*one, *quick[:middle], *two, *quick[middle:]]

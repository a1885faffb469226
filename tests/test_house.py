"""The import rules: which room may import which, and who opens files."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from pcfix.kernels import KERNEL_SOURCES

HOUSE = Path(__file__).parents[1] / "pcfix"

# The floors, from the ground up. What shares a floor stands side by side; a file may import from
# lower floors and from its own room. "pcfix" is the front door, pcfix/__init__.py.
FLOORS = (
    ("version", "errors", "qgis"),
    ("running",),
    ("kernels",),
    ("options",),
    ("model",),
    ("sums",),
    ("lens",),
    ("water",),
    ("points",),
    ("refract",),
    ("port",),
    ("adjust",),
    ("grid", "compare"),
    ("photos",),
    ("simulate",),
    ("io",),
    ("report",),
    ("flow",),
    ("pcfix",),
    ("pdal_stage",),
    ("cli",),
    ("__main__",),
)
# The simulator checks the rooms that correct, so it may not use what they do.
TWINS = {"simulate": {"points", "refract", "port", "adjust", "grid", "compare"}}

FILE_LIBRARIES = {
    "laspy",
    "rasterio",
    "pyproj",
    "fiona",
    "pyogrio",
    "PIL",
    "tifffile",
    "jpeglib",
    "rioxarray",
    "geopandas",
}
OPENING = {"read_text", "read_bytes", "write_text", "write_bytes"}
# Files and libraries of files outside io/, with the reason.
OUTSIDE_IO = {
    "pcfix.qgis.command": "it runs in QGIS's Python, without pcfix",
    "pcfix.qgis.provider": "as its neighbour",
    "pcfix.kernels": "the folder of the cache is named by a hash of the kernels",
}


def name_of(path: Path) -> str:
    parts = path.relative_to(HOUSE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def trees() -> dict[str, ast.Module]:
    return {name_of(path): ast.parse(path.read_text("utf-8")) for path in HOUSE.rglob("*.py")}


def imported(name: str, node: ast.AST) -> set[str]:
    """Return the full names that one statement imports, a file where it names one."""
    if isinstance(node, ast.Import):
        return {alias.name for alias in node.names}
    if not isinstance(node, ast.ImportFrom):
        return set()
    base = node.module or ""
    if node.level:
        is_package = HOUSE.parent.joinpath(*name.split("."), "__init__.py").exists()
        parts = name.split(".")[: None if is_package else -1]
        parts = parts[: len(parts) - node.level + 1]
        base = ".".join([*parts, *base.split(".")] if base else parts)
    whole = {f"{base}.{alias.name}" for alias in node.names}
    return {one if one in trees() else base for one in whole}


@cache
def imports() -> dict[str, set[str]]:
    """Return what every file imports: at its top, for its types alone, and inside functions."""
    return {
        name: {found for node in ast.walk(tree) for found in imported(name, node)} - {name}
        for name, tree in trees().items()
    }


def without_types(node: ast.AST) -> Iterator[ast.AST]:
    """Walk through what is run: all but what stands under ``if TYPE_CHECKING``."""
    yield node
    if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
        return
    for child in ast.iter_child_nodes(node):
        yield from without_types(child)


def room_of(name: str) -> str:
    return name.split(".")[1] if "." in name else "pcfix"


def arrows() -> list[tuple[str, str]]:
    return [
        (one, other)
        for one, others in sorted(imports().items())
        for other in sorted(others)
        if other.split(".")[0] == "pcfix"
    ]


def circle() -> list[str]:
    """Return files that import each other in a circle, or none."""
    graph = {one: others & trees().keys() for one, others in imports().items()}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as found:
        return found.args[1]
    return []


def opened(node: ast.AST) -> str:
    """Return how a node opens a file, or nothing."""
    if not isinstance(node, ast.Call):
        return ""
    if isinstance(node.func, ast.Name) and node.func.id == "open":
        return "open"
    if isinstance(node.func, ast.Attribute) and node.func.attr in OPENING | {"open"}:
        return f".{node.func.attr}"
    return ""


def test_every_room_has_a_floor() -> None:
    rooms = {room_of(name) for name in trees()}
    assert rooms == {room for floor in FLOORS for room in floor}


def test_no_arrow_upward() -> None:
    floor = {room: at for at, floor in enumerate(FLOORS) for room in floor}
    upward = [
        f"{one} -> {other}"
        for one, other in arrows()
        if room_of(one) != room_of(other) and floor[room_of(other)] >= floor[room_of(one)]
    ]
    assert not upward, "\n".join(upward)


@pytest.mark.parametrize("room", TWINS)
def test_simulator_is_independent(room: str) -> None:
    borrowed = [a for a in arrows() if room_of(a[0]) == room and room_of(a[1]) in TWINS[room]]
    assert not borrowed, borrowed


def test_no_circle() -> None:
    assert not circle()


def test_only_io_opens_files() -> None:
    found = []
    for name, tree in trees().items():
        if room_of(name) == "io" or name in OUTSIDE_IO:
            continue
        nodes = list(without_types(tree))
        names = {other.split(".")[0] for node in nodes for other in imported(name, node)}
        found += [f"{name} imports {library}" for library in sorted(names & FILE_LIBRARIES)]
        found += [f"{name} line {node.lineno}: {opened(node)}" for node in nodes if opened(node)]
    assert not found, "\n".join(found)


def test_exceptions_exist() -> None:
    assert OUTSIDE_IO.keys() <= trees().keys()


def test_help_is_light() -> None:
    program = (
        "import sys\n"
        "from pcfix import cli\n"
        "sys.argv = ['pcfix', '--help']\n"
        "try:\n    cli.main()\nexcept SystemExit:\n    pass\n"
        "print(sorted({'numba', 'scipy', 'matplotlib', 'laspy'} & sys.modules.keys()))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert "Usage" in done.stdout
    assert done.stdout.splitlines()[-1] == "[]"


def test_kernels_are_hashed() -> None:
    """An edited kernel is compiled again: the name of the cache has a hash of these sources."""
    hashed = {path for part in KERNEL_SOURCES for path in HOUSE.glob(part)}
    with_kernels = {
        path
        for path in HOUSE.rglob("*.py")
        if any(word in path.read_text("utf-8") for word in ("\n@kernel", "\n@device"))
    }
    assert with_kernels <= hashed

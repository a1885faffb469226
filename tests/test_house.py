"""The plan of the house: who may import whom, who opens files, how many parameters are many."""

from __future__ import annotations

import ast
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from collections.abc import Iterator

HOUSE = Path(__file__).parents[1] / "pcfix"

# The floors, from the ground up. What shares a floor stands side by side; a file may import from
# lower floors and from its own room. "pcfix" is the front door, pcfix/__init__.py.
FLOORS = (
    ("version", "errors", "blocks", "qgis"),
    ("libraries",),
    ("kernels",),
    ("options",),
    ("model", "sums"),
    ("lens",),
    ("water",),
    ("label",),
    ("refract",),
    ("port",),
    ("adjust",),
    ("clean",),
    ("grid", "compare", "photos"),
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
TWINS = {"simulate": {"label", "refract", "port", "adjust", "clean", "grid", "compare"}}

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

MOST_PARAMETERS = 9


def name_of(path: Path) -> str:
    parts = path.relative_to(HOUSE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def trees() -> dict[str, ast.Module]:
    return {name_of(path): ast.parse(path.read_text("utf-8")) for path in HOUSE.rglob("*.py")}


def is_package(name: str) -> bool:
    return (HOUSE.parent.joinpath(*name.split(".")) / "__init__.py").exists()


def imported(name: str, node: ast.AST) -> set[str]:
    """Return the full names that one statement imports, a file where it names one."""
    if isinstance(node, ast.Import):
        return {alias.name for alias in node.names}
    if not isinstance(node, ast.ImportFrom):
        return set()
    base = node.module or ""
    if node.level:
        parts = name.split(".")[: None if is_package(name) else -1]
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


def circles() -> list[list[str]]:
    """Return the groups of files that reach each other (Tarjan 1972)."""
    graph = {one: others & trees().keys() for one, others in imports().items()}
    number: dict[str, int] = {}
    lowest: dict[str, int] = {}
    stack: list[str] = []
    found = []

    def visit(name: str) -> None:
        number[name] = lowest[name] = len(number)
        stack.append(name)
        for other in graph[name]:
            if other not in number:
                visit(other)
                lowest[name] = min(lowest[name], lowest[other])
            elif other in stack:
                lowest[name] = min(lowest[name], number[other])
        if lowest[name] == number[name]:
            at = stack.index(name)
            if len(stack) - at > 1:
                found.append(sorted(stack[at:]))
            del stack[at:]

    for name in graph:
        if name not in number:
            visit(name)
    return found


def functions() -> list[tuple[str, int]]:
    """Return every function and method by its full name, with the number of its parameters."""
    found = []

    def walk(name: str, node: ast.AST) -> None:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                inner = f"{name}.{child.name}"
                if not isinstance(child, ast.ClassDef):
                    a = child.args
                    names = [p.arg for p in (*a.posonlyargs, *a.args, *a.kwonlyargs)]
                    found.append((inner, len(names) - (names[:1] in (["self"], ["cls"]))))
                walk(inner, child)
            else:
                walk(name, child)

    for name, tree in trees().items():
        walk(name, tree)
    return found


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
def test_the_twin_borrows_nothing(room: str) -> None:
    borrowed = [a for a in arrows() if room_of(a[0]) == room and room_of(a[1]) in TWINS[room]]
    assert not borrowed, borrowed


def test_no_circle() -> None:
    assert not circles(), "\n".join(" ".join(circle) for circle in circles())


def test_files_are_the_business_of_io() -> None:
    found = []
    for name, tree in trees().items():
        if room_of(name) == "io" or name in OUTSIDE_IO:
            continue
        nodes = list(without_types(tree))
        names = {other.split(".")[0] for node in nodes for other in imported(name, node)}
        found += [f"{name} imports {library}" for library in sorted(names & FILE_LIBRARIES)]
        found += [f"{name} line {node.lineno}: {opened(node)}" for node in nodes if opened(node)]
    assert not found, "\n".join(found)


def test_exceptions_still_are_some() -> None:
    assert OUTSIDE_IO.keys() <= trees().keys()


def test_few_parameters() -> None:
    many = [f"{n}: {c}" for n, c in functions() if c > MOST_PARAMETERS]
    assert not many, "\n".join(many)


def test_help_loads_nothing_heavy() -> None:
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


def test_a_comparison_loads_no_adjustment_to_tell_its_figures() -> None:
    program = "import sys, pcfix.report.comparison\nprint('pcfix.adjust' in sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert done.stdout == "False\n"


SCALARS = {
    "float", "int", "bool", "None", "tuple", "Vector", "Symmetric", "Nine", "Path",
    "Found", "Ray", "Gradients", "Jacobian", "Pyramid", "Seen", "Sight",
}  # fmt: skip


PARTS = {"part", "lean", "inlined", "summed"}
COMPILED = PARTS | {"kernel", "lean_kernel"}


def compiled_by(node: ast.AST) -> str:
    """Return which decorator of `pcfix.kernels` compiles a function, or nothing."""
    found = getattr(node, "decorator_list", [])
    return next((d for d in map(ast.unparse, found) if d in COMPILED), "")


def run_by_python(node: ast.AST) -> Iterator[str]:
    """Yield the names of the file that Python reads, and not from within a compiled function."""
    if compiled_by(node):
        return
    own = set()
    if isinstance(node, ast.FunctionDef | ast.Lambda):
        own = {n.arg for n in ast.walk(node) if isinstance(n, ast.arg)}
        own |= {
            n.id for n in ast.walk(node) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)
        }
    if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load):
        yield node.id
    for child in ast.iter_child_nodes(node):
        yield from (name for name in run_by_python(child) if name not in own)


def test_only_kernels_call_parts() -> None:
    """Python could, but would wait each time: they are not kept."""
    parts = {
        f"{name}.{node.name}"
        for name, tree in trees().items()
        for node in tree.body
        if isinstance(node, ast.FunctionDef) and compiled_by(node) in PARTS
    }
    found = []
    for name, tree in trees().items():
        known = {one.rpartition(".")[2]: one for one in parts if one.rpartition(".")[0] == name}
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom):
                full = {
                    alias.asname or alias.name: f"{node.module}.{alias.name}"
                    for alias in node.names
                }
                known |= {short: one for short, one in full.items() if one in parts}
        found += [f"{name}: {known[one]}" for one in set(run_by_python(tree)) & known.keys()]
    assert not found, "\n".join(found)


def test_lean_kernels_return_numbers() -> None:
    """They do not count references to arrays: one that they hand out could be gone by then."""
    found = []
    for name, tree in trees().items():
        for node in tree.body:
            if not isinstance(node, ast.FunctionDef):
                continue
            by = {ast.unparse(decorator) for decorator in node.decorator_list}
            assert "njit" not in " ".join(by), f"{name}.{node.name}: take pcfix.kernels"
            returned = (
                {n.id for n in ast.walk(node.returns) if isinstance(n, ast.Name)}
                if (node.returns)
                else set()
            )
            if by & {"lean", "lean_kernel", "inlined", "summed"} and not returned <= SCALARS:
                found.append(f"{name}.{node.name}: {sorted(returned - SCALARS)}")
    assert not found, "\n".join(found)

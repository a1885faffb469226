"""Compiled kernels are cached, and compiled again when any of their sources changes."""

import ast
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from pcfix import kernels
from tests.utils.nightly import mostly_nightly

VARIABLES = ("XDG_CACHE_HOME", "NUMBA_CACHE_DIR")
PACKAGE = Path(kernels.__file__).parent
PROGRAM = """
import numpy as np
from pcfix import kernels
from pcfix.lens import formulas
table = np.zeros(40)
table[formulas.LARGEST_RADIUS] = 3.0
formulas.angle(table, 0.1)
stats = formulas.angle.stats
print(kernels.cache_folder(), sum(stats.cache_hits.values()))
"""


@pytest.fixture(scope="module")
def package(tmp_path_factory):
    """A copy of the package."""
    folder = tmp_path_factory.mktemp("site") / "pcfix"
    return Path(shutil.copytree(PACKAGE, folder, ignore=shutil.ignore_patterns("__pycache__")))


def run(package, **variables):
    """Compile or load a kernel; return the folder of the cache, cache hits, and stderr."""
    own = {name: value for name, value in os.environ.items() if name not in ("NUMBA_CACHE_DIR",)}
    own |= {"PYTHONPATH": str(package.parent), **variables}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, env=own,
        cwd=package.parent, check=True,
    )  # fmt: skip
    folder, hits = done.stdout.split()
    return folder, int(hits), done.stderr


@pytest.mark.parametrize("variable", mostly_nightly(VARIABLES, VARIABLES[0]))
def test_second_run_loads(variable, package, tmp_path):
    first, again = (run(package, **{variable: str(tmp_path)}) for _ in range(2))
    assert (first[1], again[1]) == (0, 1)
    assert first[0] == again[0] and Path(first[0]).is_relative_to(tmp_path)


def test_imported_source_changes(package, tmp_path):
    """numba itself compares a kernel with its own file only."""
    first = run(package, NUMBA_CACHE_DIR=str(tmp_path))
    with (package / "model.py").open("a") as stream:
        stream.write("# changed\n")
    assert run(package, NUMBA_CACHE_DIR=str(tmp_path))[0] != first[0]


@pytest.mark.parametrize("variable", mostly_nightly(VARIABLES, VARIABLES[0]))
def test_no_cache(variable, package):
    folder, hits, said = run(package, **{variable: "/dev/null"})
    assert (folder, hits) == ("None", 0)
    assert said.count("PcfixWarning") == 1


def test_old_caches_go(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    for number in range(9):
        (tmp_path / f"kernels-{number}").mkdir()
        os.utime(tmp_path / f"kernels-{number}", (number, number))
    kernels.cache_folder.cache_clear()
    try:
        found = kernels.cache_folder()
    finally:
        kernels.cache_folder.cache_clear()
    assert found is not None and found.is_dir()
    assert len(list(tmp_path.iterdir())) == kernels.MOST_CACHES


def test_no_arrays_returned_without_references():
    """A function that counts references must not call one that returns arrays without counting."""
    trees = [ast.parse(path.read_text()) for path in PACKAGE.rglob("*.py")]
    nodes = [node for tree in trees for node in ast.walk(tree)]
    records = {node.name: ast.unparse(node) for node in nodes if isinstance(node, ast.ClassDef)}
    holding = {name for name, text in records.items() if "NamedTuple" in text and "Array" in text}
    counting, silent = [], set()
    for node in nodes:
        marks = [ast.unparse(one) for one in getattr(node, "decorator_list", [])]
        if any(one.startswith(("kernel", "device")) for one in marks):
            if "allocates=True" in "".join(marks):
                counting.append(node)
            elif re.search(rf"Array|\b({'|'.join(holding)})\b", ast.unparse(node.returns)):
                silent.add(node.name)
    assert counting and silent
    for node in counting:
        called = {one.func.id for one in ast.walk(node) if isinstance(one, ast.Call)
                  and isinstance(one.func, ast.Name)}  # fmt: skip
        assert not called & silent, node.name

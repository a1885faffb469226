"""A real PDAL: the program, and its Python package in processes of their own."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PROGRAM = Path(sys.executable).with_name("pdal")
IS_THERE = PROGRAM.exists() and importlib.util.find_spec("pdal") is not None

if os.environ.get("PCFIX_NEEDS_PDAL") and not IS_THERE:
    raise RuntimeError(f"PCFIX_NEEDS_PDAL is set, but {PROGRAM} or the package pdal is missing")

needs_pdal = pytest.mark.skipif(
    not IS_THERE, reason="no PDAL in this environment; tests/install_pdal.sh makes one that has it"
)


def pdal(*arguments: object, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run the pdal program in a folder."""
    return _run([PROGRAM, *arguments], folder)


def python(program: str, *arguments: object, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a Python program in a folder."""
    return _run([sys.executable, "-c", program, *arguments], folder)


def _run(command: list[object], folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(word) for word in command],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
        env={**os.environ, "PATH": f"{PROGRAM.parent}:{os.environ['PATH']}"},
    )

"""A package that others installed, run by a user without rights: in a container, on a cluster."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

import pcfix
from tests.test_kept import PROGRAM

PACKAGE = Path(pcfix.__file__).parent
NOBODY = 54_321
"""No user has this number: it has no name and no home."""
WRITABLE = ("/tmp", "/var/tmp", "/usr/tmp", "/dev/shm")


@pytest.fixture(scope="module")
def site():
    """A folder with a copy of the package, without kernels, which that user may read alone."""
    if as_nobody("/", "pass", ok=False) is None:
        pytest.skip("only root, with setpriv, may run something as another user")
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:  # pytest's own may be closed
        place = Path(folder)
        shutil.copytree(PACKAGE, place / "pcfix", ignore=shutil.ignore_patterns("__pycache__"))
        place.chmod(0o755)
        (place / "own").mkdir()
        os.chown(place / "own", NOBODY, NOBODY)
        yield place


def as_nobody(site, program, *, ok=True, before=(), **variables):
    """Run a program as a user without name, home and rights, but to read the Python in use."""
    may_read = [f"--{kind}=+dac_read_search" for kind in ("inh-caps", "ambient-caps")]
    change = ["setpriv", f"--reuid={NOBODY}", f"--regid={NOBODY}", "--clear-groups", *may_read]
    own = {"PATH": os.environ["PATH"], "PYTHONPATH": str(site), "PYTHONDONTWRITEBYTECODE": "1"}
    words = [*before, *change, sys.executable, "-c", program, "", "-", "-"]
    try:
        done = subprocess.run(words, capture_output=True, text=True, env=own | variables, cwd=site)
    except FileNotFoundError:  # no setpriv
        return None
    assert done.returncode == 0 or not ok, done.stderr
    return None if done.returncode else done


def test_kernels_are_kept_in_a_private_folder_of_the_temporary_ones(site):
    first = as_nobody(site, PROGRAM, TMPDIR=str(site / "own"))
    assert "compiles" in first.stdout and first.stderr == ""
    folder = site / "own" / f"pcfix-{NOBODY}"
    assert folder.stat().st_mode & 0o777 == 0o700
    assert list(folder.rglob("*.nbc"))
    assert not list((site / "pcfix").rglob("*.nb?"))
    for home in ({}, {"HOME": "/root"}, {"HOME": str(site)}):
        again = as_nobody(site, PROGRAM, TMPDIR=str(site / "own"), **home)
        assert again.stderr == ""
        assert again.stdout == first.stdout.replace("compiles\n", "")


def test_where_nothing_can_be_written_kernels_are_in_memory_and_that_is_said_once(site):
    if shutil.which("unshare") is None:
        pytest.skip("no unshare here")
    there = [folder for folder in WRITABLE if Path(folder).is_dir()]
    mounts = [f"mount --bind {one} {one} && mount -o remount,bind,ro {one}" for one in there]
    closed = ["unshare", "--mount", "sh", "-c", f'{" && ".join(mounts)} && exec "$@"', "sh"]
    if subprocess.run([*closed, "true"], capture_output=True).returncode:
        pytest.skip("folders cannot be made read-only here")
    done = as_nobody(site, PROGRAM, before=closed)
    assert "compiles" in done.stdout
    assert done.stderr.count("PcfixWarning: Kernels are compiled each time anew") == 1

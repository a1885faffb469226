"""Outputs that appear when they are complete.

A file is written under a hidden name next to its target, flushed to the disk, and renamed. What a
killed process leaves is that hidden file; the next command that writes the same target removes it.
"""

from __future__ import annotations

import errno
import glob
import os
import secrets
import shutil
import stat
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path

from pcfix.errors import InputError, bad_file

LEAST_FREE_BYTES = 65_536
"""With less free space than this, a library that fails without a reason found the disk full."""

_group: ContextVar[tuple[ExitStack, dict[Path, Path]] | None] = ContextVar("_group", default=None)
"""What `all_or_none` tidies up, and the temporary file of each target."""


@contextmanager
def temporary_path(target: Path) -> Iterator[Path]:
    """Give a hidden path next to a target; whatever is there when the block ends is removed."""
    folder, name = target.absolute().parent, target.name
    for path in folder.glob(f".{glob.escape(name)}.{8 * '[0-9a-f]'}.part*"):
        _remove(path)  # a killed process left it
    path = folder / f".{name}.{secrets.token_hex(4)}.part{target.suffix}"
    try:
        yield path
    finally:
        _remove(path)


@contextmanager
def temporary_output(target: Path, *, is_folder: bool = False) -> Iterator[Path]:
    """Give a path to write to, and rename what is there to the target when the block ends well.

    The new file has the permissions of the one that it replaces. Within `all_or_none` it is renamed
    when that block ends. A folder is made, and replaces the one that is there.
    """
    group = _group.get()
    with ExitStack() as own:
        path = (group[0] if group else own).enter_context(temporary_path(target))
        with _write_errors(target, path):
            if is_folder:
                path.mkdir()
            yield path
            if target.is_file():
                path.chmod(stat.S_IMODE(target.stat().st_mode))
            for one in (path, *path.rglob("*")):
                _flush(one)
        if group:
            group[1][target] = path
        else:
            _rename(path, target)


@contextmanager
def all_or_none(folder: Path | None = None) -> Iterator[None]:
    """Let the files that are written in the block appear when it ends well, or none of them.

    A folder is made for them, and removed again if it is new and the block fails.
    """
    complete: dict[Path, Path] = {}
    with ExitStack() as stack:
        if folder is not None and not folder.exists():
            with _write_errors(folder, folder):
                folder.mkdir(parents=True)
            stack.callback(_remove_empty, folder)
        token = _group.set((stack, complete))
        try:
            yield
        finally:
            _group.reset(token)
        for target, path in complete.items():
            _rename(path, target)


@contextmanager
def scratch_folder(target: Path) -> Iterator[Path]:
    """Give a folder next to a target for intermediate files; it is removed when the block ends."""
    with temporary_path(target.with_name(f"{target.name}.scratch")) as path:
        with _write_errors(target, path):
            path.mkdir()
        yield path


def cannot_write(target: Path, error: Exception, written: Path | None = None) -> InputError:
    """Return the error for a file that cannot be written; `written` is its temporary path."""
    if is_full_disk(target.absolute().parent, error):
        sentence = "no space left on the disk. Free some space, or write to another disk."
        return bad_file(target, "output.disk_full", sentence)
    reason = getattr(error, "strerror", None) or str(error).strip().rstrip(".")
    reason = reason.replace(str(written), target.name)
    return bad_file(target, "output.cannot_write", f"cannot be written ({reason}).")


def is_full_disk(folder: Path, error: Exception) -> bool:
    """Whether something failed because the disk is full, which libraries may not say."""
    if isinstance(error, OSError) and error.errno is not None:
        return error.errno in (errno.ENOSPC, errno.EDQUOT)
    if any(words in str(error) for words in ("No space left", "disk is full")):
        return True
    with suppress(OSError):
        return shutil.disk_usage(folder).free < LEAST_FREE_BYTES
    return False


@contextmanager
def _write_errors(target: Path, path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise cannot_write(target, error, path) from error


def _rename(path: Path, target: Path) -> None:
    with _write_errors(target, path), ExitStack() as stack:
        if path.is_dir() and target.exists():  # a folder that is not empty cannot be replaced
            aside = target.with_name(f"{target.name}.old")
            target.rename(stack.enter_context(temporary_path(aside)))
        path.replace(target)
    _flush(target.parent)


def _flush(path: Path) -> None:
    """Let what was written reach the disk, where the file system can say so."""
    with suppress(OSError):
        opened = os.open(path, os.O_RDONLY)
        try:
            os.fsync(opened)
        finally:
            os.close(opened)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()


def _remove_empty(folder: Path) -> None:
    with suppress(OSError):  # it holds the files of the block, or of somebody else
        folder.rmdir()

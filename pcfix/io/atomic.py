"""Outputs that appear when they are complete.

A file is written under a hidden name beside its target, flushed to the disk, and renamed. What a
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
from typing import NamedTuple

from pcfix.errors import InputError

LEAST_FREE_BYTES = 65_536
"""With less free space than this, a library that fails without a reason found the disk full."""


class _Group(NamedTuple):
    """Files that appear together."""

    stack: ExitStack
    complete: dict[Path, Path]


_group: ContextVar[_Group | None] = ContextVar("_group", default=None)


@contextmanager
def temporary_path(target: Path) -> Iterator[Path]:
    """Give a hidden path beside a target; whatever is there when the block ends is removed."""
    folder, name = target.absolute().parent, target.name
    for path in folder.glob(f".{glob.escape(name)}.{8 * '[0-9a-f]'}.part*"):
        _remove(path)  # a killed process left it
    path = folder / f".{name}.{secrets.token_hex(4)}.part{target.suffix}"
    try:
        yield path
    finally:
        _remove(path)


@contextmanager
def temporary_output(target: Path) -> Iterator[Path]:
    """Give a path to write to, and rename what is there to the target when the block ends well.

    The new file has the permissions of the one that it replaces. Within `all_or_none` the file is
    renamed when that block ends.

    Raises
    ------
    InputError
        ``output.disk_full`` or ``output.cannot_write``.
    """
    group = _group.get()
    with ExitStack() as stack:
        path = (stack if group is None else group.stack).enter_context(temporary_path(target))
        with _errors_of(target, path):
            yield path
            if target.is_file():
                path.chmod(stat.S_IMODE(target.stat().st_mode))
            _flush(path)
        if group is None:
            _rename(path, target)
        else:
            group.complete[target] = path


@contextmanager
def all_or_none() -> Iterator[None]:
    """Let the files that are written in the block appear when it ends well, or none of them."""
    with ExitStack() as stack:
        group = _Group(stack, {})
        token = _group.set(group)
        try:
            yield
        finally:
            _group.reset(token)
        for target, path in group.complete.items():
            _rename(path, target)


@contextmanager
def temporary_folder(target: Path) -> Iterator[Path]:
    """Give a folder to write into, which replaces the target when the block ends well."""
    with temporary_path(target) as path, _errors_of(target, path):
        path.mkdir()
        yield path
        for one in path.rglob("*"):
            _flush(one)
        if target.exists():
            with temporary_path(target.with_name(f"{target.name}.old")) as old:
                target.rename(old)
                path.replace(target)
        else:
            path.replace(target)
        _flush(target.parent)


@contextmanager
def scratch_folder(target: Path) -> Iterator[Path]:
    """Give a folder beside a target for intermediate files; it is removed when the block ends.

    Enter it after `temporary_output` of the same target, which removes what it finds.
    """
    with temporary_path(target.with_name(f"{target.name}.scratch")) as path:
        try:
            path.mkdir()
        except OSError as error:
            raise cannot_write(target, error) from error
        yield path


@contextmanager
def output_folder(folder: Path) -> Iterator[None]:
    """Make a folder for what the block writes; remove a new one again if the block fails."""
    is_new = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(folder, error) from error
    try:
        yield
    except BaseException:
        if is_new:
            with suppress(OSError):  # it stays if somebody else has put a file into it
                folder.rmdir()
        raise


def cannot_write(target: Path, error: Exception, written: Path | None = None) -> InputError:
    """Return the error for a file that cannot be written; `written` is its temporary path."""
    if is_full_disk(target.absolute().parent, error):
        return InputError(
            "output.disk_full",
            f"{target}: no space left on the disk of {disk_of(target)}. Free some space, or write"
            " to another disk.",
            path=target,
        )
    reason = getattr(error, "strerror", None) or str(error).strip().rstrip(".")
    if written is not None:
        reason = reason.replace(str(written), target.name)
    return InputError(
        "output.cannot_write", f"{target}: cannot be written ({reason}).", path=target
    )


def disk_of(path: Path) -> str:
    """Describe where the disk of a path is mounted, and how much of it is free."""
    around = Path(os.path.realpath(path)).parents
    mount = next((one for one in around if one.is_mount()), around[-1])
    with suppress(OSError):
        return f"{mount} ({shutil.disk_usage(mount).free / 1e6:,.1f} MB free)"
    return str(mount)


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
def _errors_of(target: Path, path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise cannot_write(target, error, path) from error


def _rename(path: Path, target: Path) -> None:
    with _errors_of(target, path):
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

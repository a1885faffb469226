"""What is being written: in a hidden folder beside its target, and renamed when it is whole.

The folder has a random name and is its owner's alone. As long as its owner lives, a lock is held in
it: a folder whose lock is free was left by a process that was killed, and the next draft beside it
removes it.
"""

from __future__ import annotations

import errno
import os
import secrets
import shutil
import stat
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from typing import NamedTuple

from pcfix.errors import InputError

try:
    import fcntl
except ImportError:  # not on Windows: what a killed process leaves stays there
    fcntl = None  # type: ignore[assignment]

_PREFIX, _SUFFIX, _LOCK = ".pcfix-", ".part", "lock"
_NEW, _NEW_S = "new", 60.0
_FULL = (errno.ENOSPC, errno.EDQUOT)


@contextmanager
def draft_folder(parent: Path) -> Iterator[Path]:
    """Give a new folder inside another, for what need not last; it goes when the block ends."""
    _remove_orphans(parent)
    folder = parent.absolute() / f"{_PREFIX}{secrets.token_hex(8)}{_SUFFIX}"
    lock = None
    try:
        folder.mkdir(0o700)
        lock = _lock(folder)
        yield folder
    finally:
        try:
            shutil.rmtree(folder, ignore_errors=True)
        except KeyboardInterrupt:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        finally:
            if lock is not None:
                os.close(lock)


@contextmanager
def replaced_when_whole(target: Path) -> Iterator[Path]:
    """Give a path to write to, and rename what is there to the target once the block ends well.

    The name is that of the target. Whatever goes wrong, nothing is left behind; what is renamed is
    on the disk, and has the mode of the file that it replaces.
    """
    together = _together.get()
    with ExitStack() as stack:
        draft = (stack if together is None else together.drafts).enter_context(_draft(target))
        with _sentences(target, draft):
            yield draft
            if target.is_file():
                draft.chmod(stat.S_IMODE(target.stat().st_mode))
            _settle(draft)
        if together is None:
            _rename(draft, target)
        else:
            together.whole[target] = draft


@contextmanager
def all_or_none() -> Iterator[None]:
    """Let the files that are written in the block appear when it ends well, or none of them."""
    with ExitStack() as drafts:
        together = _Together(drafts, {})
        token = _together.set(together)
        try:
            yield
        finally:
            _together.reset(token)
        for target, draft in together.whole.items():
            _rename(draft, target)


class _Together(NamedTuple):
    drafts: ExitStack
    whole: dict[Path, Path]


_together: ContextVar[_Together | None] = ContextVar("_together", default=None)


def _rename(draft: Path, target: Path) -> None:
    with _sentences(target, draft):
        draft.replace(target)
    _settle(target.parent)


@contextmanager
def folder_when_whole(target: Path) -> Iterator[Path]:
    """Give a folder to write into, which takes the place of the target once the block ends well.

    An older folder of that name goes as a whole, with whatever it held.
    """
    with _draft(target) as draft, _sentences(target, draft):
        draft.mkdir()
        yield draft
        for path in draft.rglob("*"):
            _settle(path)
        if target.exists():
            target.rename(draft.parent / "old")
        draft.replace(target)
        _settle(target.parent)


def cannot_write(
    target: Path, error: Exception, written: Path | None = None, needed: int = 0
) -> InputError:
    """Return the sentence on a file that cannot be written, of which a part may be.

    Where the disk is full it names that, and the bytes that are `needed`, if they are known.
    """
    reason = getattr(error, "strerror", None) or str(error).strip().rstrip(".")
    if getattr(error, "errno", None) in _FULL or "No space left" in str(error):
        size = 0 if written is None or not written.is_file() else written.stat().st_size
        so_far = f" after {size / 1e6:,.1f} MB of it" if size > 1e5 else ""
        wanted = f", up to {needed / 1e6:,.1f} MB are needed" if needed else ""
        reason = f"No space left on the disk {disk_of(target)}{so_far}{wanted}; make room on it"
    return InputError(f"{target}: cannot be written ({reason}).")


def disk_of(path: Path) -> str:
    """Return where the disk of a path is mounted, and how much of it is free."""
    around = Path(os.path.realpath(path)).parents
    mount = next((one for one in around if one.is_mount()), around[-1])
    try:
        free = f" ({shutil.disk_usage(mount).free / 1e6:,.1f} MB free)"
    except OSError:
        free = ""
    return f"{mount}{free}"


@contextmanager
def _draft(target: Path) -> Iterator[Path]:
    """Give a place beside the target."""
    with ExitStack() as stack:
        try:
            folder = stack.enter_context(draft_folder(target.parent))
        except OSError as error:
            raise cannot_write(target, error) from error
        yield folder / target.name


@contextmanager
def _sentences(target: Path, draft: Path) -> Iterator[None]:
    """Turn what the system refuses into a sentence."""
    try:
        yield
    except OSError as error:
        raise cannot_write(target, error, draft) from error


def _settle(path: Path) -> None:
    """Let what was written reach the disk, where the file system can tell."""
    with suppress(OSError):
        opened = os.open(path, os.O_RDONLY)
        try:
            os.fsync(opened)
        finally:
            os.close(opened)


def _lock(folder: Path) -> int | None:
    """Hold the lock of a folder; it has its name only once it is held.

    Where a file system has no locks it keeps the other name, and the folder is left alone.
    """
    if fcntl is None:
        return None
    new = folder / _NEW
    opened = os.open(new, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o600)
    with suppress(OSError):
        fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
        new.rename(folder / _LOCK)
    return opened


def _remove_orphans(parent: Path) -> None:
    """Remove the folders of processes that are gone."""
    if fcntl is None:
        return
    for folder in parent.glob(f"{_PREFIX}*{_SUFFIX}"):
        with suppress(OSError):
            lock = folder / _LOCK
            if not lock.exists():  # its owner was stopped before it held it, or while it tidied up
                if time.time() - folder.stat().st_mtime < _NEW_S:
                    continue
                lock = folder / _NEW
            if not lock.exists():
                shutil.rmtree(folder, ignore_errors=True)
                continue
            opened = os.open(lock, os.O_RDWR | os.O_NOFOLLOW)
            try:
                fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder, ignore_errors=True)
            finally:
                os.close(opened)

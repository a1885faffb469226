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
_FULL_WORDS = ("No space left", "disk is full")
_LEAST_FREE_BYTES = 65_536
"""With less than that free, whatever fails without saying why has found no space."""


class NoRoomError(OSError):
    """There is no space for a file; `most_bytes` is what it takes at most, if that is known."""

    def __init__(self, most_bytes: int | None = None) -> None:
        super().__init__(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self.most_bytes = most_bytes


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


@contextmanager
def made_folder(folder: Path) -> Iterator[None]:
    """Make a folder for what the block writes; a new one goes again if the block fails."""
    is_new = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(folder, error) from error
    try:
        yield
    except BaseException:
        if is_new:
            with suppress(OSError):  # not where others have put something into it
                folder.rmdir()
        raise


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
    target: Path, error: Exception, written: Path | None = None, most_bytes: int | None = None
) -> InputError:
    """Return the sentence on a file that cannot be written, of which a part may be.

    With `most_bytes` it says what the file would have taken at most, if it found no space.
    """
    folder, reason = target.absolute().parent, str(error).strip().rstrip(".")
    most_bytes = getattr(error, "most_bytes", most_bytes)
    if is_full_disk(folder, error, most_bytes):
        size = 0 if written is None or not written.is_file() else written.stat().st_size
        so_far = f" after {_size(size)} of it" if size else ""
        most = "" if most_bytes is None else f", which takes at most {_size(most_bytes)}"
        reason = f"No space left on the disk of {disk_of(target)}{so_far}{most}; make room on it"
    elif getattr(error, "strerror", None):
        reason = str(getattr(error, "strerror", None))
    elif written is not None:
        reason = reason.replace(str(written), target.name)
    return InputError(f"{target}: cannot be written ({reason}).")


def disk_of(path: Path) -> str:
    """Return where the disk of a path is mounted, and how much of it is free."""
    around = Path(os.path.realpath(path)).parents
    mount = next((one for one in around if one.is_mount()), around[-1])
    try:
        free = f" ({_size(shutil.disk_usage(mount).free)} free)"
    except OSError:
        free = ""
    return f"{mount}{free}"


def is_full_disk(folder: Path, error: Exception, most_bytes: int | None = None) -> bool:
    """Whether something failed as the disk of a folder is full, which libraries may not say.

    Then it is if less is free than what is written takes at most.
    """
    if isinstance(error, OSError) and error.errno is not None:
        return error.errno in _FULL
    if any(words in str(error) for words in _FULL_WORDS):
        return True
    try:
        return shutil.disk_usage(folder).free < max(_LEAST_FREE_BYTES, most_bytes or 0)
    except OSError:
        return False


def _size(count: int) -> str:
    """Return a number of bytes in the unit that suits it."""
    if count < 1_000_000:
        return f"{max(count, 1000) / 1e3:,.0f} kB"
    return f"{count / 1e6:,.1f} MB" if count < 1e9 else f"{count / 1e9:,.1f} GB"


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

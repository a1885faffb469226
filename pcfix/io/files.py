"""Rules for every file that pcfix writes: whole or not at all, and never over another's work."""

from __future__ import annotations

import hashlib
import json
import os
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pcfix.errors import InputError, SettingError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator


def check_input(path: str | os.PathLike[str]) -> Path:
    """Return the path of a file that exists.

    Raises
    ------
    InputError
        If there is no such file.
    """
    found = Path(path)
    if not found.is_file():
        raise InputError(f"{found}: there is no such file.")
    return found


def files_in(path: str | os.PathLike[str]) -> list[Path]:
    """Return a file, or the files directly in a folder, in the order of their names."""
    found = Path(path)
    if found.is_dir():
        return sorted(one for one in found.iterdir() if one.is_file())
    return [check_input(found)]


def check_output(
    path: str | os.PathLike[str], *, overwrite: bool, inputs: Iterable[str | os.PathLike[str]] = ()
) -> Path:
    """Return the path of a file that may be written.

    Raises
    ------
    SettingError
        If it is one of the inputs, exists without `overwrite`, or has no folder to be in.
    """
    target = Path(path)
    for source in inputs:
        if _is_same(target, Path(source)):
            raise SettingError(
                f"{target}: output and {source} are the same file; give the output another name."
            )
    if target.is_dir():
        raise SettingError(f"{target}: the output is a folder; give a file name.")
    if target.exists() and not overwrite:
        raise SettingError(f"{target}: the output exists; add --overwrite to replace it.")
    if not target.parent.is_dir():
        raise SettingError(f"{target}: the folder {target.parent} does not exist; make it first.")
    return target


def _is_same(one: Path, other: Path) -> bool:
    if one.exists() and other.exists():
        return one.samefile(other)
    return one.resolve() == other.resolve()


@contextmanager
def replaced_when_whole(target: Path) -> Iterator[Path]:
    """Give a name beside the target to write to, and rename it once the block ends well.

    The name keeps the target's suffix. Whatever goes wrong, nothing is left behind.
    """
    draft = target.with_name(f".{target.stem}.{os.getpid()}.part{target.suffix}")
    try:
        yield draft
        draft.replace(target)
    except OSError as error:
        raise InputError(f"{target}: cannot be written ({error.strerror or error}).") from error
    finally:
        draft.unlink(missing_ok=True)


def sha256(path: Path) -> str:
    """Return the checksum of a file, as hexadecimal digits."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def file_state(path: Path) -> dict[str, Any]:
    """Return what tells whether a file changed, in plain values."""
    if not path.exists():
        return {"path": str(path), "bytes": None}
    found = path.stat()
    return {"path": str(path), "bytes": found.st_size, "changed_ns": found.st_mtime_ns}


def read_json(path: Path) -> Any:
    """Return the content of a JSON file.

    Raises
    ------
    OSError, ValueError
        If it cannot be read, or is no JSON.
    """
    return json.loads(path.read_text("utf-8"))


def write_bytes(path: str | os.PathLike[str], data: bytes, *, overwrite: bool) -> None:
    """Write a small file under the same rules."""
    target = check_output(path, overwrite=overwrite)
    with replaced_when_whole(target) as draft:
        draft.write_bytes(data)


def write_text(path: str | os.PathLike[str], text: str, *, overwrite: bool) -> None:
    """Write a small text file under the same rules."""
    write_bytes(path, text.encode(), overwrite=overwrite)

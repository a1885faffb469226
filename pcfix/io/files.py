"""Rules for every file that pcfix reads or writes, and files that one command leaves for another.

A file replaces another only if the user asks for it, and is written completely or not at all: under
a hidden name next to its target, flushed to the disk, and renamed. What a killed process leaves is
that hidden file; the next command that writes the same target removes it.
"""

import errno
import glob
import hashlib
import io
import json
import mmap
import os
import pickle
import re
import secrets
import shutil
import stat
import subprocess
import weakref
import zipfile
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from contextvars import ContextVar
from dataclasses import fields
from importlib.resources import files
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from pcfix.errors import InputError, PcfixError, SettingError, bad_file, refusal
from pcfix.options.declare import File
from pcfix.running import Empty, running
from pcfix.sums import Sums

if TYPE_CHECKING:
    from pcfix.adjust.precision import Members


def path_of(path: Any) -> Path:
    """Return a path as an object; the address of an object store is refused."""
    if re.match(r"\w{2,}:/", str(path)):  # of s3:// a Path leaves s3:/
        sentence = "is not a local file. Copy it first, or use PDAL, which can read it."
        raise bad_file(path, "input.remote", sentence)
    return path if isinstance(path, Path) else Path(path)


def check_input(path: File) -> Path:
    """Return the path of a file; one that cannot be read is an `InputError`."""
    found = path_of(path)
    try:
        if not stat.S_ISREG(found.stat().st_mode):
            raise bad_file(found, "input.unreadable", "is a folder, pipe or device; give a file.")
        with found.open("rb") as stream:
            head = stream.read(64).lstrip().lower()
    except OSError as error:
        raise bad_file(found, "input.unreadable", f"{refusal(error)}.") from error
    if head.startswith(b"version https://git-lfs"):
        sentence = "is a Git LFS pointer, not the file. Run 'git lfs pull'."
        raise bad_file(found, "input.not_the_file", sentence)
    if head.startswith((b"<!doctype html", b"<html")):
        sentence = "is a web page, not the file. Download it again."
        raise bad_file(found, "input.not_the_file", sentence)
    return found


def is_same(one: File, other: File) -> bool:
    """Whether two names are of one file, which need not exist."""
    try:
        return Path(one).samefile(other)
    except OSError:
        return os.path.realpath(one) == os.path.realpath(other)


def files_in(path: File) -> list[Path]:
    """Return a file, or the files directly in a folder, in the order of their names."""
    found = Path(path)
    if found.is_dir():
        return sorted(one for one in found.iterdir() if one.is_file())
    return [check_input(found)]


def belonging(path: File) -> list[Path]:
    """Return what may be read where a file or folder is named.

    Of a folder that is all that it and its folders hold, but hidden files; of a project the same of
    its folder. With a file go those of its stem, and the sensor next to it, which may be missing.
    """
    found = Path(path)
    folder, chosen = found, set[Path]()
    if not found.is_dir():
        # the folder of a project of Metashape or Pix4D has the name of its file
        ends = {".psx": ".files", ".p4d": ""}
        folder = found.with_suffix(ends.get(found.suffix.lower(), found.suffix))
        alike = found.parent.glob(f"{glob.escape(found.stem)}.*")
        chosen = {check_input(found), found.with_name("sensor.csv")}
        chosen |= {one for one in alike if one.is_file()}
    inside = folder.rglob("*") if folder.is_dir() else ()
    for one in inside:
        if one.is_file() and not any(p[0] == "." for p in one.relative_to(folder).parts):
            chosen.add(one)
    return sorted(chosen)


def check_output(
    path: File, *, overwrite: bool, inputs: Iterable[File] = (), suffixes: tuple[str, ...] = ()
) -> Path:
    """Return the path of a file that may be written, with one of the suffixes if there are any."""

    def refused(code: str, sentence: str) -> SettingError:
        return SettingError(f"output.{code}", f"{target}: {sentence}", path=target)

    target = path_of(path)
    if suffixes and target.suffix.lower() not in suffixes:
        raise refused("suffix", f"the name must end in {' or '.join(suffixes)}.")
    for source in inputs:
        if is_same(target, source):
            raise refused("is_input", f"is also the input {source}. Give the output another name.")
    try:
        is_file = stat.S_ISREG(target.stat().st_mode)
    except (FileNotFoundError, NotADirectoryError):
        if not target.parent.is_dir():
            sentence = f"the folder {target.parent} does not exist. Create it first."
            raise refused("no_folder", sentence) from None
        return target
    except OSError as error:
        raise refused("cannot_write", f"{refusal(error)}.") from error
    if not is_file:
        raise refused("not_a_file", "the output is a folder, pipe or device. Give a file name.")
    if not overwrite:
        raise refused("exists", "the output exists. Add --overwrite to replace it.")
    return target


# Outputs that appear when they are complete

# What `all_or_none` tidies up, and the temporary file of each target.
_group: ContextVar[tuple[ExitStack, dict[Path, Path]] | None] = ContextVar("_group", default=None)


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
    with suppress(OSError):  # with less free space, it is why a library fails without a reason
        return shutil.disk_usage(folder).free < 65_536
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


# Contents of files


def sha256(path: Path) -> str:
    """Return the checksum of a file, as hexadecimal digits."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def read_tally(path: Path) -> tuple[str, Any]:
    """Return the pickled key and statistics of a file; an empty key if there are none."""
    try:
        with path.open("rb") as stream:
            key, tally = _Statistics(stream).load()
        return str(key), tally
    except (OSError, ValueError, TypeError, EOFError, pickle.UnpicklingError, AttributeError):
        return "", None


class _Statistics(pickle.Unpickler):
    """Reads sums and arrays only, as a pickle may run any function that it names."""

    def find_class(self, module: str, name: str) -> Any:
        found = super().find_class(module, name) if module.startswith(("pcfix.", "numpy")) else None
        of_arrays = ("_reconstruct", "_frombuffer", "ndarray", "dtype", "scalar")
        is_sums = isinstance(found, type) and issubclass(found, Sums)
        if is_sums or (module.startswith("numpy") and name in of_arrays):
            return found
        raise pickle.UnpicklingError(f"{module}.{name}")


def file_state(path: Path) -> dict[str, Any]:
    """Return size and time of a file, by which a change is recognized, in plain values."""
    if not path.exists():
        return {"path": str(path), "bytes": None}
    found = path.stat()
    return {"path": str(path), "bytes": found.st_size, "changed_ns": found.st_mtime_ns}


@contextmanager
def refusing(
    path: object, code: str, sentence: str, kinds: tuple[type[Exception], ...] = (Exception,)
) -> Iterator[None]:
    """Turn what the contents of a file raise into its error; {} in the sentence is the reason."""
    try:
        yield
    except PcfixError:
        raise
    except kinds as error:
        reason = str(error).strip().rstrip(".") or type(error).__name__
        raise bad_file(path, code, sentence.replace("{}", reason)) from error


def parse_json(text: str | bytes) -> Any:
    """Return the content of a JSON text; ValueError where it is none."""
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("its brackets are nested too deep") from error


def read_json(path: Path) -> Any:
    """Return the content of a JSON file; OSError or ValueError where it is none."""
    return parse_json(path.read_bytes())


def write_bytes(path: File, data: bytes, *, overwrite: bool) -> None:
    """Write a small file under the same rules."""
    target = check_output(path, overwrite=overwrite)
    with temporary_output(target) as temporary:
        temporary.write_bytes(data)


def write_text(path: File, text: str, *, overwrite: bool) -> None:
    """Write a small text file under the same rules."""
    write_bytes(path, text.encode(), overwrite=overwrite)


def run_logged(words: list[str], log: Path) -> tuple[int, list[str]]:
    """Run a program without a shell, and return its exit code and the last 3 lines that it wrote.

    All that it writes goes to a file. An `InputError` if it cannot be started.
    """
    try:
        with log.open("wb") as stream:
            done = subprocess.run(words, stdout=stream, stderr=subprocess.STDOUT, check=False)
    except OSError as error:
        sentence = f"{words[0]}: cannot be run ({error.strerror or error})."
        raise InputError("photos.command", sentence, command=words[0]) from error
    lines = log.read_text("utf-8", errors="replace").splitlines()
    return done.returncode, [line.strip() for line in lines if line.strip()][-3:]


@contextmanager
def scratch_arrays(target: Path) -> Iterator[Empty]:
    """Give a maker of arrays on the disk of a target, which are gone when the block ends.

    Within the block the large arrays of `pcfix.running` are made this way too. Their files have no
    name, so that nothing stays when the process is killed, and the disk gets its space back as soon
    as an array is no longer used.
    """
    maps: weakref.WeakSet[mmap.mmap] = weakref.WeakSet()

    def empty(shape: tuple[int, ...], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
        size = int(np.prod(shape)) * np.dtype(dtype).itemsize
        try:
            with TemporaryFile(dir=target.parent) as stream:
                if hasattr(os, "posix_fallocate"):  # writing to a map of a full disk would kill us
                    os.posix_fallocate(stream.fileno(), 0, size)
                else:
                    stream.truncate(size)
                one = mmap.mmap(stream.fileno(), size)
        except OSError as error:
            sentence = f"its disk lacks {size / 1e9:,.1f} GB of temporary space. Free some space."
            raise bad_file(target, "output.disk_full", sentence) from error
        maps.add(one)
        return np.frombuffer(one, dtype).reshape(shape)

    def release() -> None:
        for one in maps:
            if hasattr(mmap, "MADV_DONTNEED"):
                one.madvise(mmap.MADV_DONTNEED)

    with running(empty=empty, release=release):
        yield empty


ENSEMBLE = "ensemble.npz"  # the file next to an adjusted model with the members of its ensemble


def write_members(folder: Path, members: "Members") -> None:
    """Write members into a folder, as the arrays of `Members`, for ``numpy.load``."""
    np.savez_compressed(folder / ENSEMBLE, **vars(members))


def find_members(cameras: File) -> "tuple[Path, Members] | None":
    """Return the members next to a camera file, and their file; None if there is none.

    It is in the folder of the adjustment: a model's own folder, or one of the two above it.
    """
    path = Path(cameras).resolve()
    places = (at / ENSEMBLE for at in (path, *path.parents[:2]))
    found = next((place for place in places if place.is_file()), None)
    if found is None:
        return None
    from pcfix.adjust.precision import Members  # not quick to load

    sentence = "is not an ensemble of an adjustment. Adjust again, or remove the file."
    with refusing(found, "ensemble.damaged", sentence), np.load(found) as arrays:
        values: dict[str, Any] = {one.name: arrays[one.name] for one in fields(Members)}
        values |= {name: tuple(values[name].tolist()) for name in ("labels", "lens_names")}
        members = Members(**values)
        m, k, p = len(members), len(members.labels), len(members.lens_names)
        shapes = {"focal": (k,), "turn": (m, k, 3), "shift_m": (m, k, 3), "lens": (m, k, p)}
        for name, shape in (shapes | {"water": (m, 7)}).items():
            if getattr(members, name).shape != shape:
                raise ValueError(f"the shape of {name} does not fit")
    return found, members


def packed_plugin(table: str, version: str) -> bytes:
    """Return the QGIS plugin as a ZIP file, with a table of its commands as JSON."""
    stream = io.BytesIO()
    own = {
        one.name: one.read_text("utf-8")
        for one in files("pcfix.qgis").iterdir()
        if one.name.endswith((".py", ".txt"))
    }
    own["metadata.txt"] = own["metadata.txt"].replace("version=0.0", f"version={version}")
    own["commands.json"] = table
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as file:
        for name in sorted(own):  # all of 1980, so that the same input gives the same bytes
            file.writestr(zipfile.ZipInfo(f"pcfix/{name}"), own[name].encode())
    return stream.getvalue()

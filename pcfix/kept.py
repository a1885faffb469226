"""Where compiled kernels are kept, and that no two processes compile one at once.

They lie in the package, so that whoever builds an image or installs for others compiles them once.
Where it cannot be written, they are read there all the same, and what is missing is kept in a
folder that is the user's alone. A kernel is valid for the text of its file and of all that this
imports of the package, whose parts and numbers it has in it; not for their times: copies, and the
layers of an image, change them.
"""

from __future__ import annotations

import os
import re
import stat
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import IO, Any

import llvmlite.binding as llvm
from numba.core.caching import CacheImpl, CompileResultCacheImpl, FunctionCache, _CacheLocator
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompileResult
from numba.core.environment import Environment, lookup_environment
from numba.core.runtime import rtsys

from pcfix.errors import PcfixWarning

WAITING = "another process is compiling kernels; waiting for it\n"
waits: list[Callable[[], object]] = [lambda: sys.stderr.write(WAITING)]
"""Called when a kernel is waited for; each once, and taken out."""


_FORMAT = b"3"
"""Of what is written; kernels of another one are compiled anew."""

_PACKAGE = Path(__file__).parent
_IMPORT = re.compile(rf"^from {_PACKAGE.name}\.?([\w.]*) import ([\w, ]+|\([^)]*\))", re.MULTILINE)


@cache
def _stamp(source: str) -> str:
    """Return what changes with the text of a file, and of all that it imports of the package."""
    found, left = dict[Path, bytes](), [Path(source)]
    while left:
        path = left.pop()
        if path not in found:
            found[path], imported = _text_of(path)
            left += imported
    told = sha256(_FORMAT)
    for path in sorted(found):
        told.update(found[path])
    return told.hexdigest()


@cache
def _text_of(path: Path) -> tuple[bytes, tuple[Path, ...]]:
    """Return the digest of a file's text, and the files of the package that it imports."""
    text, imported = path.read_bytes(), list[Path]()
    for module, names in _IMPORT.findall(text.decode()):
        place = _PACKAGE.joinpath(*filter(None, module.split(".")))
        file = place.with_suffix(".py")
        files = [file]
        if not file.is_file():
            files = [place / f"{name}.py" for name in ("__init__", *re.findall(r"\w+", names))]
        imported += filter(Path.is_file, files)
    return sha256(text).digest(), tuple(imported)


@cache
def is_writable(folder: Path) -> bool:
    """Whether files can be made in a folder, which is made if need be."""
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    return False


def _is_private(folder: Path) -> bool:
    """Whether nobody else can put files there, which would be run; it is made if need be."""
    with suppress(OSError):
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = folder.lstat()
        if not hasattr(os, "getuid"):
            return is_writable(folder)
        closed = found.st_uid == os.getuid() and not found.st_mode & (stat.S_IRWXG | stat.S_IRWXO)
        return stat.S_ISDIR(found.st_mode) and closed and is_writable(folder)
    return False


@cache
def private_folder() -> Path | None:
    """Return where kernels are kept if not in the package; with one warning none, in memory."""
    given = os.environ.get("NUMBA_CACHE_DIR")
    if given:
        return Path(given) if is_writable(Path(given)) else _warn()
    user = str(os.getuid()) if hasattr(os, "getuid") else ""
    folders = []
    with suppress(RuntimeError):  # a container's user may have no home,
        home = os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()
        folders.append(Path(home, "pcfix-kernels"))
    with suppress(FileNotFoundError):  # and nowhere to write
        folders.append(Path(tempfile.gettempdir(), f"pcfix-{user}"))
    for folder in folders:
        if folder.is_absolute() and _is_private(folder):
            return folder
    return _warn()


def folder_of_numba() -> Path | None:
    """Return where numba is to keep kernels in its own way, by the time of their own file alone.

    It is another one after any change of the package, as a kernel has the parts of other files.
    """
    folder, told = private_folder(), sha256(_FORMAT)
    for path in sorted(_PACKAGE.rglob("*.py")):
        told.update(path.read_bytes())
    return None if folder is None else folder / told.hexdigest()[:16]


def roots() -> tuple[Path, ...]:
    """Return under which folders kernels are looked for; the first is where new ones are kept."""
    package = Path(__file__).parent
    given = "NUMBA_CACHE_DIR" in os.environ
    if not given and is_writable(package / "__pycache__"):
        return (package,)
    own = private_folder()
    return () if own is None else (own,) if given else (own, package)


def kept_kernels() -> set[tuple[Path, int]]:
    """Return the files of all kernels that are kept, and when each was written, ns."""
    files = (file for root in roots() for file in root.rglob("*.nbc"))
    return {(file, file.stat().st_mtime_ns) for file in files}


def _warn() -> Path | None:
    warnings.warn(
        "Kernels are compiled each time anew (half a minute), as neither the folder of pcfix, nor "
        "the user's cache, nor that of temporary files can be written; set NUMBA_CACHE_DIR to one "
        "that can.",
        PcfixWarning,
        stacklevel=2,
    )
    return None


class _Locator(_CacheLocator):  # type: ignore[misc]  # numba has no types
    """A folder for the kernels of a file, None while none can be written."""

    def __init__(self, source: str, line: int, folder: Path | None) -> None:
        self._source, self._line, self._folder = source, line, folder

    def get_cache_path(self) -> str:
        return str(self._folder or os.devnull)

    def ensure_cache_path(self) -> None:
        """Do nothing: the folder is there."""

    def get_source_stamp(self) -> str:
        return _stamp(self._source)

    def get_disambiguator(self) -> str:
        return str(self._line)


def _environment(name: str, constants: list[Any]) -> Environment:
    """Return what compiled code finds its constants in.

    Of numba's own it would have the names of the module it came from too, which only Python's
    objects ask for; the modules of all parts of numba in a kernel load half of scipy.
    """
    found = lookup_environment(name)
    if found is None:
        found = Environment._memo[name] = Environment({})
        found.env_name, found.consts[:] = name, constants
    return found


class _Library(JITCodeLibrary):  # type: ignore[misc]
    """The code of a kernel that was kept; its text for LLVM is read when another links it alone."""

    _shared_module: Any

    def __init__(self, codegen: Any, name: str, code: bytes, text: bytes) -> None:
        super().__init__(codegen, name)
        self._text = text
        self.enable_object_caching()
        self._set_compiled_object(code)
        self._finalize_final_module()

    def _get_module_for_linking(self) -> Any:
        if self._shared_module is None:
            self._shared_module = llvm.parse_bitcode(self._text)
        return self._shared_module


class _Impl(CompileResultCacheImpl):  # type: ignore[misc]
    """What numba writes of a kernel, in a folder that was chosen before."""

    def __init__(self, function: Any, folder: Path | None) -> None:
        code = function.__code__
        self._locator = _Locator(code.co_filename, code.co_firstlineno, folder)
        name = f"{Path(code.co_filename).stem}.{function.__qualname__}"
        self._filename_base = CacheImpl.get_filename_base(self, name, sys.abiflags)

    def reduce(self, compiled: Any) -> Any:
        """Return what is written: as numba has it, and the names that it defines and needs."""
        module = compiled.library._final_module
        named = [*module.functions, *module.global_variables]
        defined = {one.name for one in named if not one.is_declaration}
        needed = {one.name for one in named if one.is_declaration}
        needed = {name for name in needed if not name.startswith("llvm.")}
        library, description, own, *rest, others = super().reduce(compiled)
        constants = [(one.env_name, one.consts) for one in (own, *others)]
        return defined, needed, (library, description, constants, *rest)

    def rebuild(self, context: Any, written: Any) -> Any:
        """Return a kernel, without all that numba needs to compile one, where it can do so."""
        defined, needed, ((name, _, codes), description, constants, *rest) = written
        rtsys.initialize(context)
        if not all(map(llvm.address_of_symbol, needed)):
            context.refresh()
        signature, is_object, lifted, annotation, init = rest
        environment, *others = (_environment(*one) for one in constants)
        for function in init:
            function()
        library = _Library(context.codegen(), name, *codes)
        library.codegen._engine._defined_symbols |= defined
        entry = context.get_executable(library, description, environment)
        for one in others:
            library.codegen.set_env(one.env_name, one)
        return CompileResult(
            context.typing_context, context, entry, None, annotation, signature, is_object,
            lifted, description, library, None, environment, None, init, others,
        )  # fmt: skip


class _Folder(FunctionCache):  # type: ignore[misc]
    """A kernel in one folder."""

    def __init__(self, function: Any, folder: Path | None) -> None:
        self._impl_class = lambda function: _Impl(function, folder)
        super().__init__(function)

    def load_overload(self, signature: Any, context: Any) -> Any:
        """Return a kernel; numba would first load all that it needs to compile one."""
        with self._guard_against_spurious_io_errors():
            return self._load_overload(signature, context)


class Kept:
    """A kernel as numba loads and saves it: in the package, or in the user's folder."""

    def __init__(self, function: Any) -> None:
        source = Path(function.__code__.co_filename)
        inside = source.parent / "__pycache__"
        given = "NUMBA_CACHE_DIR" in os.environ  # which is to hold all
        elsewhere = given or not is_writable(inside)
        folder = private_folder() if elsewhere else inside
        if elsewhere and folder is not None:
            of_path = sha256(str(source.parent).encode()).hexdigest()[:16]
            folder = folder / f"{source.parent.name}-{of_path}"
            folder = folder if is_writable(folder) else None
        self._name, self._folder = f"{source.stem}.{function.__qualname__}", folder
        self._own = None if folder is None else _Folder(function, folder)
        self._shipped = _Folder(function, inside) if elsewhere and not given else None
        self._lock: IO[bytes] | None = None
        self.places = [one for one in (folder, None if given else inside) if one is not None]
        self.cache_path = str(folder or inside)

    def load_overload(self, signature: Any, context: Any) -> Any:
        """Return a kernel that is kept; else None, when no other process is compiling it."""
        found = self._load(signature, context)
        if found is None and self._folder is not None and self._take_lock():
            found = self._load(signature, context)
        return found

    def _load(self, signature: Any, context: Any) -> Any:
        for place in (self._own, self._shipped):
            found = None if place is None else place.load_overload(signature, context)
            if found is not None:
                return found
        return None

    def save_overload(self, signature: Any, compiled: Any) -> None:
        """Keep a kernel."""
        if self._own is not None:
            self._own.save_overload(signature, compiled)

    def flush(self) -> None:
        """Forget what is kept."""
        if self._own is not None:
            self._own.flush()

    def enable(self) -> None:
        """Do nothing: it is."""

    def disable(self) -> None:
        """Keep nothing more."""
        self._own = self._shipped = None

    def _take_lock(self) -> bool:
        """Take the lock of the kernel, which ends with `alone`; whether it was waited for."""
        try:
            import fcntl
        except ImportError:  # Windows: two processes may compile the same
            return False
        if self._lock is not None:
            return False
        self._lock = Path(str(self._folder), f"{self._name}.lock").open("wb")  # noqa: SIM115
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            while waits:
                waits.pop()()
            fcntl.flock(self._lock, fcntl.LOCK_EX)
            return True
        except OSError:  # a file system without locks
            return False
        return True

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Give the lock back in the end, whatever happened."""
        try:
            yield
        finally:
            if self._lock is not None:
                self._lock.close()
                self._lock = None

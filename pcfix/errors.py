"""Errors and warnings for mistakes that a user can correct.

Each has a short code for programs (``"cameras.no_overlap"``), a sentence for people (the file, what
is wrong with the value, what to do), and the values that a program may want.
"""

import errno
import importlib
import math
import re
import sys
import warnings
from collections.abc import Iterable
from dataclasses import asdict, is_dataclass
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any


class CodedError(Exception):
    """The code, sentence and values of an error or a warning.

    Attributes
    ----------
    code : str
        The subject and the mistake, such as ``"water.spec"``.
    message : str
    values : dict
        What a program may want: the file, the offending value, its limit.
    """

    def __init__(self, code: str, message: object, **values: Any) -> None:
        self.code, self.message, self.values = code, str(message), values
        super().__init__(code, self.message)

    def __str__(self) -> str:
        return printable(self.message)

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, as the JSON of a summary holds them."""
        values = {name: plain(value) for name, value in self.values.items()}
        return {"code": self.code, "message": str(self), **values}


class PcfixError(CodedError):
    """A mistake that the user can correct. The command line prints it and exits with code 1."""


class InputError(PcfixError):
    """A file is missing, damaged, or of another kind."""


def bad_file(path: object, code: str, sentence: str, **values: Any) -> InputError:
    """Return an error whose message is the path of a file and a sentence."""
    return InputError(code, f"{path}: {sentence}", path=path, **values)


class NoTiePointsError(InputError):
    """A camera file has no tie points, which most steps do not need."""


class SettingError(PcfixError, ValueError):
    """An option or argument has a wrong value."""


class GeometryError(PcfixError):
    """Cloud, cameras and water do not match."""


class PcfixWarning(CodedError, UserWarning):  # noqa: N818
    """A warning: it affects the result, and the user can do something about it."""


def warn(name: object, code: str, sentence: str, **values: Any) -> None:
    """Warn about a file; the message is its path and a sentence."""
    warnings.warn(PcfixWarning(code, f"{name}: {sentence}", **values), stacklevel=3)


# A context in which no warning of pcfix is shown.
silently = partial(warnings.catch_warnings, action="ignore", category=PcfixWarning)


def coded(code: str, notes: Iterable[object]) -> list[PcfixWarning]:
    """Return notes as warnings; plain sentences get this code."""
    return [one if isinstance(one, PcfixWarning) else PcfixWarning(code, one) for one in notes]


def plain(value: Any) -> Any:
    """Return a value in the types of JSON; numbers that are not finite become None."""
    if isinstance(value, PcfixWarning):
        return value.as_dict()
    if is_dataclass(value) and not isinstance(value, type):
        value = asdict(value)
    if isinstance(value, SimpleNamespace):
        value = vars(value)
    if isinstance(value, dict):
        return {str(key): plain(one) for key, one in value.items()}
    if hasattr(value, "tolist"):  # of numpy
        value = value.tolist()
    if isinstance(value, list | tuple | set):
        return [plain(one) for one in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if isinstance(value, str | int | float | None) else str(value)


def printable(message: str) -> str:
    """Escape characters that a terminal cannot show, because messages quote the contents of files.

    The result is one line, plus one for each entry of a list (lines that start with two spaces).
    Lines of more than 800 characters lose their middle: the file comes first, and the remedy last.
    """

    def one_line(text: str) -> str:
        text = "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
        return text if len(text) <= 800 else f"{text[:540]} ... {text[-240:]}"

    return "\n".join(map(one_line, re.split(r"\n(?=  )", message)))


_REFUSALS = {
    errno.ENOENT: "there is no such file",
    errno.ENOTDIR: "there is no such file",
    errno.EISDIR: "is a folder; give a file",
    errno.ELOOP: "its links form a circle; give the file they should point to",
    errno.ENAMETOOLONG: "the name is longer than the system allows",
    errno.EACCES: "access is denied; change the permissions of the file or of its folder",
}


def refusal(error: Exception) -> str:
    """Describe in words why the system refused a file."""
    words = getattr(error, "strerror", None) or str(error).strip().rstrip(".")
    return _REFUSALS.get(getattr(error, "errno", None) or 0, f"cannot be read ({words})")


def show_warning(
    message: Warning | str, category: type[Warning], *where: object, **more: object
) -> None:
    """Print a warning of pcfix as one line on stderr; a replacement of `warnings.showwarning`."""
    del where, more
    if issubclass(category, PcfixWarning):
        sys.stderr.write(f"pcfix: warning: {message}\n")


# Libraries that may be missing: those of extras, and open3d, which needs libusb


def optional_library(name: str, extra: str, who: str) -> Any:
    """Import a library of an extra; the error names the command that installs it."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        root = Path(__file__).parents[1]
        is_checkout = (root / "pyproject.toml").is_file()
        what = f"-e '{root}[{extra}]'" if is_checkout else f"'pcfix[{extra}]'"
        sentence = f"{who} needs {name}, which is not installed. Run: {sys.executable} -m pip"
        sentence += f" install {what}"
        raise InputError("library.missing", sentence, library=name, extra=extra) from error


analysis_library = partial(optional_library, extra="analysis", who="This")
photo_library = partial(optional_library, extra="photos", who="Work on photographs")


def load_open3d(part: str = "open3d") -> Any:
    """Import open3d, or a part of it, with libusb-1.0.

    The camera drivers in open3d link to libusb-1.0 of the system, which servers often lack. The one
    in the package libusb-package works as well.
    """
    import ctypes  # slow to import

    try:
        try:
            import libusb_package

            ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
        except (ImportError, OSError):
            pass  # the libusb of the system may do
        return importlib.import_module(part)
    except (ImportError, OSError) as error:
        sentence = f"open3d cannot be loaded ({error}). On Debian and Ubuntu: apt-get install"
        sentence += " libusb-1.0-0 libgl1 libegl1 libgomp1 libx11-6."
        raise InputError("library.missing", sentence, library="open3d") from error

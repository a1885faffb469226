"""The few errors and the one warning that pcfix raises for a user's mistake.

Each message is one sentence that a person can act on: the file, the value, the rule, the remedy.
"""

import errno
import importlib
import re
import sys
import warnings
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar

_Found = TypeVar("_Found")

_MOST_LETTERS, _FIRST, _LAST = 800, 540, 240


_LIST = re.compile(r"\n(?=  )")


def printable(message: str) -> str:
    """Return a message that a terminal can show, whatever of a file is quoted in it.

    It is one line, and one for each entry of a list, which two spaces begin. Letters that are not
    for print become escapes, and a line that is too long all the same loses its middle: the file is
    named first and the remedy last.
    """

    def one_line(text: str) -> str:
        text = "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
        return text if len(text) <= _MOST_LETTERS else f"{text[:_FIRST]} ... {text[-_LAST:]}"

    return "\n".join(map(one_line, _LIST.split(message)))


LONGEST_VALUE, LONGEST_NAME = 60, 255
_UNBROKEN = re.compile(rf"[^\s,/\\'\":;()]{{{LONGEST_VALUE + 1},}}")
_FILE_NAME = re.compile(r"\.\w{1,6}$")


def brief(message: str) -> str:
    """Return a message in which no value is longer than 60 characters, and no name of a file 255.

    Values with spaces in them are shortened where they are quoted.
    """

    def shortened(match: re.Match[str]) -> str:
        is_name = len(match[0]) <= LONGEST_NAME and _FILE_NAME.search(match[0])
        return match[0] if is_name else match[0][: LONGEST_VALUE - 3] + "..."

    return _UNBROKEN.sub(shortened, message)


class PcfixError(Exception):
    """Anything that a user can mend; the command line prints it and exits with 1."""

    def __init__(self, message: object = "") -> None:
        super().__init__(brief(str(message)))

    def __str__(self) -> str:
        return printable(super().__str__())


class InputError(PcfixError):
    """A file that is missing, damaged or not what it should be."""


class NoTiePointsError(InputError):
    """A camera file without tie points, which most steps do without."""


class SettingError(PcfixError, ValueError):
    """An option or argument outside its rule."""


class GeometryError(PcfixError):
    """Cloud, cameras and water that do not fit together."""


class PcfixWarning(UserWarning):
    """Something that was done on the user's behalf and that they should know of."""

    def __str__(self) -> str:
        return printable(super().__str__())


_REFUSALS = {
    errno.ENOENT: "there is no such file",
    errno.ENOTDIR: "there is no such file",
    errno.EISDIR: "is a folder; give a file",
    errno.ELOOP: "its links lead in a circle; give the file itself",
    errno.ENAMETOOLONG: "the name is longer than the system allows",
    errno.EACCES: "access is denied; change the rights of the file or of its folder",
}


def refusal(error: Exception) -> str:
    """Return in words what the system says of a file."""
    words = getattr(error, "strerror", None) or str(error).strip().rstrip(".")
    return _REFUSALS.get(getattr(error, "errno", None) or 0, f"cannot be read ({words})")


def installing(extra: str) -> str:
    """Return the command that installs an extra, from a checkout too."""
    root = Path(__file__).parents[1]
    what = f"-e '{root}[{extra}]'" if (root / "pyproject.toml").is_file() else f"'pcfix[{extra}]'"
    return f"{sys.executable} -m pip install {what}"


def shown_once(read: Callable[[], _Found], notes: Callable[[_Found], Iterable[str]]) -> _Found:
    """Return what a function returns, and show of its warnings those that are none of its notes."""
    with warnings.catch_warnings(record=True) as shown:
        warnings.simplefilter("always", PcfixWarning)
        found = read()
    known = set(notes(found))
    for one in shown:
        if str(one.message) not in known:
            warnings.warn(one.message, one.category, stacklevel=3)
    return found


def optional_library(name: str, extra: str, who: str) -> Any:
    """Return a library of an extra, or say who needs it and how to get it."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InputError(
            f"{who} needs {name}, which is not installed; run: {installing(extra)}"
        ) from error


def photo_library(name: str) -> Any:
    """Return a library of the extra ``photos``, or say how to get it."""
    return optional_library(name, "photos", "Work on photographs")


def show_warning(
    message: Warning | str, category: type[Warning], *where: object, **more: object
) -> None:
    """Show a warning of pcfix as one line on stderr, others not: for `warnings.showwarning`."""
    del where, more
    if issubclass(category, PcfixWarning):
        sys.stderr.write(f"pcfix: warning: {brief(str(message))}\n")

"""Declare options: from one entry follow its flag, its keyword, its check and its documentation.

An option is a field of an `OptionSet` with its help below it::

    resolution: float | None = option(None, above=0)
    \"\"\"Size of a cell. [m] [default: from the point spacing]\"\"\"

The text is the help, with the unit, and with the default in words if its value is not clear enough.
A class holds the options of one subject. The class of a command inherits from those that it needs,
and reaches none twice. Names are the same everywhere: ``max_angle`` in Python and JSON is
``--max-angle`` on the command line.
"""

import ast
import difflib
import inspect
import math
import os
import sys
import types
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, fields
from functools import cache
from itertools import pairwise
from typing import (
    Any,
    ClassVar,
    Literal,
    NamedTuple,
    TypeAlias,
    TypeVar,
    Union,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
)

from pcfix.errors import SettingError, plain

File: TypeAlias = str | os.PathLike[str]
Set = TypeVar("Set", bound="OptionSet")


class Option(NamedTuple):
    """An option of a class, with the name, type and default of its field."""

    name: str
    type: Any
    default: Any
    home: type  # the class that declares it
    basic: bool = False  # most people need it; a short --help shows no others
    least: float | None = None  # smallest number allowed, also in each of several
    above: float | None = None  # the same, but this value itself is not allowed
    most: float | None = None  # largest number allowed
    needed: str = ""  # "needed" if it must be given, and when it need not be
    instead: str = ""  # another option that can replace it
    with_cameras: bool = False  # it has no effect without cameras
    needs: str = ""  # it has no effect without this option, or its value: "method factor"
    requires: tuple[str, ...] = ()  # options to give with it; of "cameras or gsd" exactly one
    parse: Callable[[str], Any] | None = None  # reads a text; its ValueError is the message
    then: Callable[[Any], Any] | None = None  # turns a value of the right type into the one used
    metavar: str = ""  # placeholder of the value
    panel: str = ""  # panel of the help, if not that of the class
    off: bool = False  # --no-NAME is a flag too; a switch that is on always has it
    writes: bool = False  # it names an output

    @property
    def _text(self) -> str:
        """The text below its declaration, or below the declaration that it replaces."""
        found = (
            _texts(base.__module__).get((base.__name__, self.name)) for base in self.home.__mro__
        )
        return next(filter(None, found))

    @property
    def help(self) -> str:
        """Its meaning, with the unit."""
        return self._text.partition(" [default: ")[0]

    @property
    def default_text(self) -> str:
        """Its default, in words if there are any; empty without a default."""
        words = self._text.partition(" [default: ")[2].removesuffix("]")
        if words or self.default in (None, ()) or self.default is False:
            return words
        if self.default is True:
            return "on"
        if isinstance(self.default, tuple):
            return ("," if self.parse else " ").join(f"{value:g}" for value in self.default)
        return f"{self.default:g}" if isinstance(self.default, float) else str(self.default)

    @property
    def flag(self) -> str:
        """Its name on the command line."""
        return "--" + self.name.replace("_", "-")

    @property
    def kinds(self) -> tuple[Any, ...]:
        """The types that its value may have, without None."""
        union = get_origin(self.type) in (Union, types.UnionType)
        kinds = get_args(self.type) if union else (self.type,)
        return tuple(kind for kind in kinds if kind is not type(None))

    @property
    def choices(self) -> tuple[str, ...]:
        """The words that are allowed; empty if any value is."""
        return next((get_args(kind) for kind in self.kinds if get_origin(kind) is Literal), ())

    @property
    def is_path(self) -> bool:
        """Whether its value is a file or folder."""
        return self.metavar == "PATH" or os.PathLike[str] in self.kinds

    @property
    def repeats(self) -> bool:
        """Whether it may be given several times on the command line."""
        return self.default == () and self.parse is None

    def checked(self, value: Any) -> Any:
        """Return a value as its type, or refuse it.

        A single value may replace a list, and a number may be text, as both occur in JSON.
        """
        is_one = _is_number(value) or (self.repeats and isinstance(value, str))
        if isinstance(self.default, tuple) and is_one:
            value = (value,)
        if isinstance(value, str) and self.parse is not None:
            try:
                value = self.parse(value)
            except ValueError as error:
                raise self._wrong("type", value, str(error)) from None
        if value is None and (self.default is None or type(None) in get_args(self.type)):
            return None
        several = next((get_args(kind) for kind in self.kinds if get_origin(kind) is tuple), None)
        if several is None:
            value = self._checked_one(value, self.kinds)
        elif several[0] is Any:
            value = tuple(value) if isinstance(value, list) else value
        else:
            if isinstance(value, str) or not isinstance(value, Iterable):
                raise self._wrong("type", value, "must be several values, as a list")
            value = tuple(self._checked_one(one, several[:1]) for one in value)
            if several[-1] is not Ellipsis and len(value) != len(several):
                form = f", {self.metavar}" if self.metavar else ""
                raise self._wrong("count", value, f"must be {len(several)} values{form}")
        return value if self.then is None else self.then(value)

    def _checked_one(self, value: Any, kinds: tuple[Any, ...]) -> Any:
        """Return a single value as one of some types."""
        if get_origin(kinds[0]) is Literal:
            if value not in get_args(kinds[0]):
                raise self._wrong("choice", value, f"is not one of {', '.join(get_args(kinds[0]))}")
            return value
        if kinds == (bool,) and value not in (True, False):
            raise self._wrong("type", value, "must be true or false")
        if os.PathLike[str] in kinds and not isinstance(value, str | os.PathLike):
            raise self._wrong("type", value, "must be a file or folder")
        if not {int, float} & {*kinds} or (str in kinds and isinstance(value, str)):
            return value
        if isinstance(value, str):
            with suppress(ValueError):
                value = float(value)
        if not _is_number(value):
            raise self._wrong("type", value, "must be a number")
        number, least = float(value), self.least if self.above is None else self.above
        low = -math.inf if least is None else least
        high = math.inf if self.most is None else self.most
        if not (math.isfinite(number) and low <= number <= high) or number == self.above:
            limits = {"at least": self.least, "above": self.above, "at most": self.most}
            words = [f"{word} {x:g}" for word, x in limits.items() if x is not None]
            sentence = f"must be {' and '.join(words) or 'a finite number'}"
            raise self._wrong("range", value, sentence, least=least, most=self.most)
        if float in kinds:
            return number
        if number != math.floor(number):
            raise self._wrong("type", value, "must be a whole number")
        return int(value)

    def without(self, needs: str) -> SettingError:
        """Return the error of an option that has no effect without another one, or its value."""
        sentence = f"{self.flag[2:]} has no effect without --{needs.replace('_', '-')}. Give both,"
        sentence += " or neither."
        return SettingError("option.needs", sentence, option=self.name, needs=needs)

    def _wrong(self, code: str, value: Any, words: str, **values: Any) -> SettingError:
        """Return the error of a value that is not as it must be."""
        values |= {"option": self.name, "value": value}
        shown = f"'{value}'" if isinstance(value, str) else value
        return SettingError(f"option.{code}", f"{self.flag[2:]} {shown} {words}.", **values)


def _is_number(value: Any) -> bool:
    return hasattr(value, "__float__") and not isinstance(value, bool)


def option(default: Any, **declared: Any) -> Any:
    """Declare an option; `Option` has the names of `declared`."""
    return field(default=default, metadata={"option": declared})


@dataclass_transform(kw_only_default=True, frozen_default=True)
@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class OptionSet:
    """The base of all classes of options, which are frozen dataclasses.

    Every value is checked against its declaration. `panel` is the panel of the help that shows the
    options of a class.
    """

    panel: ClassVar[str] = ""

    def __init_subclass__(cls, panel: str = "") -> None:
        """Make a subclass a dataclass."""
        cls.panel = panel
        # dataclasses would compile other methods for each class, which delays every start
        dataclass(frozen=True, kw_only=True, eq=False, repr=False)(cls)

    def __repr__(self) -> str:
        given = ", ".join(f"{name}={value!r}" for name, value in vars(self).items())
        return f"{type(self).__name__}({given})"

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and vars(self) == vars(other)

    def __hash__(self) -> int:
        return hash(tuple(vars(self).values()))

    def __post_init__(self) -> None:
        """Check every option, then the rules between options."""
        options = {one.name: one for one in options_of(type(self))}
        for name, one in options.items():
            object.__setattr__(self, name, one.checked(getattr(self, name)))

        def is_given(name: str) -> bool:
            return bool(getattr(self, name) != options[name].default)

        for name, one in options.items():
            other, _, wanted = one.needs.partition(" ")
            met = other not in options or (
                getattr(self, other) == wanted if wanted else is_given(other)
            )
            if not met and is_given(name):
                raise one.without(one.needs)
            for others in one.requires:
                names = others.split(" or ")
                if is_given(name) and sum(map(is_given, names)) != 1:
                    give = "exactly one of them" if names[1:] else "both"
                    sentence = f"{one.flag[2:]} needs {others}: give {give}."
                    raise SettingError("option.missing", sentence, option=names[0])
        self.check()

    def check(self) -> None:
        """Check the rules between options that the declarations do not state."""

    def missing(self) -> Option | None:
        """Return the first needed option that was not given or replaced by another one."""
        for one in options_of(type(self)):
            is_optional = one.name == "cameras" and not getattr(self, "needs_cameras", True)
            given = [getattr(self, name, None) for name in (one.name, one.instead)]
            if one.needed and not is_optional and given == [None, None]:
                return one
        return None

    def part(self, kind: type[Set]) -> Set:
        """Return the options that another class shares with this one, as that class."""
        names = [one.name for one in fields(kind) if hasattr(self, one.name)]
        return kind(**{name: getattr(self, name) for name in names})

    def as_dict(self) -> dict[str, Any]:
        """Return all values in the types of JSON."""
        return dict(plain(self))


_KNOWN: dict[type, tuple[Option, ...]] = {}


def options_of(kind: type) -> tuple[Option, ...]:
    """Return the options of a class, in the order of its help."""
    if kind not in _KNOWN:
        homes: dict[str, Any] = {}
        for base in reversed(kind.__mro__):
            homes |= dict.fromkeys(inspect.get_annotations(base), base)
        hints = get_type_hints(kind)
        _KNOWN[kind] = tuple(
            Option(
                one.name, hints[one.name], one.default, homes[one.name],
                **{"panel": homes[one.name].panel, **one.metadata["option"]},
            )
            for one in fields(kind)
            if "option" in one.metadata
        )  # fmt: skip
    return _KNOWN[kind]


@cache
def _texts(module: str) -> dict[tuple[str, str], str]:
    """Return the texts below the fields of the classes of a module, by class and field."""
    found = {}
    for kind in ast.parse(inspect.getsource(sys.modules[module])).body:
        if isinstance(kind, ast.ClassDef):
            for pair in pairwise(kind.body):
                match pair:
                    case ast.AnnAssign(ast.Name(name)), ast.Expr(ast.Constant(str(text))):
                        found[kind.name, name] = " ".join(text.split())
    return found


def taken(kind: type[Set], given: OptionSet | None, keywords: Mapping[str, Any], where: str) -> Set:
    """Return the options of a Python function: its argument ``options``, or its `keywords`.

    `where` is the function, for messages. Raises SettingError ``option.unknown`` or
    ``option.twice``.
    """
    if given is None:
        return kind(**named(keywords, options_of(kind), where))
    if keywords:
        name = next(iter(keywords))
        sentence = f"{where}: give options=... or {name}=..., not both. dataclasses.replace changes"
        raise SettingError("option.twice", f"{sentence} single options.", option=name)
    return given if isinstance(given, kind) else given.part(kind)


def named(given: Mapping[str, Any], known: Iterable[Option], where: str) -> dict[str, Any]:
    """Return the values as a dict if all their names are known.

    Raises SettingError ``option.unknown``, with the most similar known name.
    """
    names = [one.name for one in known]
    for name in given:
        if name not in names:
            near = next(iter(difflib.get_close_matches(name, names, n=1, cutoff=0.5)), None)
            hint = f"Did you mean {near}?" if near else f"The options are {', '.join(names)}."
            sentence = f"{where}: there is no option '{name}'. {hint}"
            raise SettingError("option.unknown", sentence, option=name, near=near)
    return dict(given)


def words(text: str) -> tuple[str, ...]:
    """Parse words separated by commas."""
    return tuple(word.strip() for word in text.split(",") if word.strip())


def numbers(text: str) -> tuple[float, ...]:
    """Parse numbers separated by commas."""
    try:
        return tuple(map(float, words(text)))
    except ValueError:
        raise ValueError("must be numbers separated by commas") from None


def number_or(*names: str) -> Callable[[str], float | str | None]:
    """Return a parser of numbers and of these words, or of any word; "none" becomes None."""

    def parse(text: str) -> float | str | None:
        try:
            return float(text)
        except ValueError:
            if names and text not in names:
                raise ValueError(f"is neither a number nor {' nor '.join(names)}") from None
        return None if text == "none" else text

    return parse

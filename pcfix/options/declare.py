"""How an option is declared: one entry, from which every door and its documentation is made.

An option is a field of an `OptionSet`, ``name: type = option(default, help, ...)``. The classes are
panels of the help; a command has a class that inherits some of them. Names are the same everywhere:
``max_angle`` in Python and JSON is ``--max-angle`` on the command line.
"""

from __future__ import annotations

import difflib
import math
import os
import sys
import types
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields
from inspect import get_annotations
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
)

from pcfix.errors import SettingError

File: TypeAlias = str | os.PathLike[str]
Set = TypeVar("Set", bound="OptionSet")


class Option(NamedTuple):
    """An option of a class.

    Attributes
    ----------
    help, unit : str
        One sentence, and the unit of the value: m, deg, px.
    least, above, most : float or None
        Limits of a number, or of each of several; `above` itself is not allowed.
    default_is : str
        The default in words, if it is not the value.
    needed : bool
        Whether it must be given; `default_is` says when not.
    needs : str
        Another option without which this one has no effect, or one and the value that it must have:
        ``"method factor"``.
    parse : callable or None
        Returns the value, given the option's name and a text.
    metavar, panel : str
        Placeholder of the value, and panel of the help if it is not that of the class.
    name, type, default
        From its field; see `options_of`.
    """

    help: str
    unit: str = ""
    least: float | None = None
    above: float | None = None
    most: float | None = None
    default_is: str = ""
    needed: bool = False
    needs: str = ""
    parse: Callable[[str, str], Any] | None = None
    metavar: str = ""
    name: str = ""
    type: Any = None
    default: Any = None
    panel: str = ""

    @property
    def flag(self) -> str:
        """Its name on the command line."""
        return "--" + self.name.replace("_", "-")

    @property
    def kinds(self) -> tuple[Any, ...]:
        """The types that it may have, without None."""
        union = get_origin(self.type) in (Union, types.UnionType)
        kinds = get_args(self.type) if union else (self.type,)
        return tuple(kind for kind in kinds if kind is not type(None))

    @property
    def choices(self) -> tuple[str, ...]:
        """The words that it may be; empty if it is free."""
        return next((get_args(kind) for kind in self.kinds if get_origin(kind) is Literal), ())

    @property
    def help_text(self) -> str:
        """Its sentence, with the unit."""
        return self.help + (f" [{self.unit}]" if self.unit else "")

    @property
    def default_text(self) -> str:
        """Its default, in words if there are any; empty without a default."""
        if self.default_is or self.default in (None, ()) or self.default is False:
            return self.default_is
        if isinstance(self.default, tuple):
            return ("," if self.parse else " ").join(f"{value:g}" for value in self.default)
        return f"{self.default:g}" if isinstance(self.default, float) else str(self.default)

    @property
    def needed_text(self) -> str:
        """Whether it is needed, and when not."""
        return ", ".join(filter(None, ["needed" if self.needed else "", self.default_text]))

    @property
    def placeholder(self) -> str:
        """The kind of its value: a path, a number, a text, or nothing for a switch."""
        if os.PathLike[str] in self.kinds:
            return "PATH"
        return "" if bool in self.kinds else "N" if self.kinds != (str,) else "TEXT"

    @property
    def plain_kinds(self) -> tuple[type, ...]:
        """The types that its value may have in JSON, in the order in which they are tried."""
        if self.parse is not None:
            return (float, str) if float in self.kinds else (str, int)
        if self.type is Any:
            return (str,) if self.metavar == "PATH" else (str, float)
        return self.kinds if self.kinds in ((bool,), (int,), (float,)) else (str,)

    def checked(self, value: Any) -> Any:
        """Return a value as its type."""
        if isinstance(value, str) and self.parse is not None:
            value = self.parse(self.flag[2:], value)
        if value is None and (self.default is None or type(None) in get_args(self.type)):
            return None
        several = next((get_args(kind) for kind in self.kinds if get_origin(kind) is tuple), None)
        if several is None:
            return self._checked_one(value, self.kinds)
        if several[0] is Any:  # the class takes it apart
            return tuple(value) if isinstance(value, list) else value
        count = None if several[-1] is Ellipsis else len(several)
        if isinstance(value, str) or not isinstance(value, Iterable):
            raise self._wrong("type", value, "must be several values, as a list")
        values = tuple(self._checked_one(one, several[:1]) for one in value)
        if count is not None and len(values) != count:
            form = f", {self.metavar}" if self.metavar else ""
            raise self._wrong("count", value, f"must be {count} values{form}")
        return values

    def _checked_one(self, value: Any, kinds: tuple[Any, ...]) -> Any:
        """Return a single value as one of some types."""
        if get_origin(kinds[0]) is Literal:
            if value not in get_args(kinds[0]):
                raise self._wrong("choice", value, f"is not one of {', '.join(get_args(kinds[0]))}")
            return value
        if not {int, float} & {*kinds} or (str in kinds and isinstance(value, str)):
            return value
        if isinstance(value, str) or not hasattr(value, "__float__"):
            raise self._wrong("type", value, "must be a number")
        number, least = float(value), self.least if self.above is None else self.above
        low, high = (
            -math.inf if least is None else least,
            math.inf if self.most is None else self.most,
        )
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

    def _wrong(self, code: str, value: Any, words: str, **values: Any) -> SettingError:
        """Return the error of a value that is not as it must be."""
        shown = f"'{value}'" if isinstance(value, str) else value
        return SettingError(
            f"option.{code}", f"{self.flag[2:]} {shown} {words}.",
            option=self.name, value=value, **values,
        )  # fmt: skip


def option(default: Any, help: str, **more: Any) -> Any:
    """Declare an option; for the names of `more` see `Option`."""
    return field(default=default, metadata={"option": Option(help, **more)})


@dataclass_transform(kw_only_default=True, frozen_default=True)
@dataclass(frozen=True, kw_only=True)
class OptionSet:
    """The base of all classes of options: every value is checked against its declaration.

    Its subclasses are frozen dataclasses. A class says in which `panel` of the help its own options
    are.
    """

    panel: ClassVar[str] = ""

    def __init_subclass__(cls, panel: str = "") -> None:
        """Make a subclass a dataclass."""
        cls.panel = panel
        dataclass(frozen=True, kw_only=True)(cls)

    def __post_init__(self) -> None:
        """Check every option, then what they say together."""
        options = {one.name: one for one in options_of(type(self))}
        for name, one in options.items():
            object.__setattr__(self, name, one.checked(getattr(self, name)))
        for name, one in options.items():
            other, _, wanted = one.needs.partition(" ")
            if other in options and getattr(self, name) != one.default:
                value = getattr(self, other)
                if value != wanted if wanted else value == options[other].default:
                    flag = f"{options[other].flag} {wanted}".strip()
                    raise SettingError(
                        "option.needs",
                        f"{one.flag[2:]} has no effect without {flag}. Give both, or neither.",
                        option=name,
                        needs=one.needs,
                    )
        self.check()

    def check(self) -> None:
        """Check what options say together."""

    def part(self, kind: type[Set]) -> Set:
        """Return those options that another class has too."""
        names = [one.name for one in fields(kind) if hasattr(self, one.name)]
        return kind(**{name: getattr(self, name) for name in names})

    def plain(self) -> dict[str, Any]:
        """Return what was given, other than the defaults, as a stage of PDAL takes it."""
        return {
            one.name: _as_text(one, getattr(self, one.name))
            for one in options_of(type(self))
            if getattr(self, one.name) != one.default
        }

    def as_dict(self) -> dict[str, Any]:
        """Return all values, as JSON holds them."""
        return {name: _plain(value) for name, value in asdict(self).items()}


def _as_text(one: Option, value: Any) -> Any:
    """Return numbers and words as text with commas between, where text is parsed, and no limit."""
    if value is None:
        return "none"  # null would be the default
    if isinstance(value, tuple) and one.parse is not None:
        return ",".join(f"{v:.15g}" if isinstance(v, float) else str(v) for v in value)
    return _plain(value)


def _plain(value: Any) -> Any:
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    return list(value) if isinstance(value, tuple) else value


_KNOWN: dict[type, tuple[Option, ...]] = {}


def options_of(kind: type) -> tuple[Option, ...]:
    """Return the options of a class, in the order of its help."""
    if kind in _KNOWN:
        return _KNOWN[kind]
    homes = {name: base for base in reversed(kind.__mro__) for name in get_annotations(base)}
    found = []
    for one in (one for one in fields(kind) if "option" in one.metadata):
        home = homes[one.name]
        hint = eval(str(one.type), vars(sys.modules[home.__module__]))
        declared: Option = one.metadata["option"]
        panel = declared.panel or vars(home).get("panel", "")
        found.append(declared._replace(name=one.name, type=hint, default=one.default, panel=panel))
    _KNOWN[kind] = tuple(found)
    return _KNOWN[kind]


def table_of(kind: type) -> str:
    """Return the options of a class as a table of a document."""
    rows = ["| option | meaning | default |", "|---|---|---|"]
    for one in options_of(kind):
        value = "\\|".join(one.choices) or one.metavar or one.placeholder
        flag = f"{one.flag} {value}".strip()
        rows.append(f"| `{flag}` | {one.help_text} | {one.needed_text} |")
    return "\n".join(rows)


def taken(kind: type[Set], given: OptionSet | None, keywords: Mapping[str, Any], where: str) -> Set:
    """Return the options of a Python function: its argument ``options``, or its `keywords`.

    `where` is the function, for messages. Raises SettingError ``option.unknown`` or
    ``option.twice``.
    """
    if given is None:
        return kind(**named(keywords, options_of(kind), where))
    if keywords:
        name = next(iter(keywords))
        raise SettingError(
            "option.twice",
            f"{where}: give options=... or {name}=..., not both. dataclasses.replace changes"
            " single options.",
            option=name,
        )
    return given if isinstance(given, kind) else given.part(kind)


def named(given: Mapping[str, Any], known: Iterable[Option], where: str) -> dict[str, Any]:
    """Return values, all of whose names must be known.

    Raises SettingError ``option.unknown``, with the nearest known name.
    """
    names = [one.name for one in known]
    for name in given:
        if name not in names:
            near = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
            hint = f"Did you mean {near[0]}?" if near else f"The options are {', '.join(names)}."
            raise SettingError(
                "option.unknown",
                f"{where}: there is no option '{name}'. {hint}",
                option=name,
                near=next(iter(near), None),
            )
    return dict(given)


def words(option: str, text: str) -> tuple[str, ...]:
    """Parse words with commas between."""
    return tuple(word.strip() for word in text.split(",") if word.strip())


def numbers(option: str, text: str) -> tuple[float, ...]:
    """Parse numbers with commas between."""
    try:
        return tuple(float(word) for word in words(option, text))
    except ValueError:
        raise SettingError(
            "option.type",
            f"{option} '{text}' must be numbers with commas between.",
            option=option.replace("-", "_"),
            value=text,
        ) from None


def number_or(*names: str) -> Callable[[str, str], float | str | None]:
    """Return the parser of a number or one of some words, any if none are named; none is None."""

    def parse(option: str, text: str) -> float | str | None:
        try:
            return float(text)
        except ValueError:
            if names and text not in names:
                raise SettingError(
                    "option.type",
                    f"{option} '{text}' is neither a number nor {' nor '.join(names)}.",
                    option=option.replace("-", "_"),
                    value=text,
                ) from None
        return None if text == "none" else text

    return parse

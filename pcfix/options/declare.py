"""How an option is declared: one entry, from which every door and its documentation is made.

An option is a field of a frozen dataclass, `option(default, help, ...)`; the classes are panels of
the command line's help, and what a command takes is a class that inherits some of them. Names are
the same everywhere: ``max_angle`` in Python and JSON is ``--max-angle`` on the command line.
"""

from __future__ import annotations

import difflib
import math
import os
import sys
import types
import warnings
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import Field, asdict, dataclass, field, fields
from inspect import get_annotations
from typing import (
    Any,
    ClassVar,
    Literal,
    NamedTuple,
    TypeAlias,
    TypeVar,
    Union,
    cast,
    get_args,
    get_origin,
)

from pcfix.errors import PcfixWarning, SettingError

File: TypeAlias = str | os.PathLike[str]
Rule: TypeAlias = Callable[[str, Any], str | None]
"""Takes an option's name and value; returns what is wrong as a sentence, or None."""

Set = TypeVar("Set", bound="OptionSet")


class Option(NamedTuple):
    """An option of a class.

    Attributes
    ----------
    help : str
        One sentence, for the help and the tables.
    unit : str
        Of the value, as it is written after a number: m, deg, px.
    rule : Rule or None
    default_is : str
        The default in words, where it is not the value.
    needed : bool
        Whether the command line and PDAL ask for it; `default_is` says where not.
    parse : callable or None
        From the text of the command line or of JSON to the value.
    metavar : str
        What stands for the value in the help.
    old : tuple of str
        Names that it had; they work, with a warning.
    hidden : bool
        Left out of help and documents: it says nothing any more.
    name, type, default, panel
        From its field and its class; see `options_of`.
    """

    help: str
    unit: str = ""
    rule: Rule | None = None
    default_is: str = ""
    needed: bool = False
    parse: Callable[[str, str], Any] | None = None
    metavar: str = ""
    old: tuple[str, ...] = ()
    hidden: bool = False
    name: str = ""
    type: Any = None
    default: Any = None
    panel: str = ""

    @property
    def flag(self) -> str:
        """Its name on the command line."""
        return "--" + self.name.replace("_", "-")

    @property
    def choices(self) -> tuple[str, ...]:
        """The words that it may be; empty where it is free."""
        return next((get_args(kind) for kind in self.kinds if get_origin(kind) is Literal), ())

    @property
    def kinds(self) -> tuple[Any, ...]:
        """The types that it may have, without None."""
        union = get_origin(self.type) in (Union, types.UnionType)
        kinds = get_args(self.type) if union else (self.type,)
        return tuple(kind for kind in kinds if kind is not type(None))

    @property
    def help_text(self) -> str:
        """Its sentence, with the unit."""
        return self.help + (f" [{self.unit}]" if self.unit else "")

    @property
    def default_text(self) -> str:
        """Its default, in words where they say more; empty where there is none."""
        if self.default_is or self.default in (None, ()) or self.default is False:
            return self.default_is
        if isinstance(self.default, tuple):
            return " ".join(f"{value:g}" for value in self.default)
        return f"{self.default:g}" if isinstance(self.default, float) else str(self.default)

    @property
    def needed_text(self) -> str:
        """Whether it is needed, and where not."""
        return ", ".join(filter(None, ["needed" if self.needed else "", self.default_text]))

    @property
    def placeholder(self) -> str:
        """What stands for its value: a path, a number, or nothing for a switch."""
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
        """Return a value as its type.

        Raises
        ------
        SettingError
            If it is another type, not among the choices, or outside the rule.
        """
        if isinstance(value, str) and self.parse is not None:
            value = self.parse(self.flag[2:], value)
        if value is None and (self.default is None or type(None) in get_args(self.type)):
            return None
        value = tuple(value) if isinstance(value, list) else value
        wrong = None
        with suppress(TypeError):  # of what is no number at all
            wrong = None if self.rule is None else self.rule(self.flag[2:], value)
        if wrong is None and self.choices and value not in self.choices:
            wrong = f"{self.flag[2:]} '{value}' is not one of {', '.join(self.choices)}."
        if wrong is not None:
            raise SettingError(wrong)
        return _converted(self, value)


def _converted(one: Option, value: Any) -> Any:
    """Return numbers as Python's."""
    kinds = one.kinds
    if bool in kinds or isinstance(value, str | tuple | os.PathLike):
        if isinstance(value, str) and kinds in ((float,), (int,)):
            raise SettingError(f"{one.flag[2:]} {value!r} must be a number.")
        return value
    if kinds == (int,):
        if value != value or float(value) != math.floor(value):
            raise SettingError(f"{one.flag[2:]} {value} must be a whole number.")
        return int(value)
    return float(value) if float in kinds and hasattr(value, "__float__") else value


def option(default: Any, help: str, **more: Any) -> Any:
    """Declare an option; for the names of `more` see `Option`."""
    return field(default=default, metadata={"help": help, "option": Option(help, **more)})


@dataclass(frozen=True, kw_only=True)
class OptionSet:
    """The base of all classes of options: every value is checked against its rule.

    A class says in which `panel` of the help its own options stand, and whether they, where they
    have a unit, once had it in their names (`old_units`: ``radius_m`` is `radius` now).
    """

    panel: ClassVar[str] = ""
    old_units: ClassVar[bool] = False

    def __post_init__(self) -> None:
        for one in options_of(type(self)):
            object.__setattr__(self, one.name, one.checked(getattr(self, one.name)))
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
            one.name: _worded(one, getattr(self, one.name))
            for one in options_of(type(self))
            if getattr(self, one.name) != one.default
        }

    def as_dict(self) -> dict[str, Any]:
        """Return all values, as JSON holds them."""
        return {name: _plain(value) for name, value in asdict(self).items()}


def _worded(one: Option, value: Any) -> Any:
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
    if kind not in _KNOWN:
        _KNOWN[kind] = _options_of(kind)
    return _KNOWN[kind]


def _options_of(kind: type) -> tuple[Option, ...]:
    homes = {name: base for base in reversed(kind.__mro__) for name in get_annotations(base)}
    return tuple(_option(one, homes[one.name]) for one in fields(kind) if "option" in one.metadata)


def _option(one: Field[Any], home: type) -> Option:
    """Return the option of a field, with what the class that declares it says of all of its own."""
    own, declared = vars(home), cast(Option, one.metadata["option"])
    if own.get("old_units") and declared.unit:
        declared = declared._replace(old=(f"{one.name}_{declared.unit}",))
    kind = eval(str(one.type), vars(sys.modules[home.__module__]))
    panel = own.get("panel", "")
    return declared._replace(name=one.name, type=kind, default=one.default, panel=panel)


def table_of(kind: type) -> str:
    """Return the options of a class as a table of a document."""
    rows = ["| option | meaning | default |", "|---|---|---|"]
    for one in options_of(kind):
        if one.hidden:
            continue
        value = "\\|".join(one.choices) or one.metavar or one.placeholder
        flag = f"{one.flag} {value}".strip()
        rows.append(f"| `{flag}` | {one.help_text} | {one.needed_text} |")
    return "\n".join(rows)


def taken(kind: type[Set], given: OptionSet | None, keywords: Mapping[str, Any], where: str) -> Set:
    """Return the options that a Python function is called with.

    Parameters
    ----------
    kind : type
        The class of its options.
    given : OptionSet or None
        The argument ``options``.
    keywords : mapping
        The others, by name; names of old work with a warning.
    where : str
        Whose options they are, for messages.

    Raises
    ------
    SettingError
        If a name is unknown, or options are given both ways.
    """
    if given is not None and keywords:
        raise SettingError(
            f"{where}: give options=... or {next(iter(keywords))}=..., not both;"
            " dataclasses.replace changes single options."
        )
    if given is not None:
        return given if isinstance(given, kind) else given.part(kind)
    return kind(**named(keywords, options_of(kind), where))


def named(given: Mapping[str, Any], known: Iterable[Option], where: str) -> dict[str, Any]:
    """Return values under the names of today, and warn of older ones.

    Raises
    ------
    SettingError
        If a name is unknown; the message names the nearest known one.
    """
    options = list(known)
    names = [one.name for one in options]
    renamed = {old: one.name for one in options for old in one.old}
    found: dict[str, Any] = {}
    for name, value in _without_budget(given, names).items():
        if name in renamed:
            warnings.warn(
                f"{where}: {name} is called {renamed[name]} now; the old name goes with the next"
                " version.",
                PcfixWarning,
                stacklevel=4,
            )
        elif name not in names:
            near = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
            mean = f" did you mean {near[0]}?" if near else ""
            raise SettingError(
                f"{where}: there is no option '{name}';{mean} the options are {', '.join(names)}."
            )
        found[renamed.get(name, name)] = value
    return found


def _without_budget(given: Mapping[str, Any], known: list[str]) -> dict[str, Any]:
    """Return options with those of an old record's ``errors`` by their own names."""
    if "errors" not in given or "sigma_image" not in known:
        return dict(given)
    rest = {name: value for name, value in given.items() if name != "errors"}
    budget: dict[str, Any] = given["errors"] or {}
    return {**rest, **{f"sigma_{name.rpartition('_')[0] or name}": budget[name] for name in budget}}


def rule(holds: Callable[[Any], bool], sentence: str) -> Rule:
    """Return the rule that something holds; else a sentence with {option} and {value} in it."""

    def check(option: str, value: Any) -> str | None:
        return None if holds(value) else sentence.format(option=option, value=value)

    return check


def within(low: float, high: float, remedy: str, *, name: str = "", above: bool = False) -> Rule:
    """Return the rule of a range, without its lower end where `above`."""
    ends = f"{low:.1f} to {high:.1f}" if name else f"{low:g} to {high:g}"
    return rule(
        lambda value: (
            isinstance(value, str) or ((low < value if above else low <= value) and value <= high)
        ),
        f"{name or '{option}'} {{value:g}} is outside {ends}{remedy and ': ' + remedy}.",
    )


def not_negative(remedy: str) -> Rule:
    """Return the rule of what is finite and at least 0."""
    return rule(
        lambda value: math.isfinite(value) and value >= 0.0,
        f"{{option}} {{value:g}} must not be negative: {remedy}.",
    )


def at_least(low: float, remedy: str) -> Rule:
    """Return the rule of a lower end."""
    return rule(
        lambda value: not value < low, f"{{option}} {{value:g}} is less than {low:g}: {remedy}."
    )


def must_be(low: float, high: float, remedy: str, *, whole: bool = False) -> Rule:
    """Return the rule of finite numbers from low to high; a low of zero is itself not allowed."""
    least = "above 0" if low == 0.0 else f"at least {low:g}"
    most = f" and at most {high:g}" if math.isfinite(high) else ""

    def holds(value: Any) -> bool:
        number = math.nan if isinstance(value, str) else float(value)
        if not math.isfinite(number) or (whole and number != math.floor(number)):
            return False
        return (number > low if low == 0.0 else number >= low) and number <= high

    words = f"{'a whole number ' if whole else ''}{least}{most}"
    return rule(holds, f"{{option}} {{value}} must be {words}: {remedy}.")


def positive(sentence: str) -> Rule:
    """Return the rule of what is above zero and finite."""
    return rule(lambda value: 0.0 < value < math.inf, sentence)


def one_or_more(kind: type, example: str) -> Callable[[str, str], tuple[Any, ...]]:
    """Return the parser of words or numbers with commas between."""
    kinds = {int: "whole numbers", float: "numbers", str: "words"}

    def parse(option: str, text: str) -> tuple[Any, ...]:
        try:
            return tuple(kind(word.strip()) for word in text.split(",") if word.strip())
        except ValueError:
            raise SettingError(
                f"{option} '{text}' must be {kinds[kind]} with commas between, as {example}."
            ) from None

    return parse

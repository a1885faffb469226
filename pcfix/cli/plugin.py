"""The QGIS plugin as a ZIP: its files, and a table of the commands that it offers."""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Iterable
from typing import Any, get_args, get_type_hints

from pcfix.io.styles import packed
from pcfix.options.declare import Option, options_of
from pcfix.version import __version__

OFFERED = ("run", "correct", "label", "water", "compare", "photos")
_PLACES = {
    "output": "written", "out_dir": "folder written", "images": "folder", "reference": "file",
    "spec": "text",
}  # fmt: skip
"""Kinds of the positional arguments; the others are clouds."""
_WRITTEN = ("summary", "shoreline", "save_regression", "plot")
"""Options with a file to write; `out_dir` is a folder."""


def plugin_zip(commands: Iterable[Callable[..., None]]) -> bytes:
    """Return the plugin, with the commands among those given that it offers."""
    by_name = {command.__name__: command for command in commands}
    table = {"version": __version__, "commands": [_command(by_name[name]) for name in OFFERED]}
    return packed(json.dumps(table, indent=1) + "\n", __version__)


def _command(command: Callable[..., None]) -> dict[str, Any]:
    hints = get_type_hints(command, include_extras=True)
    options = options_of(get_args(hints["options"])[0])
    has_port = any(one.name == "port" for one in options)
    return {
        "name": command.__name__,
        "help": inspect.getdoc(command),
        "places": [
            {
                "name": name,
                "kind": _PLACES.get(name, "cloud"),
                "help": next(one.help for one in get_args(hints[name])[1:] if hasattr(one, "help")),
                "unit": "",
                "default": None,
                "needed": True,
            }
            for name, one in inspect.signature(command).parameters.items()
            if one.kind is inspect.Parameter.POSITIONAL_ONLY
        ],
        "options": [_option(one, instead=has_port and one.name == "water") for one in options],
    }


def _option(one: Option, *, instead: bool) -> dict[str, Any]:
    """Return an option for a form; with `instead`, another option can replace it."""
    kind, default = _kind(one), one.default
    if kind not in ("bool", "int", "float", "choice"):
        default = None  # an empty text is pcfix's own default
    default_words = f" Default: {one.default_text}." if one.default_text else ""
    return {
        "name": one.name,
        "flag": one.flag,
        "kind": kind,
        "choices": list(one.choices),
        "unit": one.unit,
        "default": default,
        "repeated": one.default == () and one.parse is None,
        "needed": one.needed and not one.default_is and not instead,
        "help": one.help + default_words,
    }


def _kind(one: Option) -> str:
    if one.name in _WRITTEN:
        return "written"
    if one.name == "out_dir":
        return "folder written"
    if one.metavar == "PATH" or one.placeholder == "PATH":
        return "file"
    if one.choices and one.parse is None:
        return "choice"
    for kind in (bool, int, float):
        if one.kinds == (kind,) and one.parse is None:
            return kind.__name__
    return "text"

"""Write the QGIS plugin: its files and a table of the commands that it offers, as a ZIP."""

from __future__ import annotations

import inspect
import json
from collections.abc import Mapping
from typing import Any

from pcfix.cli.flags import Command
from pcfix.io.files import packed_plugin
from pcfix.options.declare import Option, options_of
from pcfix.version import __version__

OFFERED = ("run", "correct", "label", "water", "compare", "photos")
_PLACES = {
    "output": "written", "out_dir": "folder written", "images": "folder", "reference": "file",
    "spec": "text",
}  # fmt: skip
"""Kinds of the positional arguments; the others are clouds."""


def plugin_zip(commands: Mapping[str, Command]) -> bytes:
    """Return the plugin with the `OFFERED` commands."""
    table = {"version": __version__, "commands": [_command(n, commands[n]) for n in OFFERED]}
    return packed_plugin(json.dumps(table, indent=1) + "\n", __version__)


def _command(name: str, command: Command) -> dict[str, Any]:
    options = options_of(command.kind)
    names = [one.name for one in options]
    return {
        "name": name,
        "help": inspect.getdoc(command.call),
        "places": [
            {
                "name": name,
                "kind": _PLACES.get(name, "cloud"),
                "help": command.helps[name],
                "unit": "",
                "default": None,
                "needed": True,
            }
            for name, one in inspect.signature(command.call).parameters.items()
            if one.kind is inspect.Parameter.POSITIONAL_ONLY
        ],
        "options": [_option(one, replaced=one.instead in names) for one in options],
    }


def _option(one: Option, *, replaced: bool) -> dict[str, Any]:
    """Return an option as a field of a form; `replaced` if another option can replace it."""
    kind, default = _kind(one), one.default
    if kind not in ("bool", "int", "float", "choice"):
        default = None  # an empty text is pcfix's own default
    help, _, unit = one.help.partition(" [")
    default_words = f" Default: {one.default_text}." if one.default_text else ""
    return {
        "name": one.name,
        "flag": one.flag,
        "kind": kind,
        "choices": list(one.choices),
        "unit": unit.removesuffix("]"),
        "default": default,
        "repeated": one.repeats,
        "needed": one.needed == "needed" and not replaced,
        "help": help + default_words,
    }


def _kind(one: Option) -> str:
    if one.writes:
        return "folder written" if one.name == "out_dir" else "written"
    if one.is_path:
        return "file"
    if one.choices and one.parse is None:
        return "choice"
    for kind in (bool, int, float):
        if one.kinds == (kind,) and one.parse is None:
            return kind.__name__
    return "text"

"""Options as flags of the command line, progress, and what is printed at the end."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, get_args, get_type_hints

from cyclopts import Group, Parameter

from pcfix.options.declare import Option, OptionSet, options_of
from pcfix.options.shared import Panel

FLAGS = Parameter(name="*")
"""Of a command's argument: each option of its class is a flag."""

_GROUPS: dict[str, Group] = {
    name: Group(name.value, sort_key=order) for order, name in enumerate(Panel)
}


MANY = 20
"""Of a command with more options `--help` shows the essential ones, and `--help-all` all."""
_ESSENTIAL = {
    "adjust", "adjusted_from", "also", "bed", "block", "cameras", "cameras_crs", "cloud",
    "connected", "depth", "drop", "dsm", "floating", "free", "gcps", "gnss", "gsd", "index",
    "jobs", "lens", "mapping", "max_angle", "max_incidence", "max_ray_miss", "method",
    "min_rays", "out_dir", "overwrite", "plot", "points", "port", "project", "radius",
    "rebuild", "reference", "resolution", "section", "seed", "shoreline", "submerged",
    "summary", "surface", "uncorrected", "views", "water", "water_mask",
}  # fmt: skip
"""Options that most people need, by name."""


class UsageError(Exception):
    """Flags that do not go together; exit code 2."""


def name_of(command: Callable[..., None]) -> str:
    """Return the name of a command on the command line."""
    return command.__name__.replace("_", "-")


def kind_of(command: Callable[..., None]) -> Any:
    """Return the class of the options of a command."""
    return get_args(get_type_hints(command, include_extras=True)["options"])[0]


def has_many(command: Callable[..., None]) -> bool:
    """Return whether a command has more options than `--help` shows."""
    return len(options_of(kind_of(command))) > MANY


def prepare(command: Callable[..., None], *, everything: bool) -> None:
    """Give cyclopts the options of a command: their types, panels and help."""
    kind, every = kind_of(command), everything or not has_many(command)
    hints = {
        one.name: Annotated[_type(one), _parameter(one, every or one.name in _ESSENTIAL)]
        for one in options_of(kind)
    }
    hints["index_from"] = Annotated[str, Parameter(parse=False)]
    for base in kind.__mro__:
        own = vars(base).get("__annotations__", {})
        own.update({name: hints[name] for name in own.keys() & hints.keys()})
    kind.__init__.__annotations__.update({**hints, "return": None})


def check_needed(options: OptionSet, *, water: bool = True) -> None:
    """Refuse a command without the options that it needs; `water` tells whether that is one."""
    for one in options_of(type(options)):
        wanted = one.needed and (water or one.name != "water")
        wanted = wanted and (one.name != "cameras" or getattr(options, "needs_cameras", True))
        if wanted and getattr(options, one.name) is None:
            raise UsageError(f"{one.flag} is needed")


def _type(one: Option) -> Any:
    """Return the type that cyclopts makes of the text; for an option with a parser it is text."""
    if one.metavar == "PATH" or os.PathLike[str] in one.kinds:
        return Path | None
    if one.parse is not None or one.type is Any:
        return str | one.type if isinstance(one.default, tuple) else str | None
    if one.default == ():
        return tuple[str, ...]
    return one.type | None if one.default is None else one.type


def _parameter(one: Option, is_shown: bool) -> Parameter:
    default = "" if one.needed else one.default_text
    has_opposite = one.type is bool and (one.default or one.name == "connected")
    return Parameter(
        help=f"{one.help_text}{f' ({one.needed_text})' if one.needed else ''}",
        group=_GROUPS[one.panel],
        show=is_shown,
        negative_bool="no-" if has_opposite else (),
        negative_none="no-" if one.name in ("below", "floating") else (),
        negative_iterable=(),
        allow_repeating=True,  # the last one counts
        allow_leading_hyphen=one.metavar in ("X,Y,Z", "X,Y,X,Y", "LOW,HIGH"),  # below zero
        show_default=(lambda value: default) if default else False,
    )


Quiet = Annotated[
    bool,
    Parameter(
        name=["--quiet", "-q"],
        negative=(),
        allow_repeating=True,
        group=_GROUPS[Panel.OUTPUT],
        help="No summary and no progress.",
        show_default=False,
    ),
]


def _announce_compiling() -> None:
    """Print on a terminal that the first command compiles the kernels."""
    from pcfix.kernels import cache_folder

    folder = cache_folder()
    if folder is None or not any(folder.iterdir()):
        sys.stderr.write("Compiling the kernels; the first command takes about a minute longer.\n")


@contextmanager
def progress_bar(
    title: str, quiet: bool, unit: str = "points"
) -> Iterator[Callable[[int, int], None] | None]:
    """Show a bar with units/s and the remaining time on a terminal; nothing if piped.

    With ``PCFIX_PROGRESS=lines`` it is a line for each percent, for programs that call this one.
    """
    if os.environ.get("PCFIX_PROGRESS") == "lines":
        shown = -1

        def print_percent(done: int, total: int) -> None:
            nonlocal shown
            percent = 100 * done // max(total, 1)
            if percent != shown:
                shown = percent
                sys.stderr.write(f"progress {percent}\n")
                sys.stderr.flush()

        yield print_percent
        return
    if quiet or not sys.stderr.isatty():
        yield None
        return
    _announce_compiling()
    from rich import progress
    from rich.console import Console

    columns = (
        progress.TextColumn("{task.description}"),
        progress.BarColumn(),
        progress.TaskProgressColumn(),
        progress.TextColumn("{task.fields[rate]}"),
        progress.TimeRemainingColumn(elapsed_when_finished=True),
    )
    with progress.Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(title, total=None, rate="")
        started = time.perf_counter()

        def update(done: int, total: int) -> None:
            rate = done / (time.perf_counter() - started)
            text = f"{rate:,.0f} {unit}/s" if rate > 10.0 else f"{60.0 * rate:.0f} {unit}/min"
            bar.update(task, completed=done, total=total, rate=text)

        yield update


@contextmanager
def status_line(title: str, quiet: bool) -> Iterator[Callable[[Any], None] | None]:
    """Show on a terminal one line that changes; nothing if piped."""
    if quiet or not sys.stderr.isatty():
        yield None
        return
    _announce_compiling()
    from rich.console import Console

    with Console(stderr=True).status(title) as status:
        yield lambda text: status.update(f"{title}: {text}")


def say(text: str, quiet: bool = False) -> None:
    """Print a summary, unless `quiet`."""
    if not quiet:
        sys.stdout.write(text + "\n")

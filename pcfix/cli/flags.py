"""Options as flags of the command line and as forms of QGIS; progress; the printed summary."""

import inspect
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, NamedTuple, get_type_hints

from cyclopts import Group, Parameter

from pcfix.options.declare import Option, OptionSet, options_of
from pcfix.options.shared import Panel
from pcfix.version import __version__

MANY = 20  # if a command has more options, `--help` shows the basic ones, and `--help-all` all
_GROUPS = {name: Group(name.value, sort_key=order) for order, name in enumerate(Panel)}
_QUIET = Parameter(
    name=["--quiet", "-q"],
    negative=(),
    allow_repeating=True,
    group=_GROUPS[Panel.OUTPUT],
    help="Print no summary and no progress.",
    show_default=False,
)


class UsageError(Exception):
    """Wrong usage of flags; exit code 2."""


class Command(NamedTuple):
    """A command: a function of positional arguments, of `options`, and of further flags."""

    call: Callable[..., None]
    kind: type[OptionSet]
    example: str
    helps: dict[str, str]  # the help of its arguments and of flags that are not options

    @property
    def has_many(self) -> bool:
        """Whether `--help` shows only some of its options."""
        return len(options_of(self.kind)) > MANY

    def flat(self, *, everything: bool = False) -> Callable[..., None]:
        """Return a function with a keyword for each option, as cyclopts reads it."""
        every, options = everything or not self.has_many, options_of(self.kind)
        hints, shown = get_type_hints(self.call), []
        for name, one in inspect.signature(self.call).parameters.items():
            if name == "options":
                shown += [_keyword(each, every or each.basic) for each in options]
            elif name == "quiet":
                shown.append(one.replace(annotation=Annotated[bool, _QUIET], default=False))
            else:
                place = Parameter(help=self.helps[name], negative=(), show_default=False)
                if one.kind is one.KEYWORD_ONLY:
                    place = Parameter.combine(place, Parameter(group=_GROUPS[Panel.OUTPUT]))
                shown.append(one.replace(annotation=Annotated[hints[name], place]))

        def call(*places: Any, **given: Any) -> None:
            names = [one.name for one in options if one.name in given]
            asked = self.kind(**{name: given.pop(name) for name in names})
            missing = asked.missing()
            if missing:
                other = f", or --{missing.instead}" if hasattr(asked, missing.instead) else ""
                raise UsageError(f"{missing.flag} is needed{other}")
            quiet = {"quiet": given.pop("quiet", False)} if "quiet" in hints else {}
            self.call(*places, options=asked, **quiet, **given)

        call.__signature__ = inspect.Signature(shown)  # type: ignore[attr-defined]
        return call


COMMANDS: dict[str, Command] = {}  # the commands by name, in the order of the help


def command(example: str, **helps: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Register a function as a command, with an example and the help of its arguments."""

    def add(call: Callable[..., None]) -> Callable[..., None]:
        kind = get_type_hints(call)["options"]
        COMMANDS[call.__name__.replace("_", "-")] = Command(call, kind, example, helps)
        return call

    return add


def _keyword(one: Option, is_shown: bool) -> inspect.Parameter:
    """Return an option as a keyword; text for a parser is passed on unchanged."""
    kind: Any = one.type if one.default is not None else one.type | None
    if one.repeats:
        kind = tuple[str, ...]
    elif one.is_path:
        kind = Path | None
    elif one.parse is not None or one.type is Any:
        # cyclopts may check the default, too
        kind = str | one.type if isinstance(one.default, tuple) else str | None
    default = "" if one.needed else one.default_text
    has_opposite = one.off or (one.type is bool and one.default)
    parameter = Parameter(
        help=f"{one.help} ({one.needed})" if one.needed else one.help,
        group=_GROUPS[Panel(one.panel)],
        show=is_shown,
        negative_bool="no-" if has_opposite else (),
        negative_none="no-" if has_opposite else (),
        negative_iterable=(),
        allow_repeating=True,  # the last one counts
        allow_leading_hyphen="," in one.metavar,  # the first number may be negative
        show_default=(lambda value: default) if default else False,
    )
    return inspect.Parameter(
        one.name, inspect.Parameter.KEYWORD_ONLY, default=one.default,
        annotation=Annotated[kind, parameter],
    )  # fmt: skip


# Forms of the plugin of QGIS

OFFERED = ("run", "correct", "label", "water", "compare", "photos")
# Kinds of the positional arguments; the others are clouds.
_PLACES = {
    "output": "written", "out_dir": "folder written", "images": "folder", "reference": "file",
    "spec": "text",
}  # fmt: skip


def plugin_table(commands: Mapping[str, Command]) -> str:
    """Return the forms of the `OFFERED` commands as JSON."""
    import json  # slow to import

    forms = list[dict[str, Any]]()
    always = {"unit": "", "default": None, "needed": True}
    for title, (call, kind, _, helps) in ((name, commands[name]) for name in OFFERED):
        places = [
            {"name": name, "kind": _PLACES.get(name, "cloud"), "help": helps[name], **always}
            for name, one in inspect.signature(call).parameters.items()
            if one.kind is one.POSITIONAL_ONLY
        ]
        names = [one.name for one in options_of(kind)]
        fields = [_field(one, replaced=one.instead in names) for one in options_of(kind)]
        about = {"name": title, "help": inspect.getdoc(call)}
        forms.append(about | {"places": places, "options": fields})
    return json.dumps({"version": __version__, "commands": forms}, indent=1) + "\n"


def _field(one: Option, *, replaced: bool) -> dict[str, Any]:
    """Return an option as a field of a form; `replaced` if another option can replace it."""
    plain = [x.__name__ for x in (bool, int, float) if one.kinds == (x,) and one.parse is None]
    kind, default = plain[0] if plain else "text", one.default
    if one.writes:
        kind = "folder written" if one.name == "out_dir" else "written"
    elif one.is_path:
        kind = "file"
    elif one.choices and one.parse is None:
        kind = "choice"
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


# Progress and summary


def _terminal(quiet: bool) -> Any:
    """Return the console for progress, None if there is none; announce that kernels compile."""
    if quiet or not sys.stderr.isatty():
        return None
    from rich.console import Console

    from pcfix.kernels import cache_folder

    folder = cache_folder()
    if folder is None or not any(folder.iterdir()):
        sys.stderr.write("Compiling the kernels; the first command takes about a minute longer.\n")
    return Console(stderr=True)


@contextmanager
def progress_bar(
    title: str, quiet: bool, unit: str = "points"
) -> Iterator[Callable[[int, int], None] | None]:
    """Show a progress bar with speed and remaining time on a terminal.

    With ``PCFIX_PROGRESS=lines`` print a line for each percent, for programs that call this one.
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
    if (console := _terminal(quiet)) is None:
        yield None
        return
    from rich import progress

    columns = (
        progress.TextColumn("{task.description}"),
        progress.BarColumn(),
        progress.TaskProgressColumn(),
        progress.TextColumn("{task.fields[rate]}"),
        progress.TimeRemainingColumn(elapsed_when_finished=True),
    )
    with progress.Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(title, total=None, rate="")
        started = time.perf_counter()

        def update(done: int, total: int) -> None:
            rate = done / (time.perf_counter() - started)
            text = f"{rate:,.0f} {unit}/s" if rate > 10.0 else f"{60.0 * rate:.0f} {unit}/min"
            bar.update(task, completed=done, total=total, rate=text)

        yield update


@contextmanager
def status_line(title: str, quiet: bool) -> Iterator[Callable[[Any], None] | None]:
    """Show a status line on a terminal."""
    if (console := _terminal(quiet)) is None:
        yield None
        return
    with console.status(title) as status:
        yield lambda text: status.update(f"{title}: {text}")


def say(text: str, quiet: bool = False) -> None:
    """Print a summary, unless `quiet`."""
    if not quiet:
        sys.stdout.write(text + "\n")

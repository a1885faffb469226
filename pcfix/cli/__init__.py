"""Door 1, the command line: flags from the tables of options, one function a command."""

from __future__ import annotations

import atexit
import gc
import signal
import sys
import warnings
from collections.abc import Sequence
from typing import Any

from cyclopts import App, CycloptsError

from pcfix.cli.commands import EXAMPLES
from pcfix.cli.flags import UsageError, has_many, name_of, prepare
from pcfix.errors import PcfixError, brief, refusal, show_warning
from pcfix.version import __version__

app = App(
    name="pcfix",
    help="Refraction correction of through-water photogrammetric point clouds.",
    version=f"pcfix {__version__}",
    version_flags=["--version"],
    help_flags=["--help", "-h"],
    help_format="plaintext",
    suppress_keyboard_interrupt=False,
)
for place, (command, example) in enumerate(EXAMPLES):
    summary, _, more = str(command.__doc__).partition("\n")
    lines = [summary, *(line.strip() for line in more.splitlines()), "", f"Example: {example}"]
    app.command(
        command,
        name=name_of(command),
        help="\n".join(lines).replace("\n\n\n", "\n\n"),
        sort_key=place,
    )


def main(tokens: Sequence[str] | None = None) -> None:
    """Run the command line; a user's mistake is one line on stderr and exit code 1."""
    arguments = list(sys.argv[1:] if tokens is None else tokens)
    try:
        _end_by_signals()
        # Modules and kernels are hundreds of thousands of objects that stay: searching them for
        # garbage, often and at the end, took a fifth of a start.
        gc.set_threshold(50_000, 20, 50)
        atexit.register(gc.freeze)
        _run(arguments)
    except CycloptsError as error:
        if isinstance(error.__cause__, PcfixError):
            _stop(str(error.__cause__), 1)
        _stop(f"{error}\n{_try(arguments)}", 2)
    except UsageError as error:
        _stop(f"{error}\n{_try(arguments)}", 2)
    except PcfixError as error:
        _stop(str(error), 1)
    except UnicodeEncodeError as error:
        if error.encoding != "utf-8" or "\n" in error.object:
            raise
        _stop(f"{error.object}: the name is not in UTF-8. Rename the file.", 1)
    except _EndedError as end:
        _stop("stopped.", 128 + end.args[0])
    except KeyboardInterrupt as stop:
        _stop(str(stop) or "stopped.", 130)
    except BrokenPipeError:
        sys.exit(1)
    except OSError as error:
        if error.filename is None:
            raise
        _stop(f"{error.filename}: {refusal(error)}.", 1)


def _run(arguments: list[str]) -> None:
    warnings.showwarning = show_warning
    everything = "--help-all" in arguments
    arguments = ["--help" if one == "--help-all" else one for one in arguments]
    for command, _ in EXAMPLES:
        name = name_of(command)
        if name in arguments[:1]:
            prepare(command, everything=everything)
            if has_many(command) and not everything:
                app[name].help += f"\nAll options: pcfix {name} --help-all"
    if arguments in ([], *([name] for name in app if name not in ("demo", "--version"))):
        app([*arguments, "--help"], result_action="return_value")
        sys.exit(0 if arguments in (["--help"], ["-h"]) else 2)
    app(arguments, exit_on_error=False, print_error=False, result_action="return_value")


class _EndedError(KeyboardInterrupt):
    """Another process ends this one, which cleans up as after Ctrl-C."""


def _end_by_signals() -> None:
    """Let SIGTERM and SIGHUP end the process as Ctrl-C does, unless they are ignored."""

    def end(number: int, frame: Any) -> None:
        raise _EndedError(number)

    for name in ("SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, end)


def _try(arguments: list[str]) -> str:
    """Return where help is."""
    name = next((name_of(c) for c, _ in EXAMPLES if name_of(c) in arguments[:1]), "")
    return f"Try '{' '.join(filter(None, ('pcfix', name, '--help')))}'."


def _stop(sentence: str, code: int) -> None:
    sys.stderr.write(f"pcfix: {brief(sentence)}\n")
    sys.exit(code)

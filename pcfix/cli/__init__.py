"""The command line: flags from the declared options, and one function for each command."""

import atexit
import gc
import inspect
import signal
import sys
import warnings
from collections.abc import Sequence
from threading import Timer
from typing import Any

from cyclopts import App, CycloptsError

import pcfix.cli.commands  # noqa: F401 (fills COMMANDS)
from pcfix.cli.flags import COMMANDS, UsageError
from pcfix.errors import PcfixError, printable, refusal, show_warning
from pcfix.version import __version__


def app_for(arguments: Sequence[str], *, everything: bool = False) -> App:
    """Return the program; only the command in the arguments gets its flags."""
    app = App(
        name="pcfix",
        help="Refraction correction of through-water photogrammetric point clouds.",
        version=f"pcfix {__version__}",
        version_flags=["--version"],
        help_flags=["--help", "-h"],
        help_format="plaintext",
        suppress_keyboard_interrupt=False,
    )
    for place, (name, one) in enumerate(COMMANDS.items()):
        is_asked = name in arguments[:1]
        lines = [str(inspect.getdoc(one.call)), "", f"Example: {one.example}"]
        if is_asked and one.has_many and not everything:
            lines.append(f"All options: pcfix {name} --help-all")
        call = one.flat(everything=everything) if is_asked else one.call
        app.command(call, name=name, help="\n".join(lines), sort_key=place)
    return app


def main(tokens: Sequence[str] | None = None) -> None:
    """Run the command line; a mistake of the user gives one line on stderr and exit code 1."""
    arguments = list(sys.argv[1:] if tokens is None else tokens)
    ended = list[int]()
    try:
        _end_by_signals(ended)
        # Modules and kernels are hundreds of thousands of permanent objects. Collecting garbage
        # among them, often and at the end, took a fifth of the start.
        gc.set_threshold(500_000, 20, 50)
        atexit.register(gc.freeze)
        warnings.showwarning = show_warning
        everything = "--help-all" in arguments
        shown = ["--help" if one == "--help-all" else one for one in arguments]
        app = app_for(shown, everything=everything)
        if shown in ([], *([name] for name in COMMANDS if name != "demo")):
            app([*shown, "--help"], result_action="return_value")
            sys.exit(2)
        app(shown, exit_on_error=False, print_error=False, result_action="return_value")
    except (CycloptsError, UsageError) as error:
        words = ["pcfix", *(one for one in arguments[:1] if one in COMMANDS), "--help"]
        _stop(f"{printable(str(error))}\nTry '{' '.join(words)}'.", 2)
    except PcfixError as error:
        if ended:  # a library may report an interrupt as an error of the file it writes
            _stop("stopped.", 128 + ended[0])
        _stop(str(error), 1)
    except UnicodeEncodeError as error:
        if error.encoding != "utf-8" or "\n" in error.object:
            raise
        _stop(printable(f"{error.object}: the name is not in UTF-8. Rename the file."), 1)
    except KeyboardInterrupt:
        _stop("stopped.", 128 + [*ended, signal.SIGINT][0])
    except BrokenPipeError:
        sys.exit(1)
    except OSError as error:
        if error.filename is None:
            raise
        _stop(printable(f"{error.filename}: {refusal(error)}."), 1)


def _end_by_signals(ended: list[int]) -> None:
    """Make SIGTERM and SIGHUP end the process as Ctrl-C does, unless they are ignored.

    The number of the signal is appended to `ended`.
    """

    def end(number: int, frame: Any) -> None:
        caller = frame
        while caller is not None:
            if "llvmlite" in caller.f_code.co_filename:
                # an exception in a callback of LLVM would crash the process: send it again later
                Timer(0.05, signal.raise_signal, (number,)).start()
                return
            caller = caller.f_back
        ended.append(number)
        raise KeyboardInterrupt

    usual = (signal.SIG_DFL, signal.default_int_handler)
    for number in (getattr(signal, one, None) for one in ("SIGINT", "SIGTERM", "SIGHUP")):
        if number is not None and signal.getsignal(number) in usual:
            signal.signal(number, end)


def _stop(sentence: str, code: int) -> None:
    sys.stderr.write(f"pcfix: {sentence}\n")
    sys.exit(code)

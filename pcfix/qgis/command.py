"""Run a command of pcfix from the values of a form: command line, process, messages."""

import os
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

HELP = (
    "Install pcfix into an environment (pip install pcfix), and give that environment, or its"
    " program pcfix, under Settings > Options > Processing > Providers > pcfix."
)
PROGRESS = "progress "  # the beginning of a line of progress; percent follow
_WAIT_S, _PATIENCE_S = 0.2, 10.0


class CommandError(Exception):
    """A mistake that the user can correct."""


def program_of(setting: str) -> str:
    """Return the program of an environment, or of the search path if none is given."""
    named = setting.strip() or "pcfix"
    tries = [named]
    if Path(named).is_dir():
        tries = [str(Path(named, *place)) for place in (("bin", "pcfix"), ("Scripts", "pcfix.exe"))]
    found = next(filter(None, map(shutil.which, tries)), None)
    if found is None:
        raise CommandError(f"There is no pcfix at '{named}'. {HELP}")
    return found


def words_of(command: dict[str, Any], values: dict[str, Any]) -> list[str]:
    """Return the command line: arguments, then the options that differ from their defaults."""
    words = [command["name"]]
    words += [str(values[one["name"]]) for one in command["places"]]
    for one in command["options"]:
        value = values.get(one["name"])
        if value in (None, "") or value == one["default"]:
            continue
        if one["kind"] == "bool":
            words.append(one["flag"] if value else one["flag"].replace("--", "--no-", 1))
            continue
        parts = str(value).split(";") if one["repeated"] else [str(value)]
        words += [f"{one['flag']}={part.strip()}" for part in parts]
    return words


def run(
    program: str, words: list[str], is_cancelled: Callable[[], bool],
    percent: Callable[[float], None], say: Callable[[str], None],
) -> None:  # fmt: skip
    """Run pcfix to its end and pass on what it prints.

    Raises CommandError, with the last line that it printed, if it fails or was cancelled.
    """
    outer = {k: v for k, v in os.environ.items() if k not in ("PYTHONHOME", "PYTHONPATH")}
    try:
        process = subprocess.Popen(
            [program, *words], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, text=True, encoding="utf-8", errors="replace",
            env={**outer, "PCFIX_PROGRESS": "lines", "PYTHONIOENCODING": "utf-8"},
        )  # fmt: skip
    except OSError as error:
        raise CommandError(f"{program} cannot be run ({error.strerror}). {HELP}") from error
    threading.Thread(target=_watch, args=(process, is_cancelled), daemon=True).start()
    last = ""
    with process:
        for line in map(str.rstrip, process.stdout or ()):
            if line.startswith(PROGRESS):
                percent(float(line[len(PROGRESS) :]))
            elif line:
                last = line
                say(line)
    if is_cancelled():
        raise CommandError("Cancelled; unfinished output was removed.")
    if process.returncode:
        why = last.removeprefix("pcfix: ")
        raise CommandError(why or f"Exit code {process.returncode}. {HELP}")


def _watch(process: subprocess.Popen[str], is_cancelled: Callable[[], bool]) -> None:
    """Interrupt a process if it is cancelled, and kill it after a while."""
    while process.poll() is None:
        time.sleep(_WAIT_S)
        if is_cancelled():
            process.send_signal(signal.SIGTERM if os.name == "nt" else signal.SIGINT)
            try:
                process.wait(_PATIENCE_S)
            except subprocess.TimeoutExpired:
                process.kill()
            return

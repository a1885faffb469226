"""A command of pcfix, from the values of a form: its words, its process, what it says."""

from __future__ import annotations

import os
import queue
import shutil
import signal
import struct
import subprocess
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

HELP = (
    "install pcfix into an environment of its own (pip install pcfix), and name that environment,"
    " or its program pcfix, under Settings > Options > Processing > Providers > pcfix."
)
PROGRESS = "progress "
"""How a line of progress begins: percent follows."""
_WAIT_S, _PATIENCE_S = 0.2, 10.0


class CommandError(Exception):
    """What went wrong, in a sentence for the user."""


def program_of(setting: str) -> str:
    """Return the program of an environment, or of the search path where none is named.

    A `CommandError` if there is none.
    """
    named = setting.strip() or "pcfix"
    tries = [named]
    if Path(named).is_dir():
        tries = [str(Path(named, *way)) for way in (("bin", "pcfix"), ("Scripts", "pcfix.exe"))]
    found = next(filter(None, map(shutil.which, tries)), None)
    if found is None:
        raise CommandError(f"pcfix is not at '{named}': {HELP}")
    return found


def words_of(command: dict[str, Any], values: dict[str, Any]) -> list[str]:
    """Return the command line: places first, then the options that are not as by default."""
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


def check_cloud(path: str) -> str:
    """Return a note on a cloud that says nothing of where it lies; empty where it does.

    A `CommandError` if it is none that pcfix reads.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in (".las", ".laz"):
        raise CommandError(
            f"{path}: pcfix reads LAS and LAZ; export the cloud as LAZ, or convert it"
            " with 'pdal translate IN OUT.laz' or CloudCompare."
        )
    try:
        named = _names_crs(path)
    except (OSError, struct.error) as error:
        raise CommandError(f"{path}: cannot be read ({error}).") from error
    if named:
        return ""
    return (
        f"{path} names no CRS: it is taken to be in metres and in that of the cameras, and what"
        " is loaded has no CRS either; set it in the layer's properties, or write it into the"
        " cloud with 'pdal translate --writers.las.a_srs=EPSG:CODE'."
    )


def _names_crs(path: str) -> bool:
    """Return whether a LAS file has a record of a projection, before its points or behind."""
    with open(path, "rb") as file:  # noqa: PTH123
        head = file.read(375)
        if head[:4] != b"LASF":
            raise OSError("it is not a LAS file")
        start, count = struct.unpack_from("<H4xI", head, 94)
        size, behind = 54, (0, 0)
        if head[25] >= 4:
            behind = struct.unpack_from("<QI", head, 235)
        for at, records, head_size, layout in (
            (start, count, size, "<2x16s2xH"), (*behind, 60, "<2x16s2xQ")
        ):  # fmt: skip
            file.seek(at)
            for _ in range(records):
                user, length = struct.unpack_from(layout, file.read(head_size))
                if user.rstrip(b"\0") == b"LASF_Projection":
                    return True
                file.seek(length, os.SEEK_CUR)
    return False


def run(
    program: str,
    words: list[str],
    is_cancelled: Callable[[], bool],
    percent: Callable[[float], None],
    say: Callable[[str], None],
) -> None:
    """Run pcfix to its end, and pass on what it says.

    A `CommandError` with its own last sentence if it fails, or if it was cancelled.
    """
    kept = {k: v for k, v in os.environ.items() if k not in ("PYTHONHOME", "PYTHONPATH")}
    try:
        process = subprocess.Popen(
            [program, *words], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, text=True, encoding="utf-8", errors="replace",
            env={**kept, "PCFIX_PROGRESS": "lines", "PYTHONIOENCODING": "utf-8"},
        )  # fmt: skip
    except OSError as error:
        raise CommandError(f"{program} cannot be run ({error.strerror}): {HELP}") from error
    last = ""
    for line in _lines(process, is_cancelled):
        if line.startswith(PROGRESS):
            percent(float(line[len(PROGRESS) :]))
        elif line.strip():
            last = line
            say(line)
    if is_cancelled():
        raise CommandError("cancelled; what was half written is gone.")
    if process.returncode:
        raise CommandError(
            last.removeprefix("pcfix: ") or f"exit code {process.returncode}: {HELP}"
        )


def _lines(process: subprocess.Popen[str], is_cancelled: Callable[[], bool]) -> Iterator[str]:
    """Yield the lines of a process as they come; a cancelled one is asked to stop, then made to."""
    lines: queue.Queue[str | None] = queue.Queue()

    def read(stream: IO[str]) -> None:
        with stream:
            for line in stream:
                lines.put(line.rstrip())
        lines.put(None)

    threading.Thread(target=read, args=(process.stdout,), daemon=True).start()
    while True:
        if is_cancelled():
            if os.name == "nt":
                process.terminate()
            else:
                process.send_signal(signal.SIGINT)
            break
        try:
            line = lines.get(timeout=_WAIT_S)
        except queue.Empty:
            continue
        if line is None:
            break
        yield line
    try:
        process.wait(_PATIENCE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()

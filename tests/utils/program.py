"""``pcfix`` on the command line, run in this process: what a shell sees, but sooner."""

from __future__ import annotations

import contextlib
import io
import sys
import warnings
from subprocess import CompletedProcess
from typing import TYPE_CHECKING
from unittest import mock

from pcfix import cli

if TYPE_CHECKING:
    from pathlib import Path


def run_pcfix(*words: object, folder: Path | str = ".") -> CompletedProcess[str]:
    """Return the exit code, stdout and stderr of a command that is run in a folder.

    Warnings are printed as in a new process, whatever pytest makes of them elsewhere. What is
    about processes (broken pipes, limits, terminals, what is imported) needs a real one.
    """
    arguments = [str(word) for word in words]
    out, err = io.StringIO(), io.StringIO()
    code = 0
    with (
        contextlib.chdir(folder),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        mock.patch.object(sys, "argv", ["pcfix", *arguments]),
        warnings.catch_warnings(),
    ):
        warnings.resetwarnings()
        for kind in (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning):
            warnings.simplefilter("ignore", kind)
        try:
            cli.main()
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    return CompletedProcess(arguments, code, out.getvalue(), err.getvalue())

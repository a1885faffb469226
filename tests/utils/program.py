"""``pcfix`` on the command line, run in this process: what a shell sees, but sooner."""

import contextlib
import io
import sys
import warnings
from pathlib import Path
from subprocess import CompletedProcess
from unittest import mock

from pcfix import cli
from pcfix.errors import PcfixError, PcfixWarning, show_warning


class Done(CompletedProcess[str]):
    """A command that has ended.

    Attributes
    ----------
    error : PcfixError or None
        What it was refused with.
    warnings : list of PcfixWarning
    """

    error: PcfixError | None = None
    warnings: list[PcfixWarning]

    @property
    def code(self) -> str:
        """Return the code of the refusal; empty if there was none."""
        return self.error.code if self.error else ""

    @property
    def warned(self) -> list[str]:
        """Return the codes of the warnings."""
        return [one.code for one in self.warnings]


def run_pcfix(*words: object, folder: Path | str = ".") -> Done:
    """Return the exit code, stdout, stderr, error and warnings of a command run in a folder.

    Warnings are printed as in a new process, whatever pytest makes of them elsewhere. What is
    about processes (broken pipes, limits, terminals, what is imported) needs a real one.
    """
    arguments = [str(word) for word in words]
    out, err = io.StringIO(), io.StringIO()
    code, error, warned = 0, None, []

    def show(message, category, *where, **more):
        warned.extend([message] if isinstance(message, PcfixWarning) else [])
        show_warning(message, category)

    with (
        contextlib.chdir(folder),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        mock.patch.object(sys, "argv", ["pcfix", *arguments]),
        mock.patch.object(cli, "show_warning", show),
        warnings.catch_warnings(),
    ):
        warnings.resetwarnings()
        for kind in (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning):
            warnings.simplefilter("ignore", kind)
        try:
            cli.main()
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
            error = stop.__context__
            if not isinstance(error, PcfixError):  # an option that its parser refused
                error = getattr(error, "__cause__", None)
    done = Done(arguments, code, out.getvalue(), err.getvalue())
    done.error, done.warnings = error if isinstance(error, PcfixError) else None, warned
    if done.error is not None:  # its frames would hold open files
        done.error.__traceback__ = done.error.__context__ = done.error.__cause__ = None
    return done

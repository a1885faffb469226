"""Door 1, the command line: one file per command; each turns words into one call, no more."""

from __future__ import annotations

import sys
import warnings
from typing import Annotated

import typer

import pcfix
from pcfix.cli.adjust import adjust
from pcfix.cli.cameras import cameras
from pcfix.cli.clean import clean
from pcfix.cli.compare import compare
from pcfix.cli.correct import correct, pipeline
from pcfix.cli.dsm import dsm
from pcfix.cli.label import label
from pcfix.cli.restore import restore
from pcfix.cli.run import run
from pcfix.cli.simulate import demo, simulate
from pcfix.cli.water import water
from pcfix.errors import PcfixError, show_warning

app = typer.Typer(
    name="pcfix",
    help="Refraction correction of through-water photogrammetric point clouds.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
COMMANDS = (
    run, correct, adjust, label, clean, dsm, compare, cameras, water, restore, simulate, pipeline,
)  # fmt: skip
for command in COMMANDS:
    app.command(no_args_is_help=True)(command)
app.command()(demo)


@app.callback(invoke_without_command=True)
def version(
    show: Annotated[bool, typer.Option("--version", help="Print the version and stop.")] = False,
) -> None:
    """Refraction correction of through-water photogrammetric point clouds."""
    if show:
        typer.echo(f"pcfix {pcfix.__version__}")
        raise typer.Exit


def main() -> None:
    """Run the command line; a user's mistake is one line on stderr and exit code 1."""
    warnings.showwarning = show_warning
    try:
        app()
    except PcfixError as error:
        typer.echo(f"pcfix: {error}", err=True)
        sys.exit(1)
    except BrokenPipeError:
        sys.exit(1)

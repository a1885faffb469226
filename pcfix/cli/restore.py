"""``pcfix restore``."""

from __future__ import annotations

import typer

import pcfix
from pcfix.cli.words import Input, Jobs, Output, Overwrite, Quiet, progress_bar


def restore(
    input: Input,
    output: Output,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    jobs: Jobs = None,
) -> None:
    """Give back the cloud as it was before 'pcfix correct', bit for bit."""
    with progress_bar("Restoring", quiet) as progress:
        points = pcfix.restore_file(
            input, output, overwrite=overwrite, jobs=jobs, progress=progress
        )
    if not quiet:
        typer.echo(f"{input} -> {output}: {points:,} points as they were")

"""``pcfix water``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pcfix.cli.groups import WaterFitWords, takes
from pcfix.cli.words import Overwrite, SummaryOption  # noqa: TC001 - typer reads them

Spec = Annotated[
    str,
    typer.Argument(metavar="SPEC", help="As --water of 'pcfix correct'.", show_default=False),
]
Cloud = Annotated[Path | None, typer.Option(help="LAS or LAZ cloud under it.")]
Plot = Annotated[Path | None, typer.Option(help="PNG of points and residuals, or of evidence.")]


@takes(WaterFitWords)
def water(
    words: WaterFitWords,
    spec: Spec,
    cloud: Cloud = None,
    plot: Plot = None,
    summary: SummaryOption = None,
    overwrite: Overwrite = False,
) -> None:
    """Read, fit or find a water surface, and say how well it is known."""
    import json

    from pcfix.flow.checks import check_water
    from pcfix.flow.surfaces import WaterWords
    from pcfix.io.files import check_output, write_text
    from pcfix.report.water import water_text

    if summary is not None:
        check_output(summary, overwrite=overwrite)
    given = WaterWords(spec, words.water_model.value, words.water_crs)
    report = check_water(given, cloud, plot=plot, overwrite=overwrite)
    if summary is not None:
        text = json.dumps(report.as_dict(), indent=2) + "\n"
        write_text(summary, text, overwrite=overwrite)
    typer.echo(water_text(report))

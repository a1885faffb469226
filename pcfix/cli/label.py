"""``pcfix label``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from pcfix.cli.groups import LabelWords, takes
from pcfix.cli.words import (
    Input,
    Jobs,
    Output,
    Overwrite,
    Quiet,
    SummaryOption,
    WaterOption,
    progress_bar,
)

if TYPE_CHECKING:
    from pcfix.flow.label import LabelSummary

Band = Annotated[
    float,
    typer.Option(
        help="Points at most so far from the surface, above or below, become class 41, m.",
        show_default="no class 41",
    ),
]
DeadBand = Annotated[
    float,
    typer.Option(
        help="Points at most so far from the surface take the label of their surroundings, m.",
        show_default="none",
    ),
]
Reset = Annotated[
    bool,
    typer.Option("--reset", help="Points that come as class 40 or 41 and are neither become 1."),
]


@takes(LabelWords)
def label(
    words: LabelWords,
    input: Input,
    output: Output,
    water: WaterOption,
    band: Band = 0.0,
    dead_band: DeadBand = 0.0,
    reset: Reset = False,
    summary: SummaryOption = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    jobs: Jobs = None,
) -> None:
    """Give the points below the water surface class 40, and change nothing else."""
    from pcfix.flow.label import label_file

    settings = words.label_settings(band_m=band, dead_band_m=dead_band, reset=reset)
    with progress_bar("Labelling", quiet) as progress:
        result = label_file(
            input,
            output,
            water=water,
            **words.water_keywords(),
            water_mask=words.water_mask,
            settings=settings,
            summary=summary,
            overwrite=overwrite,
            jobs=jobs,
            progress=progress,
        )
    if not quiet:
        typer.echo(labelling_text(result))


def labelling_text(summary: LabelSummary) -> str:
    """Return what a person wants to know of a labelling."""
    from pcfix.report.text import share

    s = summary
    rate = s.points / max(s.seconds, 1e-9)
    lines = [
        f"{s.input} -> {s.output}",
        f"points       {s.points:,} in {s.seconds:.1f} s ({rate:,.0f} points/s)",
        f"class 40     {s.submerged:,} ({share(s.submerged, s.points)} of the points)",
    ]
    if s.settings["band_m"]:
        lines.append(f"class 41     {s.water_surface:,} within {s.settings['band_m']:g} m")
    if s.stale:
        fate = "now class 1" if s.settings["reset"] else "left so; --reset makes them class 1"
        lines.append(f"class before {s.stale:,} came as class 40 or 41 and are neither: {fate}")
    if s.water_unknown:
        lines.append(f"no surface   {s.water_unknown:,} points have no known water above them")
    return "\n".join([*lines, *left_out_lines(s.labelling), f"water        {s.water}"])


def left_out_lines(labelling: dict[str, Any] | None) -> list[str]:
    """Return what was left as land although it lies below the surface."""
    if labelling is None:
        return []
    lines = []
    if labelling["water_mask"] is not None:
        lines.append(f"mask         {labelling['outside_mask']:,} points below lie outside: land")
    if labelling["respected"]:
        lines.append(f"respected    {labelling['respected']:,} points below keep their class")
    apart = labelling["separate"]
    if apart is not None and apart["pools"]:
        most = apart["largest"]
        lines.append(
            f"separate     {apart['points']:,} points in {apart['pools']:,} pools apart from the"
            f" water were left as land; the largest, {most['area_m2']:,.1f} m2 with"
            f" {most['points']:,} points, is at {most['x']:.1f}, {most['y']:.1f}"
        )
    elif apart is not None:
        lines.append("separate     no pools apart from the water")
    return lines

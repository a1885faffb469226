"""``pcfix clean``."""

from __future__ import annotations

from typing import Annotated

import typer

from pcfix.clean.settings import CleanSettings
from pcfix.cli.words import Input, Jobs, Output, Overwrite, Quiet, SummaryOption, progress_bar

_DEFAULT = CleanSettings()

Water = Annotated[
    str | None,
    typer.Option(
        "--water",
        help="A level (0.37), plane:a,b,c, dim:NAME, or a mesh (.obj, .ply): what lies below it"
        " is tested against the bed.",
        show_default="the points that pcfix corrected",
    ),
]
Neighbours = Annotated[int, typer.Option(help="Nearest points of the statistical test.")]
Deviations = Annotated[
    float,
    typer.Option(
        help="Noise if the mean distance to the neighbours exceeds that of all points by so many"
        " standard deviations."
    ),
]
Radius = Annotated[
    float | None,
    typer.Option(
        help="Noise if fewer than --radius-neighbours others are nearer, m.",
        show_default="no such test",
    ),
]
RadiusNeighbours = Annotated[int, typer.Option(help="See --radius.")]
MinRays = Annotated[int, typer.Option(help="Noise if corrected from fewer rays.")]
MaxRayMiss = Annotated[float, typer.Option(help="Noise if the rays miss by more (RayMiss), m.")]
MaxIncidence = Annotated[
    float, typer.Option(help="Noise if a ray had a larger incidence angle, degrees.")
]
BedNeighbours = Annotated[
    int, typer.Option(help="Nearest submerged points in plan that show where the bed is.")
]
Fences = Annotated[
    float,
    typer.Option(
        help="Noise if beyond the middle half of their heights by so many times its range, and"
        " by more than --below or --floating."
    ),
]
Below = Annotated[float, typer.Option(help="Least height under the bed of noise, m.")]
Floating = Annotated[float, typer.Option(help="Least height over the bed of noise, m.")]
NoStatistical = Annotated[bool, typer.Option("--no-statistical", help="Leave out this test.")]
NoWeak = Annotated[bool, typer.Option("--no-weak", help="Leave out rays, ray miss and incidence.")]
NoBelow = Annotated[bool, typer.Option("--no-below", help="Leave out points under the bed.")]
NoFloating = Annotated[bool, typer.Option("--no-floating", help="Leave out points over the bed.")]
Drop = Annotated[
    bool, typer.Option("--drop", help="Leave noise out; else class 7 and the withheld flag.")
]


def clean(
    input: Input,
    output: Output,
    water: Water = None,
    neighbours: Neighbours = _DEFAULT.neighbours,
    deviations: Deviations = _DEFAULT.deviations or 0.0,
    radius: Radius = _DEFAULT.radius_m,
    radius_neighbours: RadiusNeighbours = _DEFAULT.radius_neighbours,
    min_rays: MinRays = _DEFAULT.min_rays or 0,
    max_ray_miss: MaxRayMiss = _DEFAULT.max_ray_miss_m or 0.0,
    max_incidence: MaxIncidence = _DEFAULT.max_incidence_deg or 0.0,
    bed_neighbours: BedNeighbours = _DEFAULT.bed_neighbours,
    fences: Fences = _DEFAULT.fences,
    below: Below = _DEFAULT.below_m or 0.0,
    floating: Floating = _DEFAULT.floating_m or 0.0,
    no_statistical: NoStatistical = False,
    no_weak: NoWeak = False,
    no_below: NoBelow = False,
    no_floating: NoFloating = False,
    drop: Drop = False,
    summary: SummaryOption = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    jobs: Jobs = None,
) -> None:
    """Flag the noise of a cloud: outliers, weak intersections, points off the bed."""
    from pcfix.flow.clean import clean_file
    from pcfix.report.text import cleaning_text

    settings = CleanSettings(
        neighbours=neighbours,
        deviations=None if no_statistical else deviations,
        radius_m=radius,
        radius_neighbours=radius_neighbours,
        min_rays=None if no_weak else min_rays,
        max_ray_miss_m=None if no_weak else max_ray_miss,
        max_incidence_deg=None if no_weak else max_incidence,
        bed_neighbours=bed_neighbours,
        fences=fences,
        below_m=None if no_below else below,
        floating_m=None if no_floating else floating,
    )
    with progress_bar("Cleaning", quiet) as progress:
        result = clean_file(
            input,
            output,
            water=water,
            settings=settings,
            drop=drop,
            summary=summary,
            overwrite=overwrite,
            jobs=jobs,
            progress=progress,
        )
    if not quiet:
        typer.echo(cleaning_text(result))

"""What is said of an orthophoto, and of rounds of photographs without water."""

from __future__ import annotations

from typing import Any

from pcfix.photos.ortho import OrthoSummary
from pcfix.photos.rounds import RebuildSummary


def ortho_text(found: OrthoSummary) -> str:
    """Return a few lines on an orthophoto."""
    water = "none left in them" if found.water is None else f"{found.water}, traced through"
    return "\n".join(
        [
            found.output,
            f"cells        {found.width:,} x {found.height:,} of {found.resolution_m:g} m"
            f" in {found.seconds:.1f} s",
            f"covered      {100 * found.covered_share:.1f} % of the DSM {found.dsm}",
            f"photographs  {found.images}, water {water}",
        ]
    )


def photos_text(found: Any) -> str:
    """Return a line on photographs without water."""
    return f"{found.images} photographs ({found.done_before} before), {found.seconds:.1f} s"


def rounds_text(found: RebuildSummary) -> str:
    """Return a line for each round, why they ended, and the command that compares them."""
    lines = ["round   mean of change   sd        within a ground pixel"]
    for number, one in enumerate(found.rounds, start=1):
        change = f"{one.mean_m:+.3f} m{one.sd_m:12.3f} m"
        lines.append(f"{number:5}{change:>29}{100 * one.within_gsd:13.0f} %")
    last = found.rounds[-1].cloud
    limit = f"{found.threshold_m:.3f} m on average"
    if found.settled:
        lines.append(f"settled      the last round moved the bed by less than {limit}")
    else:
        lines.append(f"not settled  the last round moved the bed by more than {limit}")
    lines.append(f"cloud        {last}")
    if found.compared is None:
        lines.append(f"compare      {found.compare}")
    else:
        lines.append(f"compared     {found.compared}")
    return "\n".join(lines)

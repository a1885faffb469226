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
    """Return why the rounds ended, and where their clouds and the comparison are."""
    many = "less" if found.settled else "more"
    next_step = f"compare      {found.compare}"
    return "\n".join(
        [
            f"{'settled' if found.settled else 'not settled':13}the last round moved the bed by"
            f" {many} than {found.threshold_m:.3f} m on average",
            f"cloud        {found.rounds[-1].cloud}",
            next_step if found.compared is None else f"compared     {found.compared}",
        ]
    )

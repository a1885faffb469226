"""What a command did with photographs, in a few lines."""

from __future__ import annotations

from pcfix.photos.model import PhotosSummary
from pcfix.photos.ortho import OrthoSummary
from pcfix.photos.rounds import RebuildSummary


def photos_text(summary: PhotosSummary) -> str:
    """Return what a person wants to know of photographs without water."""
    s = summary
    new = s.images - s.done_before
    rate = f" ({s.megapixels / s.seconds:.1f} Mpx/s)" if new and s.seconds else ""
    lines = [
        f"photographs  {new:,} written in {s.seconds:.1f} s{rate}"
        + (f", {s.done_before:,} were there from before" if s.done_before else ""),
        f"mapping      {s.mapping}, nodes every {s.spacing_px} px; the largest shift is"
        f" {s.largest_shift_px:.1f} px",
        f"black        {100.0 * s.black_share:.1f} % of the pixels: no ground, hidden, or from"
        " outside the photograph",
        f"ground       {s.dsm}",
        f"water        {s.water}, refractive index {s.refractive_index:g}",
    ]
    return "\n".join(lines)


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

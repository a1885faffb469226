"""What is said of an orthophoto."""

from __future__ import annotations

from pcfix.photos.ortho import OrthoSummary


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

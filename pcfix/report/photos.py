"""What a command did with photographs, in a few lines."""

from __future__ import annotations

from pcfix.photos.model import PhotosSummary


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

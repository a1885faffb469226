"""What the steps over photographs tell of their work."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class PhotosSummary:
    """What `map_photos` did.

    Attributes
    ----------
    images, done_before : int
        Photographs written, and those of them that an earlier call had written.
    megapixels, seconds : float
    largest_shift_px : float
    black_share : float
        Of all pixels: those over no ground, hidden, or from outside the photograph.
    mapping, dsm, water : str
    refractive_index : float
    spacing_px : int
    notes : tuple of str
    """

    images: int
    done_before: int
    megapixels: float
    seconds: float
    largest_shift_px: float
    black_share: float
    mapping: str
    dsm: str
    water: str
    refractive_index: float
    spacing_px: int
    notes: tuple[str, ...]

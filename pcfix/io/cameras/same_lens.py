"""Whether two interior orientations are one: what a writer asks before it claims to hold a lens."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pcfix.model import Lens

TOLERANCE = 1e-12
"""Of every number, relative to the focal length where it is a length."""


def is_same_lens(one: Lens, other: Lens) -> bool:
    """Whether two lenses take every direction to the same place, but for rounding.

    Zeros at the end of a list of coefficients count for nothing, nor does what the lens is called.
    """
    first, second = _plain(one), _plain(other)
    if (first.projection, first.unit) != (second.projection, second.unit):
        return False
    if (first.inverse, first.in_turn) != (second.inverse, second.in_turn):
        return False
    lengths = np.array([_lengths(lens) for lens in (first, second)])
    if np.abs(lengths[0] - lengths[1]).max() > TOLERANCE * first.focal * 10.0:
        return False
    pairs = ((first.shape, second.shape), (first.distortion_centre, second.distortion_centre))
    lists = ((_series(first)[i], _series(second)[i]) for i in range(4))
    return all(_are_close(a, b) for a, b in (*pairs, *lists))


def _plain(lens: Lens) -> Lens:
    """Return the lens without switches that switch nothing."""
    radial, denominator, tangential, prism = _series(lens)
    bent = bool(radial or denominator or tangential or prism)
    return replace(
        lens,
        inverse=lens.inverse and bent,
        in_turn=lens.in_turn and bool(tangential or prism),
        distortion_centre=lens.distortion_centre if bent else (0.0, 0.0),
    )


def _lengths(lens: Lens) -> tuple[float, ...]:
    frame = (lens.focal, lens.width, lens.height, lens.principal_x, lens.principal_y)
    return (*frame, lens.b1, lens.b2, lens.b3)


def _series(lens: Lens) -> tuple[tuple[float, ...], ...]:
    lists = (lens.radial, lens.denominator, lens.tangential, lens.thin_prism)
    return tuple(_without_zeros(each) for each in lists)


def _without_zeros(values: Sequence[float]) -> tuple[float, ...]:
    last = max((i for i, value in enumerate(values) if value != 0.0), default=-1)
    return tuple(values[: last + 1])


def _are_close(one: Sequence[float], other: Sequence[float]) -> bool:
    return len(one) == len(other) and bool(
        np.allclose(np.array(one, float), np.array(other, float), rtol=TOLERANCE, atol=0.0)
    )

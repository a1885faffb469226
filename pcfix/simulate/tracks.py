"""A cloud of tracks: each point from all images that show it at once."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pcfix.simulate.tracing import triangulate

if TYPE_CHECKING:
    from pcfix.model import FloatArray
    from pcfix.simulate.sight import Rig, Sight


def intersect_tracks(
    truth: FloatArray, sight: Sight, rig: Rig, rng: np.random.Generator
) -> FloatArray:
    """Return where straight rays through noisy image points meet, with least residuals, (n, 3).

    A point without pairs stays where it is.
    """
    return straight(truth, sight, rig, rig.observed(sight.ideal, rng))


def straight(truth: FloatArray, sight: Sight, rig: Rig, pixels: FloatArray) -> FloatArray:
    """Return the same for given ideal pixels, shape (m, 2)."""
    made, apparent = sight.made, truth.copy()
    if made.any():
        starts = np.concatenate([sight.start[:-1][made], sight.start[-1:]])
        apparent[made] = triangulate(
            pixels, rig.given, sight.camera, starts, rig.optics.lens, truth[made]
        )
    return apparent

"""The surface of a whole cloud that hides its points from cameras, and whether to look for it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pcfix.model import NOISE_CLASSES
from pcfix.refract.top_surface import TopSurface

if TYPE_CHECKING:
    import numpy.typing as npt

    from pcfix.model import Cameras, FloatArray
    from pcfix.options import Settings
    from pcfix.refract.occlusion import Occluder

"""ASPRS classes of low and high noise, which hide nothing."""
OBLIQUE_DEG = 15.0
"""An image whose axis is farther off the nadir is an oblique. The axes of stabilised nadir blocks
stay within a few degrees; obliques are flown at 20 and more."""


def wants_occlusion(cameras: Cameras, settings: Settings) -> bool:
    """Return whether cameras are to be left out to which the cloud hides the point.

    As the settings say; auto: where the axis of some camera is more than `OBLIQUE_DEG` off the
    nadir. Cameras without angles count as nadir.
    """
    if settings.occlusion != "auto":
        return settings.occlusion == "on"
    if cameras.rotations is None:
        return False
    # the third row of a rotation is the axis in the world frame; straight down it is (0, 0, -1)
    down = -cameras.rotations[:, 2, 2]
    return bool((down < np.cos(np.radians(OBLIQUE_DEG))).any())


class OccluderBuilder:
    """Gathers the chunks of a cloud, of which noise (classes 7 and 18) does not count.

    Parameters
    ----------
    low_xy, high_xy : array, shape (2,)
        South-west and north-east corner of the cloud, metres, as far as they are known.
    points : int
        Of the whole cloud.
    """

    def __init__(self, low_xy: FloatArray, high_xy: FloatArray, points: int) -> None:
        self._surface = TopSurface(low_xy, high_xy, points)

    def add(self, xyz: FloatArray, classes: npt.NDArray[np.uint8] | None = None) -> None:
        """Add a chunk.

        Parameters
        ----------
        xyz : array, shape (n, 3)
            Apparent points, metres, world frame.
        classes : array, shape (n,), optional
        """
        self._surface.add(xyz if classes is None else xyz[~np.isin(classes, NOISE_CLASSES)])

    def build(self) -> Occluder | None:
        """Return the surface; None where there was no point."""
        return self._surface.occluder()


def occluder_of(xyz: FloatArray, classes: npt.NDArray[np.uint8] | None = None) -> Occluder | None:
    """Return the surface of points that are the whole cloud.

    Parameters
    ----------
    xyz, classes
        As of `OccluderBuilder.add`.
    """
    if not len(xyz):
        return None
    builder = OccluderBuilder(xyz[:, :2].min(axis=0), xyz[:, :2].max(axis=0), len(xyz))
    builder.add(xyz, classes)
    return builder.build()

"""The simulated lens: pixels with and without distortion.

*Ideal* pixels are those of a pinhole camera, *image* pixels those of the real lens.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pcfix.lens.imaging import project, unproject
from pcfix.model import BoolArray, FloatArray, Lens


@dataclass(frozen=True, slots=True)
class Optics:
    """A lens, and the tangent of the angle from its axis to the farthest corner of the frame."""

    lens: Lens
    reach: float

    @property
    def is_ideal(self) -> bool:
        """Whether there is no distortion."""
        return not (any(self.lens.radial) or any(self.lens.tangential))

    def to_image(self, ideal: FloatArray) -> FloatArray:
        """Return image pixels of ideal pixels, shape (m, 2); NaN beyond the fold of the lens."""
        if self.is_ideal:
            return ideal
        principal = [self.lens.principal_x, self.lens.principal_y]
        plane = (ideal - principal) / self.lens.focal
        return project(self.lens, np.column_stack([plane, np.ones(len(plane))]))

    def to_ideal(self, image: FloatArray) -> FloatArray:
        """Return ideal pixels of image pixels, shape (m, 2)."""
        if self.is_ideal:
            return image
        rays = unproject(self.lens, image)
        principal = [self.lens.principal_x, self.lens.principal_y]
        return np.asarray(self.lens.focal * rays[:, :2] / rays[:, 2:] + principal)

    def frames(self, image: FloatArray) -> BoolArray:
        """Return which image points lie in the frame."""
        inside = (image >= 0) & (image < [self.lens.width, self.lens.height])
        return np.asarray(inside.all(axis=1))

"""The simulated lens: pixels with and without distortion.

*Ideal* pixels are those of a pinhole camera, *image* pixels those of the real lens.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pcfix.errors import SettingError
from pcfix.lens.imaging import project, unproject
from pcfix.model import BoolArray, FloatArray, Lens

_MARGIN = 1.02  # of the frame, in which a lens must not fold


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


def make_optics(
    focal_mm: float,
    sensor_mm: tuple[float, float],
    sensor_px: tuple[int, int],
    distortion: tuple[float, ...],
) -> Optics:
    """Return the optics of a camera; `distortion` is k1, k2, k3, p1, p2."""
    width, height = sensor_px
    focal = focal_mm / sensor_mm[0] * width
    lens = Lens(focal, width, height, width / 2.0, height / 2.0)
    if not any(distortion):
        return Optics(lens, float(np.hypot(*sensor_mm) / 2.0 / focal_mm))
    lens = replace(lens, radial=distortion[:3], tangential=distortion[3:])
    along = np.linspace(-1.0, 1.0, 41)
    side = np.ones_like(along)
    edges = [(along, side), (along, -side), (side, along), (-side, along)]
    border = np.hstack(edges).T * [width / 2.0, height / 2.0]
    rays, wider = (unproject(lens, border * margin + [width / 2.0, height / 2.0])
                   for margin in (1.0, _MARGIN))  # fmt: skip
    if not np.isfinite(wider).all():
        raise SettingError(
            "scene.distortion",
            f"The distortion {', '.join(f'{v:g}' for v in distortion)} folds the image inside the"
            " frame. Give smaller values.",
            distortion=distortion,
        )
    return Optics(lens, float(np.hypot(*(rays[:, :2] / rays[:, 2:]).T).max()))

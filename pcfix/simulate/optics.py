"""The simulated lens, by numpy alone: Brown's distortion and its inverse.

*Ideal* pixels are those of a pinhole camera, *image* pixels those of the real lens.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pcfix.errors import SettingError
from pcfix.model import FloatArray, Lens

_NEWTON_STEPS = 50
_CONVERGED = 1e-14
_MARGIN = 1.02  # of the radius up to which a lens must not fold


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
        """Return image pixels of ideal pixels, shape (m, 2)."""
        return ideal if self.is_ideal else self._pixels(_brown(self._plane(ideal), self.lens)[0])

    def to_ideal(self, image: FloatArray) -> FloatArray:
        """Return ideal pixels of image pixels, shape (m, 2)."""
        return image if self.is_ideal else self._pixels(_unbrown(self._plane(image), self.lens))

    def frames(self, ideal: FloatArray, image: FloatArray) -> np.ndarray:
        """Return which image points, given as both kinds of pixels, lie in the frame."""
        inside = ((image >= 0) & (image < [self.lens.width, self.lens.height])).all(axis=1)
        if self.is_ideal:
            return np.asarray(inside)
        # beyond the corner the polynomial may come back into the frame
        return np.asarray(inside & (np.hypot(*self._plane(ideal).T) <= _MARGIN * self.reach))

    def _plane(self, pixels: FloatArray) -> FloatArray:
        principal = [self.lens.principal_x, self.lens.principal_y]
        return np.asarray((pixels - principal) / self.lens.focal)

    def _pixels(self, plane: FloatArray) -> FloatArray:
        principal = [self.lens.principal_x, self.lens.principal_y]
        return np.asarray(plane * self.lens.focal + principal)


def make_optics(
    focal_mm: float,
    sensor_mm: tuple[float, float],
    sensor_px: tuple[int, int],
    distortion: tuple[float, ...],
) -> Optics:
    """Return the optics of a camera; `distortion` is k1, k2, k3, p1, p2.

    Raises
    ------
    SettingError
        ``scene.distortion``, if the image folds inside the frame.
    """
    width, height = sensor_px
    focal = focal_mm / sensor_mm[0] * width
    lens = Lens(focal, width, height, width / 2.0, height / 2.0)
    if not any(distortion):
        return Optics(lens, float(np.hypot(*sensor_mm) / 2.0 / focal_mm))
    lens = replace(lens, radial=distortion[:3], tangential=distortion[3:])
    return Optics(lens, _reach_of(lens))


def _reach_of(lens: Lens) -> float:
    """Return the largest distance from the axis, in the plane at unit distance, of the border."""
    along = np.linspace(-1.0, 1.0, 41)
    side = np.ones_like(along)
    edges = [(along, side), (along, -side), (side, along), (-side, along)]
    border = np.vstack([np.column_stack(edge) for edge in edges])
    border = border * [lens.width, lens.height] / (2.0 * lens.focal)
    ideal = _unbrown(border, lens)
    reach = float(np.hypot(*ideal.T).max())
    known = np.isfinite(reach) and reach < 10.0 * float(np.hypot(*border.T).max())
    if known:
        share = np.linspace(0.0, _MARGIN, 60)[:, None, None]
        _, (xx, xy, yy) = _brown((share * ideal).reshape(-1, 2), lens)
        there = np.abs(_brown(ideal, lens)[0] - border).max() < 1e-9
        known = bool(there and (xx > 0.0).all() and (xx * yy - xy * xy > 0.0).all())
    if not known:
        terms = (*lens.radial, *lens.tangential)
        raise SettingError(
            "scene.distortion",
            f"The distortion {', '.join(f'{v:g}' for v in terms)} folds the image inside the frame."
            " Give smaller values.",
            distortion=terms,
        )
    return reach


def _brown(xy: FloatArray, lens: Lens) -> tuple[FloatArray, tuple[FloatArray, ...]]:
    """Return Brown's formula at places, shape (m, 2), and d x'/dx, d x'/dy = d y'/dx, d y'/dy."""
    (k1, k2, k3), (p1, p2) = lens.radial, lens.tangential
    x, y = xy.T
    r2 = x * x + y * y
    g = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3)
    to_x = x * g + p1 * (r2 + 2.0 * x * x) + 2.0 * p2 * x * y
    to_y = y * g + p2 * (r2 + 2.0 * y * y) + 2.0 * p1 * x * y
    xx = g + 2.0 * x * x * slope + 6.0 * p1 * x + 2.0 * p2 * y
    across = 2.0 * x * y * slope + 2.0 * p1 * y + 2.0 * p2 * x
    yy = g + 2.0 * y * y * slope + 6.0 * p2 * y + 2.0 * p1 * x
    return np.column_stack([to_x, to_y]), (xx, across, yy)


def _unbrown(image: FloatArray, lens: Lens) -> FloatArray:
    """Return the inverse of Brown's formula by Newton's method, beginning at the image itself."""
    xy = image.copy()
    with np.errstate(all="ignore"):  # a lens that folds is found out by the caller
        for _ in range(_NEWTON_STEPS):
            there, (xx, across, yy) = _brown(xy, lens)
            (u, v), area = (image - there).T, xx * yy - across * across
            step = np.column_stack([yy * u - across * v, xx * v - across * u]) / area[:, None]
            xy = xy + step
            if not np.abs(step).max(initial=0.0) > _CONVERGED:
                break
    return xy

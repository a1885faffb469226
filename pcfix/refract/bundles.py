"""The rays of many points at once: what the methods that take chosen cameras are given."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pcfix.model import Outcome
from pcfix.refract.result import Intersection

if TYPE_CHECKING:
    import numpy.typing as npt

    from pcfix.model import BoolArray, Cameras, FloatArray, IntArray, Views, WaterSurface
    from pcfix.options import Settings
    from pcfix.refract.learned import Learned
    from pcfix.refract.made_with import MadeWith
    from pcfix.water.surface import SurfaceAbove


class Bundle(NamedTuple):
    """Submerged points, their water and their cameras.

    Attributes
    ----------
    xyz : array, shape (m, 3)
        Apparent points, metres, world frame.
    surface : SurfaceAbove
        The water above each of them.
    water : WaterSurface
    cameras : Cameras
    views : Views
        The cameras that give each point a ray.
    settings : Settings
    level_offset_m : array, shape (k,)
        How much higher the water stood for each camera.
    learned : Learned
    made_with : MadeWith or None
        Where a dense matcher had other cameras than these, and the points elsewhere.
    """

    xyz: FloatArray
    surface: SurfaceAbove
    water: WaterSurface
    cameras: Cameras
    views: Views
    settings: Settings
    level_offset_m: FloatArray
    learned: Learned
    made_with: MadeWith | None = None

    @property
    def counts(self) -> IntArray:
        """Rays of each point, shape (m,)."""
        return np.diff(self.views.start)

    @property
    def owner(self) -> IntArray:
        """The point of each ray, shape (rays,)."""
        return np.repeat(np.arange(len(self.xyz)), self.counts)

    def normals(self) -> FloatArray:
        """Return the unit normal of the surface above each point, upward, shape (m, 3)."""
        slope = self.surface.slope
        up = 1.0 / np.sqrt(1.0 + (slope**2).sum(axis=1))
        return np.column_stack([-slope * up[:, None], up])

    def outcome(self) -> npt.NDArray[np.uint8]:
        """Return what becomes of points with so many rays, shape (m,)."""
        counts = self.counts
        few = np.where(counts == 1, Outcome.ONE_CAMERA, Outcome.NO_CAMERA)
        return np.where(counts >= 2, Outcome.CORRECTED, few).astype(np.uint8)

    def incidence_deg(self) -> FloatArray:
        """Return the largest incidence angle in air of each point's rays, shape (m,)."""
        owner = self.owner
        to_camera = self.cameras.centres[self.views.camera] - self.xyz[owner]
        across = np.einsum("ij,ij->i", self.normals()[owner], to_camera)
        cosine = across / np.linalg.norm(to_camera, axis=1)
        least = np.ones(len(self.xyz))
        np.minimum.at(least, owner, cosine)
        return np.degrees(np.arccos(np.clip(least, 0.0, 1.0)))

    def camera_used(self, moved: BoolArray) -> BoolArray:
        """Return which cameras give a ray to a point that is moved, shape (k,)."""
        used = np.zeros(len(self.cameras), np.bool_)
        used[self.views.camera[moved[self.owner]]] = True
        return used

    def result(
        self,
        shift_m: FloatArray,
        *,
        outcome: npt.NDArray[np.uint8] | None = None,
        ray_miss_m: FloatArray | None = None,
    ) -> Intersection:
        """Return the result of a method that gives shifts, shape (m, 3).

        Points that are not moved get a shift of zero, and zeros beside it.
        """
        outcome = self.outcome() if outcome is None else outcome
        moved = outcome == Outcome.CORRECTED
        zero = np.zeros(len(self.xyz))
        return Intersection(
            shift_m=np.where(moved[:, None], shift_m, 0.0),
            outcome=outcome,
            ray_count=np.where(moved, self.counts, 0).astype(np.int32),
            ray_miss_m=zero if ray_miss_m is None else np.where(moved, ray_miss_m, 0.0),
            sigma_z_m=zero,
            incidence_deg=np.where(moved, self.incidence_deg(), 0.0),
            camera_used=self.camera_used(moved),
            pairs_tested=len(self.views.camera),
        )

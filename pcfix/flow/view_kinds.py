"""What a view list lists, where its file does not say: told by how smooth the bed comes out.

The file of COLMAP's dense fusion also serves for tracks. Neighbouring points have different lists;
corrected by the wrong model they are shifted differently, and scatter. The right one leaves the
smoother bed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pcfix.model import Outcome, Views
from pcfix.refract.methods import correct

if TYPE_CHECKING:
    from typing import Literal

    from pcfix.model import Cameras, FloatArray, IntArray, WaterSurface
    from pcfix.options import Settings
    from pcfix.refract.learned import Learned
    from pcfix.refract.made_with import MadeWith
    from pcfix.water.surface import SurfaceAbove

PATCHES, PATCH_POINTS = 300, 12
CLEARLY = 0.95
"""A list stands for depth maps unless tracks leave a bed with less than this share of scatter."""


class KindFound(NamedTuple):
    """Which kind of list it is, and the scatter (m) of the bed about planes under either."""

    kind: Literal["tracks", "depth-maps"]
    tracks_m: float
    depth_maps_m: float

    def __str__(self) -> str:
        names = {"tracks": "rays that were intersected", "depth-maps": "depth maps that were fused"}
        return (
            f"The view list is taken as one of {names[self.kind]}: neighbouring points then scatter"
            f" by {100.0 * min(self.tracks_m, self.depth_maps_m):.1f} cm,"
            f" else by {100.0 * max(self.tracks_m, self.depth_maps_m):.1f} cm; --views-are says"
            " it yourself."
        )


def kind_of_views(
    xyz: FloatArray,
    surface: SurfaceAbove,
    water: WaterSurface,
    cameras: Cameras,
    settings: Settings,
    views: Views,
    learned: Learned,
    made_with: MadeWith | None = None,
) -> KindFound | None:
    """Return which kind of list gives the smoother bed; None where there are too few points.

    Parameters
    ----------
    xyz, surface, water, cameras, settings, views, learned, made_with
        As of `pcfix.refract.methods.correct`; submerged points.
    """
    listed = np.flatnonzero(np.diff(views.start) >= 2)
    if len(listed) < PATCHES:
        return None
    patch = _patches(xyz[listed])
    rows, place = np.unique(listed[patch], return_inverse=True)
    place = place.reshape(patch.shape)
    above = type(surface)(surface.height_m[rows], surface.slope[rows])
    some = views.take(rows)
    made = None if made_with is None else made_with.take(rows)
    scatter = []
    for kind in ("tracks", "depth-maps"):
        as_kind = Views(some.start, some.camera, some.weight, kind)
        found = correct(
            xyz[rows], above, water, cameras, settings, as_kind, None, learned, made_with=made
        )
        true = np.where(
            (found.outcome == Outcome.CORRECTED)[:, None], xyz[rows] + found.shift_m, np.nan
        )
        scatter.append(_scatter_m(true[place]))
    tracks, maps = scatter
    return KindFound("tracks" if tracks < CLEARLY * maps else "depth-maps", tracks, maps)


def _patches(xyz: FloatArray) -> IntArray:
    """Return the rows of neighbours around places spread evenly over the order of the points."""
    from scipy.spatial import cKDTree

    seeds = np.linspace(0, len(xyz) - 1, PATCHES).astype(int)
    tree = cKDTree(xyz[:, :2], balanced_tree=False, compact_nodes=False)
    return np.asarray(tree.query(xyz[seeds, :2], k=PATCH_POINTS)[1])


def _scatter_m(patch: FloatArray) -> float:
    """Return the median over patches, (p, k, 3), of the standard deviation about a plane."""
    patch = patch[np.isfinite(patch).all(axis=(1, 2))]
    if not len(patch):
        return float("inf")
    middle = patch - patch.mean(axis=1, keepdims=True)
    across, up = middle[..., :2], middle[..., 2]
    normal = np.einsum("pki,pkj->pij", across, across) + 1e-9 * np.eye(2)
    slope = np.linalg.solve(normal, np.einsum("pki,pk->pi", across, up)[..., None])[..., 0]
    rest = up - np.einsum("pki,pi->pk", across, slope)
    return float(np.median(np.sqrt((rest**2).sum(axis=1) / (rest.shape[1] - 3))))

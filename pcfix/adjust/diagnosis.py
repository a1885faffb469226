r"""Diagnosis of refraction that an ordinary adjustment absorbed in its lens and poses.

Software that ignores the water deforms lens and block until straight rays fit the images of the
bed. The land is then at a wrong height, and correcting only the cloud makes it worse. The signs, in
the order of their weight:

tie points : intersected with refraction, points under water fit their images worse than with
    straight rays. With true poses they fit better.
GNSS : projection centres differ from their GNSS positions in the pattern in which this water would
    have deformed this block (`pcfix.adjust.from_cloud`).
bed : depths of the cloud are nearly true before any correction; refraction leaves 1/n of them or
    less.
land : its heights are wrong, at control points or against a survey. There can be other reasons, and
    they are right if ground control fixed them.
neighbours : neighbouring points of a dense cloud that come from different images fit each other
    with straight rays, and not with refracted ones.

The first sign that is significant decides.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.adjust.block import plain_block, some_ties, true_start, used_as_dry
from pcfix.adjust.parameters import similarity_gradients
from pcfix.errors import GeometryError
from pcfix.model import (
    Cameras,
    FloatArray,
    GnssPositions,
    GroundControl,
    TiePoints,
    WaterDimension,
    WaterSurface,
)
from pcfix.water.fit import heights_from_cloud
from pcfix.water.surface import is_submerged, surface_above

if TYPE_CHECKING:  # not quick to load
    from pcfix.adjust.from_cloud import Undone

LEAST_POINTS, LEAST_PLACES = 30, 3  # tie points under water, and places of a survey, at least
PARTS = 5  # of the area, along x and along y, for the jackknife
OUTLIERS = 0.05  # share of the tie points that is excluded, those with the worst residuals
# Share of the refraction absorbed from which poses count as wrong, the largest plausible one, and
# the largest useful standard error. On simulated blocks with 0.5 px and 3 cm it is within 0.1 of 0
# with true poses, and 0.54 to 1.1 after an ordinary adjustment, smaller with more weight of the
# GNSS; see tests/adjust/test_diagnosis.py.
SHARE, MOST_SHARE, MOST_SIGMA = 0.4, 2.0, 0.15
SIGMAS = 3.0  # standard errors that are not chance
LAND_GSD = 2.0  # error of land against a survey that dense matching and smoothing leave
LEAST_DEPTH_M, LAND_M = 1.0, 0.3  # depth of bed and height of land that are compared with a survey
MOST_STATED_M = 0.5  # a larger standard deviation of GNSS is a default, as Metashape's 10 m

TIE_POINTS, LEAST_TIE_VIEWS = 3000, 3
CLOUD_POINTS, POINTS_PER_IMAGE, SURVEYED_POINTS = 1500, 10, 50_000
LEAST_COORDINATES = 24  # of GNSS positions
# For which the pattern of absorbed refraction is computed, and when it must be quick; the cost
# grows with their cube, and is a second for the latter.
MOST_IMAGES, QUICK_IMAGES = 600, 200

# What to do if a camera file has neither tie points nor GNSS positions.
EXPORT = "export tie points, or run 'pcfix cameras FILE --gnss GNSS.csv'"


@dataclass(frozen=True)
class Sign:
    """One statistic."""

    name: str
    absorbed: bool | None  # whether it says that refraction was absorbed; None if not significant
    words: str  # what was found
    share: float | None = None  # what is compared with a limit, and its standard error
    sigma_share: float | None = None
    error_m: float | None = None  # likely error of the heights, if it was absorbed


@dataclass(frozen=True)
class Diagnosis:
    """All signs that could be evaluated, in the order in which they decide."""

    signs: tuple[Sign, ...]

    @property
    def decided_by(self) -> Sign | None:
        """The first sign with evidence."""
        return next((sign for sign in self.signs if sign.absorbed is not None), None)

    @property
    def absorbed(self) -> bool | None:
        """Whether the poses have absorbed the refraction; None if unknown."""
        return None if self.decided_by is None else self.decided_by.absorbed

    @property
    def likely_error_m(self) -> float | None:
        """The error that land shows, else that of the sign that decides; None if none is likely."""
        if self.decided_by is None or not self.absorbed:
            return None
        land = [sign for sign in self.signs if sign.name == "heights of land" and sign.absorbed]
        return (land or [self.decided_by])[-1].error_m

    def sentence(self, command: str) -> str:
        """Return a warning with the command that helps; empty if the poses seem right."""
        if not self.absorbed or self.decided_by is None:
            return ""
        likely = self.likely_error_m
        error = "" if likely is None else f" The heights are probably off by {likely:.2g} m."
        have = "seem to have" if self.decided_by.name == "neighbouring points" else "have"
        return (
            f"The poses {have} absorbed the refraction: {self.decided_by.words}.{error} Correcting"
            f" only the cloud makes them worse. Adjust the poses first: {command}"
        )

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return {
            "absorbed": self.absorbed,
            "likely_error_m": self.likely_error_m,
            "signs": [{**vars(sign)} for sign in self.signs],
        }


def _exceeds(value: float, sigma: float, limit: float) -> bool | None:
    """Return whether a value exceeds its limit; None if that is not significant."""
    return value > limit if abs(value - limit) > SIGMAS * sigma else None


def _absorbed_words(share: float, sigma: float) -> str:
    return (
        f"{100.0 * share:.0f} % of the refraction is absorbed (standard error"
        f" {100.0 * sigma:.0f} %, limit {100.0 * SHARE:.0f} %)"
    )


def tie_point_sign(
    cameras: Cameras, water: WaterSurface, n: float, ties: TiePoints
) -> tuple[Sign | None, FloatArray | None]:
    """Compare residuals of the same tie points with straight and refracted rays.

    With the residuals s without and r with refraction, d = s - r is what straight rays cannot fit.
    With true poses r is noise, which is independent of d; with poses that absorbed the refraction s
    is noise. So b = -(r . d) / (d . d) is 0 or 1, whatever the noise. Its standard error is that of
    a jackknife over parts of the area, as errors of a pose are common to neighbours.

    Also returns the intersections of the straight rays, shape (m, 3); None if there are too few.
    """
    is_known = np.isfinite(ties.xyz).all(axis=1)
    rows = np.flatnonzero((np.diff(ties.views.start) >= LEAST_TIE_VIEWS) & is_known)
    if len(rows) < LEAST_POINTS:
        return None, None
    from pcfix.adjust.problem import intersect_fixed  # not quick to load

    some = some_ties(ties, rows[:: max(1, len(rows) // TIE_POINTS)])
    block = plain_block(cameras, some, None, n)
    xyz, straight_px = intersect_fixed(block)
    above = surface_above(water, xyz)
    wet = is_submerged(xyz[:, 2], above)
    begin = true_start(xyz, water, n, wet)
    _, refracted_px = intersect_fixed(replace(block, xyz=begin, wet=wet, water=water))

    def sums(values: FloatArray) -> FloatArray:
        """Return the sums over the observations of each point."""
        return np.asarray(np.bincount(block.owner, values.sum(axis=1), len(xyz)), np.float64)

    # points under water without outliers; three coordinates of each are estimated
    straight, refracted = sums(straight_px**2), sums(refracted_px**2)
    redundancy = 2 * np.diff(block.start) - 3
    worst = np.maximum(straight, refracted) / redundancy
    good = np.isfinite(worst) & np.isfinite(above.height_m)
    if good.any():
        good &= worst <= np.quantile(worst[good], 1.0 - OUTLIERS)
    apparent = xyz[np.isfinite(straight)]
    wet &= good
    if wet.sum() < LEAST_POINTS:
        return None, apparent
    d = straight_px - refracted_px
    over, under = sums(-refracted_px * d)[wet], sums(d * d)[wet]
    # as many points in each part of the area along x and along y; each is left out in turn
    ranks = np.argsort(np.argsort(xyz[wet, :2], axis=0, kind="stable"), axis=0)
    x, y = (ranks * PARTS // len(ranks)).T
    part = np.unique(x * PARTS + y, return_inverse=True)[1].ravel()
    a, b, g = np.bincount(part, over), np.bincount(part, under), int(part.max()) + 1
    without = (a.sum() - a) / np.maximum(b.sum() - b, 1e-300)
    share = float(a.sum() / max(b.sum(), 1e-300))
    sigma = float(np.sqrt((g - 1) / g * ((without - without.mean()) ** 2).sum()))
    # standard deviations of an image coordinate
    free = redundancy[wet].sum()
    s_px, r_px = (float(np.sqrt(one[wet].sum() / free)) for one in (straight, refracted))
    words = (
        f"tie points under water have residuals of {s_px:.2f} px with straight rays and"
        f" {r_px:.2f} px with refraction, so {_absorbed_words(share, sigma)}"
    )
    absorbed = None if sigma > MOST_SIGMA else _exceeds(share, sigma, SHARE)
    return Sign("tie points", absorbed, words, share, sigma), apparent


def gnss_sign(cameras: Cameras, gnss: GnssPositions, undone: "Undone") -> Sign:
    """Look for the pattern of absorbed refraction in adjusted minus GNSS positions.

    The pattern is the centres minus those that an adjustment with water finds without the GNSS
    (`pcfix.adjust.from_cloud.undo_absorption`).

    off = b pattern + shift, turn and scale of the block + noise, by least squares. The noise is
    that of the residuals, or that stated of the GNSS if it is larger.
    """
    centres, xyz = cameras.centres[undone.row], gnss.xyz[undone.row]
    rows = np.isfinite(xyz)
    y, base = (centres - xyz)[rows], similarity_gradients(centres - centres.mean(axis=0))[rows]

    def rest(values: FloatArray, columns: FloatArray) -> FloatArray:
        """Return the residuals of a least squares fit."""
        return np.asarray(values - columns @ np.linalg.lstsq(columns, values, rcond=None)[0])

    clear = rest(undone.pattern_m[rows], base)
    share = float(clear @ y) / max(float(clear @ clear), 1e-300)
    left = rest(y, np.column_stack([base, clear]))
    noise = float(np.linalg.norm(left) / np.sqrt(max(len(y) - 8, 1)))
    stated = gnss.sigma_m[undone.row][rows]
    if np.isfinite(stated).any() and np.nanmedian(stated) < MOST_STATED_M:
        noise = max(noise, float(np.nanmedian(stated)))
    sigma = noise / max(float(np.linalg.norm(clear)), 1e-150)
    words = (
        f"projection centres differ from the GNSS by {np.sqrt(np.mean(y * y)):.3f} m RMS, and by"
        f" their pattern {_absorbed_words(share, sigma)}"
    )
    is_useful = share <= MOST_SHARE and sigma <= MOST_SIGMA
    absorbed = _exceeds(share, sigma, SHARE) if is_useful else None
    return Sign("GNSS positions", absorbed, words, share, sigma, undone.error_m)


# Surveys, and the cloud itself


def land_sign(higher_m: FloatArray, gsd_m: float) -> Sign | None:
    """Compare land of the cloud with a survey: cloud minus survey in metres, shape (m,)."""
    found = higher_m[np.isfinite(higher_m)]
    if len(found) < LEAST_PLACES:
        return None
    bias, spread, sigma = _median_of(found)
    limit = max(SIGMAS * sigma, LAND_GSD * gsd_m)
    side = "high" if bias > 0.0 else "low"
    words = (
        f"land of the cloud is {abs(bias):.3f} m too {side} ({len(found):,} places, spread"
        f" {spread:.3f} m, limit {limit:.3f} m)"
    )
    absorbed = True if abs(bias) > limit else None
    return Sign("heights of land", absorbed, words, error_m=abs(bias))


def _median_of(values: FloatArray) -> tuple[float, float, float]:
    """Return the median, the robust standard deviation, and the median's standard error."""
    middle = float(np.median(values))
    spread = 1.4826 * float(np.median(np.abs(values - middle)))
    # 1.2533 times the standard error of a mean
    return middle, spread, 1.2533 * spread / float(np.sqrt(len(values)))


def bed_sign(apparent_m: FloatArray, true_m: FloatArray, refractive_index: float) -> Sign | None:
    """Compare depths of the cloud with measured ones, both below the water, shape (m,), metres."""
    deep = np.isfinite(apparent_m) & (true_m > LEAST_DEPTH_M) & (apparent_m > 0.0)
    if deep.sum() < LEAST_PLACES:
        return None
    share, _, sigma = _median_of(apparent_m[deep] / true_m[deep])
    limit = (1.0 + 1.0 / refractive_index) / 2.0  # between straight and refracted rays
    after = true_m[deep] - refractive_index * apparent_m[deep]
    words = (
        f"the bed of the cloud has {share:.2f} of its measured depth before any correction,"
        f" standard error {sigma:.2f} (limit {limit:.2f})"
    )
    error_m = float(np.sqrt(np.mean(after**2)))
    return Sign("measured depths", _exceeds(share, sigma, limit), words, share, sigma, error_m)


def neighbours_sign(share: float, sigma: float, *, is_fused: bool) -> Sign:
    """Look at the discontinuities between image footprints that the corrected bed still has.

    Their share is `Verdict.straight` of `pcfix.refract`. On four rendered blocks it is 0.02 to 0.25
    with true poses, and 0.76 to 0.96 with those of an ordinary adjustment. Clouds that are not of
    fused depth maps can have discontinuities all the same.
    """
    words = (
        f"{100.0 * share:.0f} % of the discontinuities between image footprints are left in the"
        f" corrected bed (standard error {100.0 * sigma:.0f} %, limit 50 %; filtering and meshing"
        " also leave some)"
    )
    absorbed = _exceeds(share, sigma, 0.5) if is_fused or share < 0.5 else None
    return Sign("neighbouring points", absorbed, words, share, sigma)


# All signs


def diagnosed(
    cameras: Cameras,
    water: WaterSurface,
    n: float,
    view: Any,
    *,
    ties: TiePoints | None = None,
    gnss: GnssPositions | None = None,
    control: GroundControl | None = None,
    reference: Any = None,
    neighbours: Sign | None = None,
    in_passing: bool = False,
) -> Diagnosis:
    """Look for every sign that the evidence allows.

    Cameras and GNSS positions (NaN if unknown) are in the cloud's CRS; n is the refractive index.
    The view (`pcfix.flow.surfaces.CloudView`) gives heights of the cloud, and points in place of
    tie points; the reference (`pcfix.compare.match.Reference`) is a survey of land and bed. If it
    must be quick (`in_passing`), GNSS positions are used only if nothing else decides.
    """
    signs = list[Sign | None]()
    if not isinstance(water, WaterDimension):  # which has heights at points of the cloud only
        lenses = cameras.lenses
        if cameras.rotations is not None and lenses and all(one.unit == "px" for one in lenses):
            signs += _signs_of_rays(cameras, water, n, ties, gnss, view, in_passing=in_passing)
        signs += _signs_of_surveys(cameras, water, n, view, control, reference)
    return Diagnosis(tuple(sign for sign in [*signs, neighbours] if sign is not None))


def _signs_of_rays(
    cameras: Cameras, water: WaterSurface, n: float, ties: TiePoints | None,
    gnss: GnssPositions | None, view: Any, *, in_passing: bool,
) -> list[Sign]:  # fmt: skip
    """Look at tie points and at the GNSS, and predict the error if they say that it is there."""
    sign, apparent = (None, None) if ties is None else tie_point_sign(cameras, water, n, ties)
    signs, absorbed = ([], None) if sign is None else ([sign], sign.absorbed)
    is_known = gnss is not None and np.isfinite(gnss.xyz).sum() >= LEAST_COORDINATES
    if not absorbed and (not is_known or (in_passing and absorbed is False)):
        return signs
    if len(cameras) > (QUICK_IMAGES if in_passing else MOST_IMAGES):
        return signs
    # the pattern of absorbed refraction, by tie points or points spread over the cloud
    from pcfix.adjust.from_cloud import undo_absorption  # not quick to load

    wanted = max(CLOUD_POINTS, POINTS_PER_IMAGE * len(cameras))
    if apparent is None:
        every = max(1, view.points // wanted)
        apparent = np.vstack([one.xyz[::every] for one in view.chunks()])
    try:
        some = apparent[:: max(1, len(apparent) // wanted)]
        undone = undo_absorption(some, cameras, water, n)
    except GeometryError:
        return signs
    signs = [replace(one, error_m=undone.error_m) for one in signs]
    return [*signs, gnss_sign(cameras, gnss, undone)] if gnss is not None and is_known else signs


def _signs_of_surveys(
    cameras: Cameras, water: WaterSurface, n: float, view: Any, control: GroundControl | None,
    reference: Any,
) -> list[Sign | None]:  # fmt: skip
    """Compare the cloud with control points on land, and with a survey of land and bed."""
    # about the size of a pixel at the water
    level = surface_above(water, cameras.centres).height_m
    above = cameras.centres[:, 2] - np.where(np.isfinite(level), level, np.nanmean(level))
    focal = [one.focal if one.unit == "px" else np.inf for one in cameras.lenses or ()]
    gsd = float(np.mean(above / focal)) if focal else 0.0
    bed, land = None, list[Sign | None]()
    radius = float(np.clip(10.0 * gsd, 0.2, 2.0))

    def cloud_z(xyz: FloatArray) -> FloatArray:
        """Return the heights of the cloud at places, NaN where it has none."""
        xy = np.ascontiguousarray(xyz[:, :2])
        return heights_from_cloud(xy, (seen.xyz for seen in view.chunks()), radius)

    if control is not None:
        # points on surfaces may have no coordinates
        known = np.isfinite(control.xyz).all(axis=1)
        level = surface_above(water, control.xyz).height_m
        dry = control.xyz[known & ~control.under_water & ~(control.xyz[:, 2] < level)]
        land.append(land_sign(cloud_z(dry) - dry[:, 2], gsd))
        if deep := used_as_dry(control, water):
            words = f"control points {', '.join(deep)} are below the water: mark them under_water"
            land.append(Sign("heights of land", None, words))
    if reference is not None:
        surveyed = reference.xyz[:: 1 + len(reference.xyz) // SURVEYED_POINTS]
        level, found = surface_above(water, surveyed).height_m, cloud_z(surveyed)
        is_land, is_bed = surveyed[:, 2] > level + LAND_M, surveyed[:, 2] < level
        land.append(land_sign((found - surveyed[:, 2])[is_land], gsd))
        bed = bed_sign((level - found)[is_bed], (level - surveyed[:, 2])[is_bed], n)
    return [bed, *land]

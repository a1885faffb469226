r"""Diagnosis of refraction that an adjustment without water absorbed in its lens and poses.

Software that does not know of the water fits the images of a bed all the same: it bends lens and
block until straight rays intersect. The land is then at a wrong height, and correcting the cloud
alone makes it worse. Seven signs show it, in order of how much they tell:

tie points : intersected with refraction, points under water fit their images worse than with
    straight rays. With true poses it is the other way round.
GNSS : projection centres differ from it in the pattern in which this water would have bent this
    block (`pcfix.adjust.from_cloud`).
bed : depths of the cloud are nearly true before any correction; refraction leaves 1/n of them or
    less.
land, control points, focal length : they are wrong. They can be so for other reasons, and they are
    right if ground control held them.
neighbours : neighbouring points of a dense cloud that come from different images fit each other
    with straight rays, and not with refracted ones.

The first sign that says something decides.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.adjust.block import deeper, plain_block, similarity_gradients, taken
from pcfix.errors import GeometryError
from pcfix.lens.imaging import straight_images
from pcfix.model import (
    BoolArray,
    Cameras,
    FloatArray,
    GnssPositions,
    GroundControl,
    IntArray,
    TiePoints,
    WaterDimension,
    WaterSurface,
)
from pcfix.water.fit import heights_from_cloud, is_near
from pcfix.water.surface import is_submerged, surface_above

if TYPE_CHECKING:  # not quick to load
    from pcfix.adjust.from_cloud import Mended
    from pcfix.adjust.problem import Intersected

LEAST_POINTS = 30
"""Tie points under water that are needed."""
PARTS = 5
"""Of the area, along x and along y, for the jackknife."""
LEAST_BEND = 1e-3
"""Refraction that straight rays cannot fit, as a share of the squared residuals."""
OUTLIERS = 0.05
"""Share of the tie points that is excluded, those with the worst residuals."""
SHARE, MOST_SHARE, MOST_SIGMA = 0.4, 2.0, 0.15
"""Share of the refraction absorbed from which poses count as bent, the largest plausible one, and
the largest useful standard error. On simulated blocks with 0.5 px and 3 cm it is within 0.1 of 0
with true poses, and 0.54 to 1.1 after an ordinary adjustment, smaller with more weight of the GNSS;
see tests/adjust/test_diagnosis.py."""
SIGMAS = 3.0
"""Standard errors that are not chance."""
LAND_GSD = 2.0
"""Error of land against a survey that dense matching and smoothing leave."""
CONTROL_PX = 2.0
"""RMS residual of control points in the images."""
FOCAL_SHARE = 1.5e-3
"""Of a calibrated focal length: factory calibrations of a five-lens camera over land differ from
the adjusted ones by up to 0.7e-3, and consumer cameras as much with temperature."""
LEAST_DEPTH_M = 1.0
MOST_STATED_M = 0.5
"""A larger standard deviation of the GNSS is a default of the software, as Metashape's 10 m."""

TIE_POINTS, LEAST_TIE_VIEWS = 3000, 3
CLOUD_POINTS, POINTS_PER_IMAGE, SAMPLE_POINTS = 1500, 10, 50_000
LEAST_COORDINATES = 24
"""Of GNSS positions."""
MOST_IMAGES, QUICK_IMAGES = 600, 200
"""For which the pattern of absorbed refraction is computed, and when it must be quick; the cost
grows with their cube."""
LAND_M = 0.3
"""Height above the water of land."""
NEAREST = 3
"""Points of a reference that give its height at a point of the cloud."""

SENTENCES = {
    "tie points": (
        "tie points under water have residuals of {wet_straight_px:.2f} px with straight rays and"
        " {wet_refracted_px:.2f} px with refraction; share of refraction absorbed {share:.2f},"
        f" standard error {{sigma_share:.2f}} (limit {SHARE:g})"
    ),
    "GNSS": (
        "projection centres differ from the GNSS by {rms_m:.3f} m RMS; share of refraction absorbed"
        f" by their pattern {{share:.2f}}, standard error {{sigma_share:.2f}} (limit {SHARE:g})"
    ),
    "bed": (
        "the bed of the cloud has {share:.2f} of its measured depth before any correction, standard"
        " error {sigma_share:.2f} (limit {limit:.2f})"
    ),
    "land": (
        "land of the cloud is {bias_m:+.3f} m too high ({places:,.0f} places, spread {spread_m:.3f}"
        " m, limit {limit_m:.3f} m)"
    ),
    "control points": (
        "control points on land have residuals of {rms_px:.2f} px in the images (limit"
        " {limit_px:.2f} px)"
    ),
    "neighbours": (
        "discontinuities between image footprints: a share of {share:.2f} is left in the corrected"
        " bed, standard error {sigma_share:.2f} (limit 0.50; filtering and meshing also leave some)"
    ),
    "focal length": (
        "the focal length differs by {difference:+.3%} from the calibrated one, {error_m:.2f} m at"
        f" the ground (limit {FOCAL_SHARE:.2%})"
    ),
}
"""What each sign found, in the order in which they decide."""
SIZES = ("land", "GNSS", "tie points", "control points", "bed", "focal length")
"""Signs by how well they know the likely error: measured on land before predicted."""

EXPORTS = {
    "metashape": "give the project (.psx) or its BlocksExchange export with tie points",
    "photoscan": "give the project (.psz) or its BlocksExchange export with tie points",
    "pix4d": "give the params folder with its tp_ file",
    "opendronemap": "give the project's opensfm folder with tracks.csv",
    "opensfm": "keep tracks.csv beside the reconstruction",
    "colmap": "keep points3D beside the images",
    "blocksexchange": "export it with tie points",
    "bundler": "export the .out file with its points",
}
"""How to give tie points, by a word in the source of the cameras."""


@dataclass(frozen=True)
class Sign:
    """One statistic."""

    name: str  # a key of `SENTENCES`
    figures: dict[str, float]
    speaks: bool | None  # whether it says that refraction was absorbed; None if it says nothing
    size_m: float | None = None  # likely error
    basis: str = ""  # which error that is
    why: str = ""  # why it says nothing, if its figures are unknown

    @property
    def words(self) -> str:
        """What was found."""
        return self.why or SENTENCES[self.name].format(**self.figures)


@dataclass(frozen=True)
class Diagnosis:
    """All signs that could be evaluated, in the order in which they decide."""

    signs: tuple[Sign, ...]

    @property
    def decided_by(self) -> Sign | None:
        """The first sign that says something."""
        return next((sign for sign in self.signs if sign.speaks is not None), None)

    @property
    def absorbed(self) -> bool | None:
        """Whether the poses have absorbed the refraction; None if unknown."""
        return None if self.decided_by is None else self.decided_by.speaks

    @property
    def size(self) -> tuple[float, str] | None:
        """The likely error in metres, and which error that is."""
        known = {sign.name: sign for sign in self.signs if sign.size_m is not None and sign.speaks}
        best = next((known[name] for name in SIZES if name in known), None)
        return None if best is None else (float(best.size_m or 0.0), best.basis)

    def sentence(self, command: str, because: str = "") -> str:
        """Return a warning with the command that helps; empty if the poses seem right.

        `because` says why the command has what was not given.
        """
        if not self.absorbed or self.decided_by is None:
            return ""
        size = self.size
        error = "" if size is None else f" The likely error is {size[0]:.2g} m ({size[1]})."
        have = "seem to have" if self.decided_by.name == "neighbours" else "have"
        return (
            f"The poses {have} absorbed the refraction: {self.decided_by.words}.{error} Correcting"
            f" the cloud alone makes it worse; adjust the poses first{because}: {command}"
        )

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        size = self.size
        return {
            "absorbed": self.absorbed,
            "likely_error_m": None if size is None or not self.absorbed else size[0],
            "signs": [
                {"name": s.name, "absorbed": s.speaks, "words": s.words, **s.figures}
                for s in self.signs
            ],
        }


def diagnosis_of(signs: list[Sign]) -> Diagnosis:
    """Return the signs in the order in which they decide."""
    return Diagnosis(tuple(sorted(signs, key=lambda sign: [*SENTENCES].index(sign.name))))


def export_of(cameras: Cameras) -> str:
    """Return what the user has to give so that the poses can be checked."""
    source = cameras.source.lower()
    other = "export a model with tie points (COLMAP or Bundler)"
    found = next((words for name, words in EXPORTS.items() if name in source), other)
    return f"{found}, or run 'pcfix cameras FILE --gnss GNSS.csv'"


# Tie points


def tie_point_sign(straight: Intersected, refracted: Intersected, depth_m: FloatArray) -> Sign:
    """Compare residuals of tie points with and without refraction, with the poses as they are.

    Parameters
    ----------
    straight, refracted : Intersected
        The same m points from the same observations.
    depth_m : array, shape (m,)
        Of the straight intersection below the water; negative on land.

    Notes
    -----
    With the residuals s without and r with refraction, d = s - r is what straight rays cannot fit.
    With true poses r is noise, which is independent of d; with poses that absorbed the refraction s
    is noise. So b = -(r . d) / (d . d) is 0 or 1, whatever the noise. Its standard error is that of
    a jackknife over parts of the area, as errors of a pose are common to neighbours.
    """
    redundancy = straight.redundancy
    worst = np.maximum(straight.squares, refracted.squares) / np.maximum(redundancy, 1)
    good = np.isfinite(worst) & (redundancy > 0) & np.isfinite(depth_m)
    if good.any():
        good &= worst <= np.quantile(worst[good], 1.0 - OUTLIERS)
    wet, land = good & (depth_m > 0.0), good & (depth_m < 0.0)
    count = {"wet_points": float(wet.sum())}
    if wet.sum() < LEAST_POINTS:
        return Sign("tie points", count, None, why=f"only {wet.sum()} tie points under water")
    d = straight.residual_px - refracted.residual_px
    over = straight.sums(-(refracted.residual_px * d).sum(axis=1))[wet]
    under = straight.sums((d * d).sum(axis=1))[wet]
    if under.sum() < LEAST_BEND * straight.squares[wet].sum():
        why = "straight rays fit as well as refracted ones: too shallow, or only nadir rays"
        return Sign("tie points", count, None, why=why)
    # as many points in each part of the area along x and along y
    rank = np.argsort(
        np.argsort(straight.xyz[wet, :2], axis=0, kind="stable"), axis=0, kind="stable"
    )
    cell = rank * PARTS // len(rank)
    share, sigma = _jackknifed(over, under, cell[:, 0] * PARTS + cell[:, 1])
    figures = {"share": share, "sigma_share": sigma}
    for name, found in (("straight", straight), ("refracted", refracted)):
        figures[f"wet_{name}_px"] = _rms(found, wet)
        size = np.sqrt(found.squares[wet] / redundancy[wet])
        is_flat = not np.ptp(depth_m[wet]) > 0.0
        growth = 0.0 if is_flat else float(np.polyfit(depth_m[wet], size, 1)[0])
        figures[f"{name}_px_per_m"] = growth
    if land.sum() >= LEAST_POINTS:
        figures["land_px"] = _rms(straight, land)
    return Sign("tie points", figures, _side(share, sigma))


def _jackknifed(over: FloatArray, under: FloatArray, part: IntArray) -> tuple[float, float]:
    """Return the ratio of two sums, and its standard error by leaving out each part in turn."""
    number = np.unique(part, return_inverse=True)[1].ravel()
    a, b = np.bincount(number, over), np.bincount(number, under)
    total = max(b.sum(), 1e-300)
    without = (a.sum() - a) / np.maximum(total - b, 1e-300)
    g = len(a)
    sigma = np.sqrt((g - 1) / g * ((without - without.mean()) ** 2).sum()) if g > 1 else np.inf
    return float(a.sum() / total), float(sigma)


def _side(share: float, sigma: float) -> bool | None:
    """Return whether a share exceeds the limit; None if that is not significant."""
    if not abs(share - SHARE) > SIGMAS * sigma or sigma > MOST_SIGMA:
        return None
    return bool(share > SHARE)


def _rms(found: Intersected, rows: BoolArray) -> float:
    """Return the standard deviation of an image coordinate from points, px."""
    return float(np.sqrt(found.squares[rows].sum() / max(found.redundancy[rows].sum(), 1)))


def sized(sign: Sign, mended: Mended) -> Sign:
    """Return a sign with the likely error, if refraction was absorbed."""
    if not sign.speaks:
        return sign
    size, basis = float(np.sqrt(np.mean(mended.bed_m**2))), "bed after its correction"
    if len(mended.land_m):
        basis = f"land; of the {basis} {size:.2g} m"
        size = float(np.sqrt(np.mean(mended.land_m**2)))
    return replace(sign, size_m=size, basis=f"RMS, heights of the {basis}")


# GNSS


def gnss_is_suspicious(centres: FloatArray, off_m: FloatArray, sigma_m: FloatArray) -> bool:
    """Return whether adjusted centres differ from the GNSS by too much, or in a curved pattern.

    `off_m` is adjusted minus GNSS, NaN where there is none; `sigma_m` is stated, NaN if not.
    """
    rows = np.isfinite(off_m)
    y, base = off_m[rows], similarity_gradients(centres - centres.mean(axis=0))[rows]
    if len(y) < 3 * base.shape[1]:
        return False
    left = _rest(y, base)
    sigma = sigma_m[rows]
    stated = np.isfinite(sigma)
    if stated.any() and np.sqrt(np.mean((left[stated] / sigma[stated]) ** 2)) > 1.5:
        return True
    # domes, saddles and twists of the three coordinates
    size = max(float(np.ptp(centres, axis=0).max()), 1e-9)
    px, py = ((centres - centres.mean(axis=0)) / size)[:, :2].T
    terms = np.column_stack([px * px, px * py, py * py])
    bends = np.einsum("ab,kc->kabc", np.eye(3), terms).reshape(len(centres), 3, 9)
    bent = np.hstack([base, bends[rows]])
    rest = _rest(y, bent)
    more, free = bent.shape[1] - base.shape[1], len(y) - bent.shape[1]
    if free < more:
        return False
    gain = ((left @ left) - (rest @ rest)) / more / max((rest @ rest) / free, 1e-300)
    return bool(gain > 3.0)  # F of 9 and some dozens: 1 %


def _rest(y: FloatArray, columns: FloatArray) -> FloatArray:
    """Return the residuals of a least squares fit."""
    return np.asarray(y - columns @ np.linalg.lstsq(columns, y, rcond=None)[0])


def gnss_sign(centres: FloatArray, off_m: FloatArray, sigma_m: FloatArray, mended: Mended) -> Sign:
    """Look for the pattern in which this water bends the block in adjusted minus GNSS positions.

    The pattern is the centres minus those that an adjustment with water finds without the GNSS.

    Notes
    -----
    off = b pattern + shift, turn and scale of the block + noise, by least squares. The noise is
    that of the residuals, or that stated of the GNSS if it is larger.
    """
    centres, off_m = centres[mended.row], off_m[mended.row]
    rows = np.isfinite(off_m)
    y, base = off_m[rows], similarity_gradients(centres - centres.mean(axis=0))[rows]
    clear = _rest((centres - mended.cameras.centres)[rows], base)
    share = float(clear @ y) / max(float(clear @ clear), 1e-300)
    left = _rest(y, np.column_stack([base, clear]))
    noise = float(np.linalg.norm(left) / np.sqrt(max(len(y) - 8, 1)))
    stated = sigma_m[mended.row][rows]
    if np.isfinite(stated).any() and np.nanmedian(stated) < MOST_STATED_M:
        noise = max(noise, float(np.nanmedian(stated)))
    sigma = noise / max(float(np.linalg.norm(clear)), 1e-150)
    figures = {
        "share": share, "sigma_share": sigma, "rms_m": float(np.sqrt(np.mean(y * y))),
        "predicted_rms_m": float(np.sqrt(np.mean(clear * clear))),
    }  # fmt: skip
    return sized(Sign("GNSS", figures, None if share > MOST_SHARE else _side(share, sigma)), mended)


# Surveys, calibrations and the cloud itself


def land_sign(higher_m: FloatArray, gsd_m: float, against: str) -> Sign:
    """Compare land of the cloud with a survey: cloud minus survey in metres, shape (m,).

    `against` names the survey.
    """
    found = higher_m[np.isfinite(higher_m)]
    if len(found) < 3:
        return Sign("land", {}, None, why=f"only {len(found)} places of {against} on land")
    bias, spread, sigma = _median_of(found)
    limit = max(SIGMAS * sigma, LAND_GSD * gsd_m)
    figures = {"bias_m": bias, "spread_m": spread, "limit_m": limit, "places": float(len(found))}
    basis = f"height of the land against {against}"
    return Sign("land", figures, True if abs(bias) > limit else None, abs(bias), basis)


def _median_of(values: FloatArray) -> tuple[float, float, float]:
    """Return the median, the robust standard deviation, and the median's standard error."""
    middle = float(np.median(values))
    spread = 1.4826 * float(np.median(np.abs(values - middle)))
    # 1.2533 times the standard error of a mean
    return middle, spread, 1.2533 * spread / float(np.sqrt(len(values)))


def bed_sign(apparent_m: FloatArray, true_m: FloatArray, refractive_index: float) -> Sign:
    """Compare depths of the cloud with measured ones, both below the water, shape (m,), metres."""
    deep = np.isfinite(apparent_m) & (true_m > LEAST_DEPTH_M) & (apparent_m > 0.0)
    if deep.sum() < 3:
        return Sign("bed", {}, None, why=f"only {deep.sum()} measured depths")
    share, _, sigma = _median_of(apparent_m[deep] / true_m[deep])
    limit = (1.0 + 1.0 / refractive_index) / 2.0  # between straight and refracted rays
    is_sure = abs(share - limit) > SIGMAS * sigma
    after = true_m[deep] - refractive_index * apparent_m[deep]
    return Sign(
        "bed", {"share": share, "sigma_share": sigma, "limit": limit},
        share > limit if is_sure else None,
        float(np.sqrt(np.mean(after**2))), "RMS, corrected depths against measured ones",
    )  # fmt: skip


def control_sign(residual_px: FloatArray, sigma_px: FloatArray, gsd_m: float) -> Sign:
    """Look at the residuals of control points on land: measured minus computed, shape (o, 2)."""
    seen = np.isfinite(residual_px).all(axis=1)
    if seen.sum() < 3:
        return Sign("control points", {}, None, why="fewer than three marks in images")
    rms = float(np.sqrt(np.mean(residual_px[seen] ** 2)))
    limit = max(CONTROL_PX, SIGMAS * float(np.median(sigma_px[seen])))
    return Sign(
        "control points", {"rms_px": rms, "limit_px": limit}, True if rms > limit else None,
        rms * gsd_m, "residuals of control points times the GSD",
    )  # fmt: skip


def neighbours_sign(share: float, sigma: float, *, is_fused: bool) -> Sign:
    """Look at the discontinuities between image footprints that the corrected bed still has.

    Parameters
    ----------
    share, sigma : float
        See `Verdict.straight` of `pcfix.refract`. On four rendered blocks it is 0.02 to 0.25
        with true poses, and 0.76 to 0.96 with those of an ordinary adjustment.
    is_fused : bool
        Whether the cloud is of fused depth maps; others can have discontinuities all the same.
    """
    speaks = abs(share - 0.5) > SIGMAS * sigma and (is_fused or share < 0.5)
    figures = {"share": share, "sigma_share": sigma}
    return Sign("neighbours", figures, share > 0.5 if speaks else None)


def focal_sign(focal: FloatArray, calibrated: FloatArray, height_m: float) -> Sign:
    """Compare focal lengths of the sensors, shape (s,), each in its unit, with calibrated ones."""
    off = focal / calibrated - 1.0
    worst = float(off[np.argmax(np.abs(off))])
    error = abs(worst) * height_m
    return Sign(
        "focal length", {"difference": worst, "error_m": error},
        True if abs(worst) > FOCAL_SHARE else None, error,
        "difference of the focal length times the flying height",
    )  # fmt: skip


# Evidence


@dataclass(frozen=True, eq=False)
class Evidence:
    """What the signs are looked for in."""

    cameras: Cameras  # in the cloud's CRS, with the GNSS positions to compare with
    name: str  # of their file, for messages
    water: WaterSurface
    refractive_index: float
    ties: TiePoints | None = None
    view: Any = None  # a `pcfix.flow.surfaces.CloudView`, for heights and in place of tie points
    control: GroundControl | None = None
    # focal length over width of the image, by sensor; "" is any
    calibrated: dict[str, float] | None = None
    reference: Any = None  # a survey of land and bed, with `xyz` and `sparse`
    gnss: GnssPositions | None = None  # in the frame of the cameras, NaN if unknown
    neighbours: Sign | None = None  # of `neighbours_sign`
    in_passing: bool = False  # whether it must be quick

    @property
    def has_height(self) -> bool:
        """Whether the water has a height everywhere, not only at points of the cloud."""
        return not isinstance(self.water, WaterDimension)

    @property
    def has_rays(self) -> bool:
        """Whether straight and refracted rays can be computed."""
        cameras = self.cameras
        if cameras.rotations is None or cameras.lenses is None:
            return False
        return self.has_height and all(lens.unit == "px" for lens in cameras.lenses)

    @property
    def gsd_m(self) -> float:
        """Approximate size of a pixel at the water; zero if unknown."""
        lenses, centres = self.cameras.lenses, self.cameras.centres
        if lenses is None or not self.has_height:
            return 0.0
        level = surface_above(self.water, centres).height_m
        above = centres[:, 2] - np.where(np.isfinite(level), level, np.nanmean(level))
        focal = [lens.focal if lens.unit == "px" else np.inf for lens in lenses]
        return float(np.mean(above / focal))


def diagnosed(evidence: Evidence) -> Diagnosis:
    """Look for every sign that the evidence allows."""
    signs = [] if evidence.neighbours is None else [evidence.neighbours]
    if evidence.has_rays:
        signs += _signs_of_rays(evidence)
    if evidence.calibrated:
        signs += _signs_of_calibration(evidence, evidence.calibrated)
    if evidence.control is not None:
        signs += _signs_of_control(evidence, evidence.control)
    if evidence.reference is not None and evidence.view is not None and evidence.has_height:
        signs += _signs_of_reference(evidence)
    return diagnosis_of(signs)


def _signs_of_rays(evidence: Evidence) -> list[Sign]:
    """Look at tie points, and at the GNSS."""
    cameras, nothing = evidence.cameras, np.full((len(evidence.cameras), 3), np.nan)
    gnss = evidence.gnss or GnssPositions(nothing, nothing, None)
    signs, apparent = _signs_of_ties(evidence)
    off = cameras.centres - gnss.xyz
    known = int(np.isfinite(off).sum()) >= LEAST_COORDINATES
    suspicious = gnss_is_suspicious(cameras.centres, off, gnss.sigma_m)
    why = "without a pattern"
    if any(sign.speaks for sign in signs) or suspicious or (known and not evidence.in_passing):
        try:
            mended = _mended(evidence, apparent)
        except GeometryError as error:
            why = f"the cause of the pattern is unknown ({error})"
        else:
            signs = [sized(sign, mended) for sign in signs]
            return signs + [gnss_sign(cameras.centres, off, gnss.sigma_m, mended)] * known
    if known:
        rms = float(np.sqrt(np.nanmean(off**2)))
        words = f"projection centres differ from the GNSS by {rms:.3f} m RMS, {why}"
        signs.append(Sign("GNSS", {"rms_m": rms}, None, why=words))
    return signs


def _signs_of_ties(evidence: Evidence) -> tuple[list[Sign], FloatArray | None]:
    """Intersect some tie points with straight and refracted rays; return the straight ones too."""
    ties, n = evidence.ties, evidence.refractive_index
    if ties is None:
        return [], None
    counts = np.diff(ties.views.start)
    rows = np.flatnonzero((counts >= LEAST_TIE_VIEWS) & np.isfinite(ties.xyz).all(axis=1))
    if not len(rows):
        return [], None
    from pcfix.adjust.problem import intersect_fixed  # not quick to load

    some = taken(ties, rows[:: max(1, len(rows) // TIE_POINTS)])
    block = plain_block(evidence.cameras, some, None, n)
    straight = intersect_fixed(block)
    above = surface_above(evidence.water, straight.xyz)
    wet = is_submerged(straight.xyz[:, 2], above)
    begin = deeper(straight.xyz, above.height_m, wet, n)
    refracted = intersect_fixed(replace(block, xyz=begin, wet=wet, water=evidence.water))
    sign = tie_point_sign(straight, refracted, above.height_m - straight.xyz[:, 2])
    return [sign], straight.xyz[np.isfinite(straight.squares)]


def _mended(evidence: Evidence, apparent: FloatArray | None) -> Mended:
    """Return the poses that an adjustment with water would have found."""
    count, most = len(evidence.cameras), QUICK_IMAGES if evidence.in_passing else MOST_IMAGES
    if count > most or (apparent is None and evidence.view is None):
        why = f"{count} images (limit {most})" if count > most else "no cloud"
        raise GeometryError("adjust.no_pattern", why)
    wanted = max(CLOUD_POINTS, POINTS_PER_IMAGE * count)
    if apparent is None:
        apparent = sample_of(evidence.view, wanted)
    from pcfix.adjust.from_cloud import mended  # not quick to load

    some = apparent[:: max(1, len(apparent) // wanted)]
    return mended(some, evidence.cameras, evidence.water, evidence.refractive_index)


def sample_of(view: Any, wanted: int) -> FloatArray:
    """Return about so many points of a cloud, evenly spread over it, shape (m, 3)."""
    every = max(1, view.points // wanted)
    return np.vstack([np.zeros((0, 3)), *(seen.xyz[::every] for seen in view.chunks())])


def _signs_of_calibration(evidence: Evidence, known: dict[str, float]) -> list[Sign]:
    """Compare each sensor with its calibration."""
    by_sensor: dict[str, list[float]] = {}
    for lens in evidence.cameras.lenses or ():
        by_sensor.setdefault(lens.sensor, []).append(lens.focal / lens.width)
    pairs = [
        (float(np.mean(focal)), known.get(name, known.get("", np.nan)))
        for name, focal in by_sensor.items()
    ]
    pairs = [pair for pair in pairs if np.isfinite(pair[1])]
    if not pairs:
        return []
    centres = evidence.cameras.centres
    level = surface_above(evidence.water, centres).height_m if evidence.has_height else np.nan
    height = float(np.nanmedian(centres[:, 2] - level)) if np.isfinite(level).any() else 0.0
    focal, calibrated = np.array(pairs).T
    return [focal_sign(focal, calibrated, height)]


def _signs_of_control(evidence: Evidence, control: GroundControl) -> list[Sign]:
    """Compare control points on land with the cloud and in the images."""
    level = surface_above(evidence.water, control.xyz).height_m
    land = ~control.under_water & ~(control.xyz[:, 2] < level)
    gsd, cameras, signs = evidence.gsd_m, evidence.cameras, []
    if evidence.view is not None:
        higher = _cloud_heights(evidence.view, control.xyz[land], gsd) - control.xyz[land, 2]
        signs.append(land_sign(higher, gsd, "the control points"))
    if cameras.rotations is not None and cameras.lenses is not None:
        rows = np.flatnonzero(land[control.point])
        at = straight_images(control.xyz[control.point[rows]], control.camera[rows], cameras)
        signs.append(control_sign(control.image_xy[rows] - at, control.sigma_px[rows], gsd))
    return signs


def _signs_of_reference(evidence: Evidence) -> list[Sign]:
    """Compare land and bed of the cloud with a survey of both."""
    gsd, surveyed = evidence.gsd_m, evidence.reference.xyz
    if evidence.reference.sparse:
        cloud_z = _cloud_heights(evidence.view, surveyed, gsd)
    else:
        cloud, surveyed = _at_points_of_cloud(evidence.view, surveyed)
        cloud_z = cloud[:, 2]
    if not len(surveyed):
        return []
    level = surface_above(evidence.water, surveyed).height_m
    land, bed = surveyed[:, 2] > level + LAND_M, surveyed[:, 2] < level
    signs = []
    if land.any():
        signs.append(land_sign(cloud_z[land] - surveyed[land, 2], gsd, "the reference"))
    if bed.any():
        apparent, true = level - cloud_z, level - surveyed[:, 2]
        signs.append(bed_sign(apparent[bed], true[bed], evidence.refractive_index))
    return signs


def _cloud_heights(view: Any, xyz: FloatArray, gsd_m: float) -> FloatArray:
    """Return the heights of a cloud at single places, shape (p,); NaN where it has none."""
    radius = float(np.clip(10.0 * gsd_m, 0.2, 2.0))
    xy = np.ascontiguousarray(xyz[:, :2])
    if not len(xy):
        return np.zeros(0)
    near = [seen.xyz[is_near(xy, seen.xyz, radius)] for seen in view.chunks()]
    return heights_from_cloud(xy, np.vstack([np.zeros((0, 3)), *near]), radius)


def _at_points_of_cloud(view: Any, reference: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return points of a cloud, and the reference at their places."""
    from scipy.spatial import cKDTree

    cloud = sample_of(view, SAMPLE_POINTS)
    if len(reference) < NEAREST or not len(cloud):
        return cloud[:0], reference[:0]
    size = np.ptp(reference[:, :2], axis=0)
    spacing = float(np.sqrt(max(size.prod(), 1e-9) / len(reference)))
    found = cKDTree(reference[:, :2]).query(cloud[:, :2], k=NEAREST)
    distance, row = np.asarray(found[0]), np.asarray(found[1])
    near = distance[:, -1] < 3.0 * spacing
    z = reference[row[near], 2].mean(axis=1)
    return cloud[near], np.column_stack([cloud[near, :2], z])

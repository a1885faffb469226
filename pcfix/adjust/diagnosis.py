r"""Whether an ordinary bundle adjustment has absorbed the refraction into lens and poses.

Software that knows nothing of water fits the images of a bed all the same: it bends the lens and
the block until straight rays meet. The land then lies at a wrong height, and a correction of the
cloud alone adds to what is already there. Seven signs tell, each by a statistic of its own; in
order of what they can tell:

tie points : intersected with refraction, points under water fit their images worse than with
    straight rays. With true poses it is the other way round.
GNSS : the centres are off in the very pattern in which this water would have bent this block
    (`pcfix.adjust.mend`).
bed : depths of the cloud are nearly the true ones before any correction, where refraction leaves
    1/n of them or less.
land, control points, focal length : they are off. They can be so for other reasons, and show
    nothing where ground control held them.
neighbours : points of a dense cloud that different images made fit each other as straight rays
    have them, and not as refracted ones do.

The first of them that can say something decides.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.model import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    from pcfix.adjust.mend import Mended
    from pcfix.adjust.problem import Intersected

LEAST_POINTS = 30
"""Tie points under water that a statement takes."""
PARTS = 5
"""Of the area, along x and along y, for the jackknife."""
LEAST_BEND = 1e-3
"""Of the squares of the residuals: what straight rays leave of the refraction, to tell anything."""
OUTLIERS = 0.05
"""Share of the tie points that are left out, those with the worst residuals."""
SHARE, MOST_SHARE, MOST_SIGMA = 0.4, 2.0, 0.15
"""Of the refraction absorbed, where the poses count as bent, what is too much to be that, and the
largest standard error of a statement. On simulated blocks with 0.5 px and 3 cm it lies within 0.1
of 0 with true poses and at 0.54 to 1.1 with those of an ordinary adjustment, the less the more the
GNSS counted in it; see tests/adjust/test_diagnosis.py."""
SIGMAS = 3.0
"""How many standard errors are no chance."""
LAND_GSD = 2.0
"""Of land against a survey: what dense matching and its smoothing leave."""
CONTROL_PX = 2.0
"""Of control points in the images, rms."""
FOCAL_SHARE = 1.5e-3
"""Of a calibrated focal length: factory calibrations of a five-lens camera over land differ from
the adjusted ones by up to 0.7e-3, and consumer cameras by as much with temperature."""
LEAST_DEPTH_M = 0.5


@dataclass(frozen=True)
class Sign:
    """One statistic.

    Attributes
    ----------
    name : str
    words : str
        What was found, with its numbers and the limit.
    figures : dict
    speaks : bool or None
        Whether it says that refraction was absorbed; None where it says nothing.
    size_m : float or None
        The likely error in metres that it shows.
    basis : str
        What that is an error of.
    plainly : str
        What was found, for a warning; empty: `words`.
    """

    name: str
    words: str
    figures: dict[str, float]
    speaks: bool | None
    size_m: float | None = None
    basis: str = ""
    plainly: str = ""


@dataclass(frozen=True)
class Diagnosis:
    """All signs that could be looked for, those that tell most first."""

    signs: tuple[Sign, ...]

    @property
    def decided_by(self) -> Sign | None:
        """The first sign that says something."""
        return next((sign for sign in self.signs if sign.speaks is not None), None)

    @property
    def absorbed(self) -> bool | None:
        """Whether the poses have absorbed the refraction; None where nothing tells."""
        return None if self.decided_by is None else self.decided_by.speaks

    @property
    def size(self) -> tuple[float, str] | None:
        """The likely error in metres, and of what: measured on land before predicted."""
        known = {sign.name: sign for sign in self.signs if sign.size_m is not None and sign.speaks}
        for name in ("land", "GNSS", "tie points", "control points", "bed", "focal length"):
            if name in known:
                return float(known[name].size_m or 0.0), known[name].basis
        return None

    def sentence(self, command: str, because: str = "") -> str:
        """Return a plain warning with what mends it; empty where the poses seem right.

        `because` says why the command has what was not given.
        """
        if not self.absorbed or self.decided_by is None:
            return ""
        size = self.size
        error = "" if size is None else f" The likely error is {size[0]:.2g} m ({size[1]})."
        why = self.decided_by.plainly or self.decided_by.words
        have = "seem to have" if self.decided_by.name == "neighbours" else "have"
        return (
            f"The poses {have} absorbed the refraction: {why}.{error} Correcting the cloud alone"
            f" makes it worse; mend the poses first{because}: {command}"
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


def tie_point_sign(straight: Intersected, refracted: Intersected, depth_m: FloatArray) -> Sign:
    """Compare how tie points fit their images with and without refraction, poses as they are.

    Parameters
    ----------
    straight, refracted : Intersected
        The same m points from the same observations.
    depth_m : array, shape (m,)
        Of the straight intersection below the water; negative on land.

    Notes
    -----
    With the residuals s without and r with refraction, d = s - r is what straight rays cannot fit.
    With true poses r is noise, which knows nothing of d; with poses that absorbed the refraction s
    is noise. So b = -(r . d) / (d . d) is 0 or 1, whatever the noise. Its standard error is that of
    a jackknife over parts of the area, as errors of a pose are common to neighbours.
    """
    good = _without_outliers(straight, refracted, depth_m)
    wet, land = good & (depth_m > 0.0), good & (depth_m < 0.0)
    if wet.sum() < LEAST_POINTS:
        words = f"only {wet.sum()} tie points under water"
        return Sign("tie points", words, {"wet_points": float(wet.sum())}, None)
    d = straight.residual_px - refracted.residual_px
    over = straight.sums(-(refracted.residual_px * d).sum(axis=1))[wet]
    under = straight.sums((d * d).sum(axis=1))[wet]
    if under.sum() < LEAST_BEND * straight.squares[wet].sum():
        words = "straight rays fit as well as refracted ones: too shallow, or the rays too steep"
        return Sign("tie points", words, {"wet_points": float(wet.sum())}, None)
    share, sigma = _jackknifed(over, under, _parts_of(straight.xyz[wet]))
    figures = {
        "share": share, "sigma_share": sigma, "land_px": _rms(straight, land),
        "wet_straight_px": _rms(straight, wet), "wet_refracted_px": _rms(refracted, wet),
        "straight_px_per_m": _slope(straight, wet, depth_m),
        "refracted_px_per_m": _slope(refracted, wet, depth_m),
    }  # fmt: skip
    if land.sum() < LEAST_POINTS:
        del figures["land_px"]
    plainly = (
        f"tie points under water have residuals of {figures['wet_refracted_px']:.2f} px with"
        f" refraction and of {figures['wet_straight_px']:.2f} px with straight rays"
    )
    return Sign("tie points", _tie_words(figures), figures, _side(share, sigma), plainly=plainly)


def _tie_words(f: dict[str, float]) -> str:
    on_land = f", {f['land_px']:.2f} px on land" if "land_px" in f else ""
    return (
        f"residuals of tie points under water are {f['wet_straight_px']:.2f} px with straight rays,"
        f" {f['straight_px_per_m']:+.3f} px per metre of depth, and {f['wet_refracted_px']:.2f} px,"
        f" {f['refracted_px_per_m']:+.3f} px per metre, with refraction{on_land}; they show"
        f" {_share_words(f)}"
    )


def _share_words(f: dict[str, float]) -> str:
    return (
        f"{f['share']:.2f} of the refraction absorbed, standard error {f['sigma_share']:.2f}"
        f" (limit {SHARE:g})"
    )


def _without_outliers(
    straight: Intersected, refracted: Intersected, depth_m: FloatArray
) -> BoolArray:
    """Return which points count: intersected both ways, and not among the worst."""
    redundancy = straight.redundancy
    worst = np.maximum(straight.squares, refracted.squares) / np.maximum(redundancy, 1)
    good = np.isfinite(worst) & (redundancy > 0) & np.isfinite(depth_m)
    if good.any():
        good &= worst <= np.quantile(worst[good], 1.0 - OUTLIERS)
    return good


def _parts_of(xyz: FloatArray) -> IntArray:
    """Return in which of `PARTS` squared parts of the area points lie, as many in each row."""
    rank = np.argsort(np.argsort(xyz[:, :2], axis=0, kind="stable"), axis=0, kind="stable")
    cell = rank * PARTS // len(xyz)
    return np.asarray(cell[:, 0] * PARTS + cell[:, 1])


def _jackknifed(over: FloatArray, under: FloatArray, part: IntArray) -> tuple[float, float]:
    """Return the ratio of two sums, and its standard error when a part is left out in turn."""
    number = np.unique(part, return_inverse=True)[1].ravel()
    a, b = np.bincount(number, over), np.bincount(number, under)
    total = max(b.sum(), 1e-300)
    share = a.sum() / total
    without = (a.sum() - a) / np.maximum(total - b, 1e-300)
    g = len(a)
    sigma = np.sqrt((g - 1) / g * ((without - without.mean()) ** 2).sum()) if g > 1 else np.inf
    return float(share), float(sigma)


def _side(share: float, sigma: float) -> bool | None:
    """Return on which side of the limit a share lies; None where that is not sure."""
    if not abs(share - SHARE) > SIGMAS * sigma or sigma > MOST_SIGMA:
        return None
    return bool(share > SHARE)


def _rms(found: Intersected, rows: BoolArray) -> float:
    """Return the standard deviation of an image coordinate from points, px."""
    return float(np.sqrt(found.squares[rows].sum() / max(found.redundancy[rows].sum(), 1)))


def _slope(found: Intersected, rows: BoolArray, depth_m: FloatArray) -> float:
    """Return how residuals grow with depth, px per metre."""
    size = np.sqrt(found.squares[rows] / found.redundancy[rows])
    return float(np.polyfit(depth_m[rows], size, 1)[0]) if np.ptp(depth_m[rows]) > 0.0 else 0.0


def sized(sign: Sign, mended: Mended) -> Sign:
    """Return a sign with the likely error, and of what, where refraction was absorbed."""
    if not sign.speaks:
        return sign
    bed = float(np.sqrt(np.mean(mended.bed_m**2)))
    if not len(mended.land_m):
        return replace(sign, size_m=bed, basis="rms, heights of the bed after its correction")
    land = float(np.sqrt(np.mean(mended.land_m**2)))
    basis = f"rms, heights of the land; of the bed after its correction {bed:.2g} m"
    return replace(sign, size_m=land, basis=basis)


def gnss_is_suspicious(centres: FloatArray, off_m: FloatArray, sigma_m: FloatArray) -> bool:
    """Whether adjusted centres are so far from the GNSS, or in such a shape, that it is no chance.

    `off_m` is adjusted minus GNSS, NaN where there is none; `sigma_m` is stated, NaN where not.
    """
    rows = np.isfinite(off_m)
    y, base = off_m[rows], _as_a_whole(centres)[rows]
    if len(y) < 3 * base.shape[1]:
        return False
    left = _rest(y, base)
    sigma = sigma_m[rows]
    stated = np.isfinite(sigma)
    if stated.any() and np.sqrt(np.mean((left[stated] / sigma[stated]) ** 2)) > 1.5:
        return True
    bent = np.hstack([base, _bends(centres)[rows]])
    rest = _rest(y, bent)
    more, free = bent.shape[1] - base.shape[1], len(y) - bent.shape[1]
    if free < more:
        return False
    gain = ((left @ left) - (rest @ rest)) / more / max((rest @ rest) / free, 1e-300)
    return bool(gain > 3.0)  # F of 9 and some dozens: 1 %


def _as_a_whole(centres: FloatArray) -> FloatArray:
    """Return how centres move with shift, turn and scale of the block, shape (k, 3, 7)."""
    from pcfix.adjust.problem import similarity_gradients  # not quick to load

    return similarity_gradients(centres - centres.mean(axis=0))


def _rest(y: FloatArray, columns: FloatArray) -> FloatArray:
    """Return what is left of values after the best sum of columns."""
    return np.asarray(y - columns @ np.linalg.lstsq(columns, y, rcond=None)[0])


def _bends(centres: FloatArray) -> FloatArray:
    """Return domes, saddles and twists of the three coordinates, shape (k, 3, 9)."""
    size = max(float(np.ptp(centres, axis=0).max()), 1e-9)
    x, y = ((centres - centres.mean(axis=0)) / size)[:, :2].T
    found = np.zeros((len(centres), 3, 9))
    for axis in range(3):
        found[:, axis, 3 * axis : 3 * axis + 3] = np.column_stack([x * x, x * y, y * y])
    return found


def gnss_sign(centres: FloatArray, off_m: FloatArray, sigma_m: FloatArray, mended: Mended) -> Sign:
    """Look in adjusted minus GNSS positions for the pattern in which this water bends the block.

    That is the centres as they are minus those that an adjustment with water finds without the
    GNSS.

    Notes
    -----
    off = b predicted + shift, turn and scale of the block + noise, by least squares. The noise is
    what is left, or what the GNSS states if that is more.
    """
    centres, off_m = centres[mended.row], off_m[mended.row]
    rows = np.isfinite(off_m)
    y, base = off_m[rows], _as_a_whole(centres)[rows]
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
    words = (
        f"centres minus GNSS are {figures['rms_m']:.3f} m rms; by the pattern in which this water"
        f" bends the block they show {_share_words(figures)}"
    )
    plainly = (
        f"the centres differ by {figures['rms_m']:.2f} m rms from the GNSS, in the pattern in"
        " which this water bends the block"
    )
    speaks = None if share > MOST_SHARE else _side(share, sigma)
    return sized(Sign("GNSS", words, figures, speaks, plainly=plainly), mended)


MOST_STATED_M = 0.5
"""A larger standard deviation is a default that software writes, as Metashape's 10 m."""


def land_sign(higher_m: FloatArray, gsd_m: float, against: str) -> Sign:
    """Compare the cloud's land with a survey: cloud minus survey in metres, shape (m,).

    `against` is what was surveyed, in words.
    """
    found = higher_m[np.isfinite(higher_m)]
    if len(found) < 3:
        return Sign("land", f"only {len(found)} places of {against} on land", {}, None)
    bias = float(np.median(found))
    spread = 1.4826 * float(np.median(np.abs(found - bias)))
    limit = max(SIGMAS * 1.2533 * spread / np.sqrt(len(found)), LAND_GSD * gsd_m)
    words = (
        f"land of the cloud lies {abs(bias):.3f} m {'above' if bias > 0 else 'below'} {against}"
        f" ({len(found):,} places, spread {spread:.3f} m, limit {limit:.3f} m)"
    )
    figures = {"bias_m": bias, "spread_m": spread, "limit_m": limit, "places": float(len(found))}
    return Sign(
        "land", words, figures, True if abs(bias) > limit else None, abs(bias),
        f"height of the land against {against}",
    )  # fmt: skip


def bed_sign(apparent_m: FloatArray, true_m: FloatArray, refractive_index: float) -> Sign:
    """Compare depths of the cloud with measured ones, both below the water, shape (m,), metres."""
    deep = np.isfinite(apparent_m) & (true_m > 2.0 * LEAST_DEPTH_M) & (apparent_m > 0.0)
    if deep.sum() < 3:
        return Sign("bed", f"only {deep.sum()} measured depths", {}, None)
    ratio = apparent_m[deep] / true_m[deep]
    share = float(np.median(ratio))
    sigma = 1.2533 * 1.4826 * float(np.median(np.abs(ratio - share))) / np.sqrt(deep.sum())
    true_share = 1.0 / refractive_index
    limit = (1.0 + true_share) / 2.0
    words = (
        f"the cloud's bed has {share:.2f} of its measured depth before any correction, standard"
        f" error {sigma:.2f}, where refraction leaves {true_share:.2f} or less"
        f" ({deep.sum()} places, limit {limit:.2f})"
    )
    is_sure = abs(share - limit) > SIGMAS * sigma
    after = true_m[deep] - refractive_index * apparent_m[deep]
    return Sign(
        "bed", words, {"share": share, "sigma_share": sigma, "limit": limit},
        share > limit if is_sure else None,
        float(np.sqrt(np.mean(after**2))), "rms, measured depths against corrected ones",
    )  # fmt: skip


def control_sign(residual_px: FloatArray, sigma_px: FloatArray, gsd_m: float) -> Sign:
    """Look at marks of points on land in the images: measured minus computed, shape (o, 2)."""
    seen = np.isfinite(residual_px).all(axis=1)
    if seen.sum() < 3:
        return Sign("control points", "fewer than three marks in images", {}, None)
    rms = float(np.sqrt(np.mean(residual_px[seen] ** 2)))
    limit = max(CONTROL_PX, SIGMAS * float(np.median(sigma_px[seen])))
    words = (
        f"control points on land have residuals of {rms:.2f} px in the images ({seen.sum()} marks,"
        f" limit {limit:.2f} px)"
    )
    return Sign(
        "control points", words, {"rms_px": rms, "limit_px": limit}, True if rms > limit else None,
        rms * gsd_m, "residuals of control points times the GSD",
    )  # fmt: skip


def neighbours_sign(share: float, sigma: float, *, is_fused: bool) -> Sign:
    """Look at what is left, in the corrected bed, of the steps between neighbours.

    Parameters
    ----------
    share, sigma : float
        See `Verdict.straight` of `pcfix.refract`. On four rendered blocks it is 0.02 to 0.25
        with true poses, and 0.76 to 0.96 with those of an ordinary adjustment.
    is_fused : bool
        Whether the cloud was taken for fused depth maps; of others steps can be left all the same.
    """
    words = (
        f"of the steps between neighbours by which refracted rays differ from straight ones,"
        f" {share:.2f} are left in the corrected bed, standard error {sigma:.2f} (limit 0.50)"
    )
    plainly = (
        "neighbouring points of the bed that different images made fit each other with straight"
        f" rays, and not with refracted ones, which leave {100.0 * min(share, 1.0):.0f} % of the"
        " steps between them (a cloud that was filtered or meshed can look so)"
    )
    speaks = abs(share - 0.5) > SIGMAS * sigma and (is_fused or share < 0.5)
    figures = {"share": share, "sigma_share": sigma}
    return Sign("neighbours", words, figures, share > 0.5 if speaks else None, plainly=plainly)


def focal_sign(focal: FloatArray, calibrated: FloatArray, height_m: float) -> Sign:
    """Compare focal lengths of the sensors, shape (s,), each in its unit, with calibrated ones."""
    off = focal / calibrated - 1.0
    worst = float(off[np.argmax(np.abs(off))])
    error = abs(worst) * height_m
    words = (
        f"the focal length is {1e3 * abs(worst):.2f} per mille"
        f" {'longer' if worst > 0 else 'shorter'} than the calibrated one, {error:.2f} m at the"
        f" ground (limit {1e3 * FOCAL_SHARE:g} per mille)"
    )
    return Sign(
        "focal length", words, {"difference": worst, "error_m": error},
        True if abs(worst) > FOCAL_SHARE else None, error,
        "difference of the focal length times the flying height",
    )  # fmt: skip


def diagnosis_of(signs: list[Sign]) -> Diagnosis:
    """Return the signs in the order of what they can tell."""
    order = ("tie points", "GNSS", "bed", "land", "control points", "neighbours", "focal length")
    return Diagnosis(tuple(sorted(signs, key=lambda sign: order.index(sign.name))))

"""Choose the points of a cloud and of a reference to compare."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from pcfix.errors import GeometryError, SettingError, bad_file
from pcfix.model import BoolArray, FloatArray, IntArray, WaterSurface
from pcfix.options.steps import CompareRules
from pcfix.points.neighbours import nearest_of
from pcfix.running import blocks, bounds, distinct, empty, mapped, subset


@dataclass(frozen=True, eq=False)
class SurveyCloud:
    """The n points of a cloud that are used; world frame, metres."""

    name: str  # for messages
    xyz: FloatArray  # (n, 3)
    crs: Any  # pyproj.CRS or None
    excluded: int  # points withheld, or of an ignored class
    shift_m: FloatArray | None  # (n, 3), true minus apparent, of a cloud that pcfix corrected
    bathymetric: BoolArray  # (n,), class 40
    water_m: FloatArray  # (n,), height of the water above each point; NaN if unknown
    water: WaterSurface | None = None  # the surface itself, if it is known

    def __len__(self) -> int:
        return len(self.xyz)

    @property
    def after(self) -> FloatArray:
        """The points after the correction, shape (n, 3)."""
        return self.xyz

    @cached_property
    def before(self) -> FloatArray | None:
        """The apparent points before the correction, shape (n, 3); None if they are not known."""
        return None if self.shift_m is None else mapped(np.subtract, self.xyz, self.shift_m)

    def take(self, rows: BoolArray) -> "SurveyCloud":
        """Return the cloud with these rows only."""
        if rows.all():
            return self
        return replace(
            self,
            xyz=subset(rows, self.xyz),
            shift_m=None if self.shift_m is None else subset(rows, self.shift_m),
            bathymetric=subset(rows, self.bathymetric),
            water_m=subset(rows, self.water_m),
        )


@dataclass(frozen=True, eq=False)
class Reference:
    """Heights that are taken as true: m points in the world frame."""

    name: str  # for messages
    xyz: FloatArray  # (m, 3), metres
    crs: Any  # pyproj.CRS or None
    excluded: int = 0  # points withheld, of noise, or of water; cells without data
    sparse: bool = False  # single check points, not a sampled surface
    raster: bool = False  # centres of cells


@dataclass(frozen=True, eq=False)
class Match:
    """The points of a cloud and a reference that are compared."""

    survey: SurveyCloud  # all points that are neither withheld nor noise
    asked: SurveyCloud  # those under water, if only these are compared
    cloud: SurveyCloud  # the n points of these within the reference
    wet: BoolArray  # (n,), those under water
    reference: Reference
    places: FloatArray  # (p, 3), points of the reference that the cloud covers, metres
    outside: int  # points outside the overlap, and on land; check points if the reference is sparse
    not_submerged: int
    settings: CompareRules

    def facing(self, xyz: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return where a cloud is measured, and the surface to which: its own at check points."""
        return (self.places, xyz) if self.reference.sparse else (xyz, self.reference.xyz)

    @cached_property
    def water_points(self) -> FloatArray:
        """The water surface above the points where it is known, shape (w, 3), metres."""
        known = mapped(np.isfinite, self.survey.water_m)
        if not known.any():
            return np.empty((0, 3))
        xyz, water_m = subset(known, self.survey.xyz), subset(known, self.survey.water_m)
        return mapped(lambda p, w: np.column_stack([p[:, :2], w]), xyz, water_m)

    def water_at(self, xy: FloatArray) -> FloatArray | None:
        """Return the height of the water at places (n, 2); None if unknown.

        Without a surface it is the height above the nearest point where it is known.
        """
        if (water := self.survey.water) is not None:
            from pcfix.water.surface import surface_above  # slow to import

            return mapped(
                lambda p: surface_above(water, np.column_stack([p, p[:, 0]])).height_m, xy
            )
        if len(self.water_points) == 0:
            return None
        height = empty((len(xy),))
        for rows, _, near in nearest_of(xy, self.water_points, 1):
            height[rows] = near[:, 0, 2]
        return height


def match(survey: SurveyCloud, target: Reference, settings: CompareRules, *, given: bool) -> Match:
    """Choose the points to compare.

    If the user has `given` the water surface it decides what is submerged, else also class 40.
    Raises PcfixError if the clouds do not overlap, nothing is under water where that was asked for,
    or the reference does not allow the direction of C2C.
    """
    code, why, direction = "", "", settings.direction
    if target.raster and settings.from_reference:
        code, why = "reference.no_points", "is a raster, without measured points"
    elif target.sparse and direction not in (None, "from-reference"):
        code, why = "reference.check_points", "has check points, too few for C2C to them"
    if code:
        sentence = f"{target.name} {why}. Omit --direction {direction}, or give a cloud."
        raise SettingError(code, sentence, path=target.name, direction=direction)
    wet = mapped(lambda xyz, water: xyz[:, 2] < water, survey.xyz, survey.water_m)
    if not given:
        wet |= survey.bathymetric
    chosen = wet if settings.submerged else np.ones(len(survey), np.bool_)
    if not chosen.any():
        sentence = (
            "no point is of class 40 or below the water. Give the water surface with --water, or"
            " omit --submerged."
        )
        raise bad_file(survey.name, "cloud.not_submerged", sentence)
    asked, not_submerged = survey.take(chosen), int(len(survey) - chosen.sum())
    by_place = target.sparse or settings.from_reference
    places, near = target.xyz, chosen
    if by_place:
        gap = settings.max_gap or gap_m(survey.xyz)
        places = subset(near_in_plan(places, asked.xyz, gap), places)
    if not target.sparse:
        gap = settings.max_gap or gap_m(target.xyz)
        near = chosen & near_in_plan(survey.xyz, target.xyz, gap)
    if not (near.any() and len(places)):
        boxes = [bounds(xyz[:, :2]) for xyz in (asked.xyz, target.xyz)]
        places_of = [
            f"{name} (x {low[0]:.1f} to {high[0]:.1f}, y {low[1]:.1f} to {high[1]:.1f})"
            for name, (low, high) in zip((survey.name, target.name), boxes, strict=True)
        ]
        raise GeometryError(
            "reference.no_overlap",
            f"{' and '.join(places_of)} do not overlap in plan. Check the CRS of both.",
            cloud=survey.name, reference=target.name, bounds=boxes,
        )  # fmt: skip
    outside = len(target.xyz) - len(places) if target.sparse else int((chosen & ~near).sum())
    found = Match(
        survey, asked, survey.take(near), subset(near, wet), target, places, outside, not_submerged,
        settings,
    )  # fmt: skip
    surface = found.water_at(places[:, :2]) if by_place and settings.submerged else None
    if surface is None:
        return found
    # without the places of the reference above the water
    under = mapped(lambda xyz, water: xyz[:, 2] < water, places, surface)
    if not under.any():
        sentence = (
            f"{target.name}: none of its points near the cloud is under water. Check the water"
            " level, or omit --submerged."
        )
        raise GeometryError("reference.not_submerged", sentence, path=target.name)
    dry = int((~under).sum()) if target.sparse else 0
    return replace(found, places=subset(under, places), not_submerged=not_submerged + dry)


def gap_m(xyz: FloatArray) -> float:
    """Return up to which distance outside a cloud, (n, 3), points count by default, metres."""
    return max(5.0 * mean_spacing_m(xyz), 1.0)


def mean_spacing_m(xyz: FloatArray) -> float:
    """Return the mean spacing of points (n, 3) within their bounding box in plan, metres."""
    low, high = bounds(xyz[:, :2])
    extent = high - low
    if extent.min() <= 0.0:
        return float(extent.max() / len(xyz))
    return float(np.sqrt(extent.prod() / len(xyz)))


def near_in_plan(xy: FloatArray, other_xy: FloatArray, limit_m: float) -> BoolArray:
    """Return which points have a point of the other cloud near them in plan.

    The plan is cut into squares of side `limit_m`; a point, (n, 2) or (n, 3) in metres, counts if
    its own square or one of the eight around it holds a point of the other cloud, (m, 2 or 3). So
    all within the limit count, and none beyond 2.83 times the limit.
    """
    low, high = bounds(other_xy[:, :2])
    size = ((high - low) / limit_m).astype(np.int64) + 8
    low = low - 2.0 * limit_m

    def squares(some: FloatArray) -> IntArray:
        # points beyond fall into the outermost squares, which are near to none
        column, row = (
            np.clip((some[:, axis] - low[axis]) / limit_m + 1.0, 0, size[axis] - 1).astype(np.int64)
            for axis in (0, 1)
        )
        return np.asarray(row * size[0] + column)

    held = distinct(np.hstack([distinct(squares(other_xy[b])) for b in blocks(len(other_xy))]))
    steps = np.array([-1, 0, 1])
    near = distinct(held[:, None, None] + steps[:, None] * size[0] + steps)
    return mapped(lambda some: np.isin(squares(some), near), xy)


def heights_at(xy: FloatArray, surface: FloatArray, neighbours: int) -> FloatArray:
    """Return the height of a surface at places in plan, (n, 2) or (n, 3).

    At each place a plane is fitted by least squares in Z to the `neighbours` points of the surface,
    (m, 3), that are nearest in plan, and evaluated; metres, world frame. If these points are on a
    line, or the place is far outside them, the height of the nearest is used.
    """
    height = empty((len(xy),))
    for rows, here, near in nearest_of(xy, surface, neighbours):
        near[:, :, :2] -= here[:, np.newaxis, :2]
        middle = near.mean(axis=1)
        u, v, z = np.moveaxis(near - middle[:, np.newaxis], 2, 0)
        uu, uv, vv = (u * u).mean(axis=1), (u * v).mean(axis=1), (v * v).mean(axis=1)
        uz, vz = (u * z).mean(axis=1), (v * z).mean(axis=1)
        determinant, trace = uu * vv - uv * uv, uu + vv
        flat = determinant > 1e-3 * trace * trace  # else the points are on a line
        safe = np.where(flat, determinant, 1.0)
        # normal equations of z = a + slope_u u + slope_v v about the mean
        slope_u, slope_v = (vv * uz - uv * vz) / safe, (uu * vz - uv * uz) / safe
        mu, mv = middle[:, 0], middle[:, 1]
        # squared distance of the place from the mean, in standard deviations (Mahalanobis)
        reach = (vv * mu * mu - 2.0 * uv * mu * mv + uu * mv * mv) / safe
        fitted = flat & (reach <= 3.0**2)
        plane = middle[:, 2] - slope_u * mu - slope_v * mv
        height[rows] = np.where(fitted, plane, near[:, 0, 2])
    return height

"""The calculation over arrays."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from pcfix.adjust.carry import Carrying
from pcfix.errors import SettingError
from pcfix.flow.old_cameras import paired
from pcfix.model import Cameras, Correction, Views, WaterSurface
from pcfix.options import DEFAULT_REFRACTIVE_INDEX, ErrorBudget, Settings
from pcfix.refract.batch import Batch, MadeWith, Survey
from pcfix.refract.learning import learn_of_points
from pcfix.refract.methods import correct, shift_of_land
from pcfix.water.checks import as_surface, check_above_water, checked_points
from pcfix.water.surface import SurfaceAbove, is_submerged, surface_above

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy.typing as npt

    from pcfix.model import BoolArray, FloatArray
    from pcfix.options import CameraSet, MatcherKind, Method, Occlusion
    from pcfix.refract.regression import DepthRegression

    Label: TypeAlias = Callable[[FloatArray, SurfaceAbove], BoolArray]


CHUNK_POINTS = 1_000_000
"""Points that are worked on at a time, which bounds the memory."""


def correct_points(
    xyz: npt.ArrayLike,
    cameras: Cameras,
    water: WaterSurface | float | npt.ArrayLike,
    *,
    refractive_index: float = DEFAULT_REFRACTIVE_INDEX,
    max_angle_deg: float | None = None,
    max_cameras: int | None = None,
    method: Method = "snell",
    camera_set: CameraSet = "auto",
    matcher: MatcherKind = "depth-maps",
    occlusion: Occlusion = "off",
    depth_factor: float | None = None,
    regression: DepthRegression | None = None,
    errors: ErrorBudget | None = None,
    views: Views | None = None,
    may_be_submerged: npt.ArrayLike | None = None,
    level_offset_m: npt.ArrayLike | None = None,
    adjusted_from: Cameras | None = None,
) -> Correction:
    """Correct apparent points for refraction at the water surface.

    Parameters
    ----------
    xyz : array, shape (n, 3)
        Points as the SfM software placed them, metres, world frame. Those below the water
        surface are moved, the others come back bit for bit.
    cameras : Cameras
        Poses in the same frame; see `pcfix.read_cameras`.
    water : WaterSurface, float, or array of shape (n,)
        The water surface (see `pcfix.read_water`), its level in metres, or its height above
        each point, NaN where it is not known.
    refractive_index : float, default 1.34
        Water relative to air, 1.0 to 1.5.
    max_angle_deg : float, optional
        Use only rays with at most this incidence angle in air, from the surface normal.
        Default: no limit where cameras have angles, 80 degrees where they have none.
    max_cameras : int, optional
        Use at most so many rays a point, the steepest ones.
    method : Method, default "snell"
        How the true point follows from the apparent one; see `pcfix.refract.methods`.
    camera_set : {"auto", "mvs", "all"}
        Without `views`: those of a model of dense matching (see `pcfix.refract.matcher`), or every
        camera whose frame holds the point; auto: the model with the method consistent, else all.
    matcher : {"depth-maps", "pairs"}
        What that model makes a point of: fused depth maps, or the median of stereo pairs.
    occlusion : {"off", "on", "auto"}
        Leave out cameras to which these points themselves hide one; auto: where the block has
        obliques.
    depth_factor : float, optional
        With the method factor: true by apparent depth. Default: the refractive index.
    regression : DepthRegression, optional
        With the method regression; see `pcfix.refract.regression`.
    errors : ErrorBudget, optional
        From which the standard errors follow. Default: `pcfix.ErrorBudget` as it is.
    views : Views, optional
        Which cameras made each point, rows of `adjusted_from` where that is given, else of
        `cameras`. Default: as `camera_set` says.
    may_be_submerged : array of bool, shape (n,), optional
        The other points are land, even below the surface; `pcfix.flow.label.label_points` finds
        them. Default: all.
    level_offset_m : array, shape (k,), optional
        How much higher than `water` the surface stood when each camera took its image, as
        `pcfix.io.tides.level_offsets` finds it. Each ray bends at its own surface; which points
        are submerged, and how deep, goes by `water`. Default: zero.
    adjusted_from : Cameras, optional
        Those that the points were made with, in the same frame, where `cameras` are the same
        images (matched by their labels) adjusted since. All points, land too, are first taken
        from those to these; see `pcfix.adjust.carry`.

    Returns
    -------
    Correction
        One row per input point, in the same order.

    Raises
    ------
    SettingError
        If an argument is outside its rule, or a coordinate is not finite.
    GeometryError
        If a camera stands under the water.

    Notes
    -----
    With the method snell, for each camera the line from the projection centre to the apparent
    point is bent where it pierces the surface (Snell in vector form, Skarlatos & Agrafiotis
    2018, eq 10); the true point is the one nearest to all bent rays in the sense of least squares
    (eq 11, for any
    number of rays). Nothing is iterated and no sum depends on the number of threads.

    Examples
    --------
    Two cameras 100 m above a bed that looks 2 m deep:

    >>> import numpy as np, pcfix
    >>> cameras = pcfix.Cameras(("a", "b"), np.array([[-20.0, 0, 100], [20.0, 0, 100]]))
    >>> result = pcfix.correct_points([[0.0, 0.0, -2.0]], cameras, 0.0)
    >>> result.xyz.round(3).tolist()
    [[0.0, 0.0, -2.703]]
    """
    points = checked_points(xyz)
    settings = Settings(
        refractive_index, max_angle_deg, max_cameras, method=method, camera_set=camera_set,
        occlusion=occlusion, depth_factor=depth_factor, errors=errors or ErrorBudget(),
        matcher=matcher,
    )  # fmt: skip
    surface, dimension = as_surface(water, len(points))
    offset = None if level_offset_m is None else _offsets(level_offset_m, len(cameras))
    check_above_water(cameras, surface, offset)
    if views is not None:
        _check_views(views, len(points), len(adjusted_from or cameras))
    label = None if may_be_submerged is None else _only(may_be_submerged, len(points))
    step, made_with = None, None
    if adjusted_from is not None:
        pair = paired(adjusted_from, cameras)
        step = Carrying(pair).step(points, views)
        made_with = MadeWith(points, pair.old)
        points, views, label = step.xyz, step.views, step.rule(label)
    above = surface_above(surface, points, dimension)
    batch = Batch(points, above, Survey(surface, cameras, settings, offset), views, made_with)
    learned = learn_of_points(batch, regression)
    batch = replace(batch, survey=replace(batch.survey, learned=learned))
    found = correct_checked(batch, label)
    return found if step is None else step.whole(found)


def _offsets(level_offset_m: npt.ArrayLike, k: int) -> FloatArray:
    offset = np.ascontiguousarray(level_offset_m, dtype=np.float64)
    if offset.shape != (k,) or not np.isfinite(offset).all():
        raise SettingError(
            f"level_offset_m must be {k} finite numbers, one per camera, not of shape"
            f" {offset.shape}."
        )
    return offset


def _only(may_be_submerged: npt.ArrayLike, n: int) -> Label:
    """Return the rule that of the points below the surface some are land."""
    allowed = np.asarray(may_be_submerged)
    if allowed.shape != (n,) or allowed.dtype != np.bool_:
        raise SettingError(
            f"may_be_submerged must be {n} booleans, not {allowed.dtype} of shape {allowed.shape}."
        )
    return lambda xyz, surface: is_submerged(xyz[:, 2], surface) & allowed


def _check_views(views: Views, n: int, k: int) -> None:
    if len(views.start) != n + 1 or views.start[0] != 0 or views.start[-1] != len(views.camera):
        raise SettingError(f"views must have {n + 1} starts, from 0 to the number of entries.")
    if (np.diff(views.start) < 0).any():
        raise SettingError("views: the starts must not decrease.")
    if len(views.camera) and not 0 <= views.camera.min() <= views.camera.max() < k:
        raise SettingError(f"views name camera {views.camera.max()}, but there are {k}.")


def correct_checked(
    batch: Batch,
    label: Label | None = None,
    level_sigma_m: Callable[[FloatArray], FloatArray | None] | None = None,
) -> Correction:
    """Label, refract, and spread the result over all rows: what every door runs.

    Parameters
    ----------
    batch : Batch
        Of n points, land too.
    label : callable, optional
        Says which are submerged. Default: those below the surface.
    level_sigma_m : callable, optional
        Returns the standard deviation of the water's height at places, shape (m, 2).
    """
    xyz, surface = batch.xyz, batch.surface
    submerged = is_submerged(xyz[:, 2], surface) if label is None else label(xyz, surface)
    rows = np.flatnonzero(submerged)
    wet = batch.take(rows)
    if level_sigma_m is not None:
        wet = replace(wet, level_sigma_m=level_sigma_m(wet.xyz[:, :2]))
    above, found = wet.surface, correct(wet)
    shift_x, shift_y, shift_z = found.shift_m.T
    rise = above.slope[:, 0] * shift_x + above.slope[:, 1] * shift_y

    def spread(values: npt.NDArray[Any]) -> Any:
        full = np.zeros((len(xyz), *values.shape[1:]), values.dtype)
        full[rows] = values
        return full

    known = np.isfinite(surface.height_m)
    return Correction(
        apparent_xyz=xyz,
        shift_m=spread(found.shift_m) + _land_shift(batch, submerged),
        outcome=spread(found.outcome),
        ray_count=spread(found.ray_count),
        ray_miss_m=spread(found.ray_miss_m),
        depth_m=spread(above.height_m + rise - (xyz[rows, 2] + shift_z)),
        incidence_deg=spread(found.incidence_deg),
        sigma_z_m=spread(found.sigma_z_m),
        camera_used=found.camera_used,
        water_known=known,
        covariance_m2=None if found.covariance_m2 is None else spread(found.covariance_m2),
        lowest_water_m=float(surface.height_m[known].min()) if known.any() else np.inf,
    )


def _land_shift(batch: Batch, submerged: BoolArray) -> FloatArray | float:
    """Return the shift of points made with other cameras, shape (n, 3), zero where submerged."""
    if batch.made_with is None:
        return 0.0
    shift = np.zeros((len(batch), 3))
    rows = np.flatnonzero(~submerged)
    shift[rows] = shift_of_land(batch.take(rows))
    return shift

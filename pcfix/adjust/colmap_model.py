"""A block as a reconstruction of pycolmap, adjusted there, and read back.

Everything is relative to the origin of the block. Cameras, images and points are numbered from 1.
COLMAP gives every image point the same weight, so priors are scaled to the standard deviation of
the image points instead.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from pcfix.adjust.colmap_lens import lens_of, with_values
from pcfix.adjust.normal import CAUCHY, HUBER
from pcfix.adjust.solve import gnss_weights
from pcfix.errors import GeometryError, SettingError
from pcfix.lens.imaging import lens_table

if TYPE_CHECKING:
    from pcfix.adjust.colmap_lens import Flags
    from pcfix.adjust.normal import Loss
    from pcfix.adjust.solve import Problem
    from pcfix.adjust.state import State
    from pcfix.io.cameras.colmap.models import Camera
    from pcfix.model import BoolArray, FloatArray, IntArray, Lens

MOST_STEPS = 100
ANYWHERE_M = 1e6
"""How far GNSS positions may be off when COLMAP first moves the model onto them: anything."""


class Plan(NamedTuple):
    """How a block goes to COLMAP.

    cameras : COLMAP's, one per distinct lens; is_free : whether each one moves.
    flags : of the lenses that move.
    sigma_px : of the image points.
    held : shape (m,), points that stay; fixed : shape (k,), images that stay.
    has_priors : whether GNSS positions make the datum.
    """

    cameras: list[Camera]
    is_free: list[bool]
    flags: Flags
    sigma_px: float
    held: BoolArray
    fixed: BoolArray
    has_priors: bool


def load_pycolmap() -> Any:
    """Import pycolmap.

    Raises
    ------
    SettingError
        If it is not installed or too old; the message names the extra.
    """
    try:
        module = import_module("pycolmap")
    except ImportError as error:
        raise SettingError(
            "COLMAP's engine needs pycolmap, which is not installed; run:"
            " pip install 'pcfix[adjust]'."
        ) from error
    if not hasattr(module, "create_pose_prior_ceres_bundle_adjuster"):
        raise SettingError(
            f"COLMAP's engine needs a newer pycolmap than {getattr(module, '__version__', 'this')};"
            " run: pip install --upgrade 'pcfix[adjust]'."
        )
    return module


def adjusted(
    problem: Problem, plan: Plan, state: State, lenses: tuple[Lens, ...], places: FloatArray,
    loss: Loss, tolerance: float,
) -> tuple[State, tuple[Lens, ...]]:  # fmt: skip
    """Adjust a block in COLMAP, with straight rays.

    Parameters
    ----------
    problem, plan
    state : State
        The start.
    lenses : tuple of Lens, length k
    places : array, shape (o, 2)
        Image points as straight rays would have made them, px; NaN where they do not count.
    loss : Loss
        Its scale in standard deviations.
    tolerance : float
        Relative change of the cost at which COLMAP stops.

    Returns
    -------
    state, lenses

    Raises
    ------
    GeometryError
        If COLMAP finds no solution.
    """
    colmap = load_pycolmap()
    model = _reconstruction(colmap, problem, plan, state, lenses, places)
    options = _options(colmap, plan, loss, tolerance)
    config = _config(colmap, plan, model)
    if plan.has_priors:
        priors = _priors(colmap, problem, plan, model)
        how = colmap.PosePriorBundleAdjustmentOptions()
        how.alignment_ransac.max_error = ANYWHERE_M  # all of them, by least squares
        how.alignment_ransac.random_seed = 0
        engine = colmap.create_pose_prior_bundle_adjuster(options, how, config, priors, model)
    else:
        engine = colmap.create_default_bundle_adjuster(options, config, model)
    summary = engine.solve()
    if not summary.is_solution_usable():
        raise GeometryError(
            "COLMAP's adjustment found no solution: " + str(summary.brief_report()).strip()
        )
    return _read_back(plan, model, state, lenses)


def _reconstruction(
    colmap: Any, problem: Problem, plan: Plan, state: State, lenses: tuple[Lens, ...],
    places: FloatArray,
) -> Any:  # fmt: skip
    seen, model = problem.seen, colmap.Reconstruction()
    number = {lens: i + 1 for i, lens in enumerate(dict.fromkeys(lenses))}
    for lens, i in number.items():
        camera = with_values(plan.cameras[i - 1], lens)
        model.add_camera_with_trivial_rig(
            colmap.Camera(
                camera_id=i, model=camera.model.name, width=int(camera.width),
                height=int(camera.height), params=list(camera.values),
            )
        )  # fmt: skip
    counts = (seen.weight > 0.0) & np.isfinite(places).all(axis=1)
    order = np.argsort(seen.camera, kind="stable")
    order = order[counts[order]]
    ends = np.searchsorted(seen.camera[order], np.arange(len(lenses) + 1))
    centres = _start_centres(problem, plan, state)
    turns = Rotation.from_matrix(state.rotations)
    quaternions, shifts = turns.as_quat(), -turns.apply(centres)
    within = np.full(len(places), -1, np.int64)
    for i, lens in enumerate(lenses):
        rows = order[ends[i] : ends[i + 1]]
        within[rows] = np.arange(len(rows))
        pose = colmap.Rigid3d(colmap.Rotation3d(quaternions[i]), shifts[i])
        model.add_image_with_trivial_frame(
            colmap.Image(
                name=f"{i + 1}", keypoints=places[rows], camera_id=number[lens], image_id=i + 1
            ),
            pose,
        )
    _add_points(colmap, problem, plan, state, model, within)
    return model


def _start_centres(problem: Problem, plan: Plan, state: State) -> FloatArray:
    """Return where the projection centres start.

    COLMAP first moves, turns and scales the whole model onto the GNSS positions, points and images
    that are to stay included. Where there are such, the images start at their GNSS positions, so
    that this changes nothing.
    """
    if not plan.has_priors or not (plan.held.any() or plan.fixed.any()):
        return state.centres
    known = gnss_weights(problem.block).all(axis=1)
    there = problem.block.gnss_xyz - problem.origin
    return np.where((known & ~plan.fixed)[:, None], there, state.centres)


def _add_points(
    colmap: Any, problem: Problem, plan: Plan, state: State, model: Any, within: IntArray
) -> None:
    """Add the points that two images or more show, and control points that one does."""
    start, camera, element = problem.seen.start, problem.seen.camera.tolist(), colmap.TrackElement
    where, bounds = within.tolist(), start.tolist()
    used = np.add.reduceat(np.append(within >= 0, False), start[:-1]) * (np.diff(start) > 0)
    kept = np.flatnonzero((used >= 2) | (plan.held & (used >= 1)))
    xyz = np.where(plan.held[:, None], problem.block.surveyed_xyz - problem.origin, state.xyz)
    for p in kept.tolist():
        track = [
            element(camera[o] + 1, where[o])
            for o in range(bounds[p], bounds[p + 1])
            if where[o] >= 0
        ]
        point = colmap.Point3D(xyz=xyz[p], track=colmap.Track(track))
        model.add_point3D_with_id(p + 1, point)


def _options(colmap: Any, plan: Plan, loss: Loss, tolerance: float) -> Any:
    kinds = {HUBER: colmap.LossFunctionType.HUBER, CAUCHY: colmap.LossFunctionType.CAUCHY}
    options = colmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = plan.flags.focal
    options.refine_principal_point = plan.flags.principal
    options.refine_extra_params = plan.flags.extra
    options.ceres.loss_function_type = kinds.get(loss.kind, colmap.LossFunctionType.TRIVIAL)
    options.ceres.loss_function_scale = loss.scale * plan.sigma_px
    solver = options.ceres.solver_options
    solver.function_tolerance = tolerance
    solver.gradient_tolerance = 0.0
    solver.parameter_tolerance = 0.0
    solver.max_num_iterations = MOST_STEPS
    return options


def _config(colmap: Any, plan: Plan, model: Any) -> Any:
    config = colmap.BundleAdjustmentConfig()
    for image in model.images:
        config.add_image(image)
    for p in np.flatnonzero(plan.held).tolist():
        if model.exists_point3D(p + 1):
            config.add_constant_point(p + 1)
    for i in np.flatnonzero(plan.fixed).tolist():
        config.set_constant_rig_from_world_pose(i + 1)
    for i, is_free in enumerate(plan.is_free, start=1):
        if not is_free:
            config.set_constant_cam_intrinsics(i)
    if not (plan.has_priors or plan.held.any() or plan.fixed.any()):
        config.fix_gauge(colmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    return config


def _priors(colmap: Any, problem: Problem, plan: Plan, model: Any) -> list[Any]:
    """Return the GNSS positions of images that move, as for image points of unit weight."""
    weight = gnss_weights(problem.block)
    priors = []
    for i in np.flatnonzero((weight > 0.0).all(axis=1) & ~plan.fixed).tolist():
        prior = colmap.PosePrior()
        prior.corr_data_id = model.image(i + 1).data_id
        prior.position = problem.block.gnss_xyz[i] - problem.origin
        prior.position_covariance = np.diag(1.0 / (weight[i] * plan.sigma_px**2))
        prior.coordinate_system = colmap.PosePriorCoordinateSystem.CARTESIAN
        priors.append(prior)
    return priors


def _read_back(
    plan: Plan, model: Any, state: State, lenses: tuple[Lens, ...]
) -> tuple[State, tuple[Lens, ...]]:
    poses = [model.image(i + 1).cam_from_world() for i in range(len(lenses))]
    rotations = Rotation.from_quat([pose.rotation.quat for pose in poses])
    shifts = np.array([pose.translation for pose in poses])
    xyz = state.xyz.copy()
    for identifier, point in model.points3D.items():
        xyz[identifier - 1] = point.xyz
    now = {}
    for i, before in enumerate(dict.fromkeys(lenses)):
        values = tuple(float(value) for value in model.camera(i + 1).params)
        moved = plan.cameras[i]._replace(values=values)
        now[before] = lens_of(moved, before) if plan.is_free[i] else before
    made = tuple(now[lens] for lens in lenses)
    return state._replace(
        centres=-rotations.inv().apply(shifts),
        rotations=np.ascontiguousarray(rotations.as_matrix()),
        lenses=np.ascontiguousarray(lens_table(made)[1]),
        xyz=xyz,
    ), made

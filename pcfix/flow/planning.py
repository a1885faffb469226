"""Make the plan of a correction: read and check its inputs, then learn what the cloud shows.

`read_inputs` estimates nothing; `plan_correction` resolves every ``auto``.
"""

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from pcfix.adjust.transfer import renumbered
from pcfix.errors import GeometryError, InputError, PcfixWarning, SettingError, bad_file, coded
from pcfix.flow.correction import Plan, batch_of, transferred
from pcfix.flow.inputs import CameraInputs, Inputs, both_models, labelling_of, read_blocks
from pcfix.flow.poses import SAMPLE_POINTS, pose_errors, with_poses
from pcfix.flow.surfaces import CloudView, Points, own_water_of, parts_of, sample_of
from pcfix.io.files import find_members
from pcfix.io.las.source import CHUNK_POINTS
from pcfix.io.tables import read_check_depths
from pcfix.model import NOISE_CLASSES, Cameras, WaterPlane
from pcfix.options.correct import CorrectOptions, ScienceOptions
from pcfix.options.declare import File
from pcfix.points.labelling import Labelling, Part
from pcfix.refract import learning
from pcfix.refract.batch import Batch, Learned, Survey, require_orientation, stacked
from pcfix.refract.occlusion import Occluder, OccluderBuilder, wants_occlusion
from pcfix.refract.patches import PATCH_WIDTH, Squares
from pcfix.refract.reconstructions import hint_of
from pcfix.refract.regression import LEAST_COUNT, DepthRegression, apparent_depths, fit_depths
from pcfix.water.checks import check_above_water, check_tilt
from pcfix.water.fit import FEWEST
from pcfix.water.index import with_index
from pcfix.water.surface import FoundSurface, surface_above

HEIGHT_M = 100.0  # flying height if the water below the cameras is unknown, for the width of cells
BED_POINTS_A_M2 = 5.0
# Size of the sample of the cloud that the bed of the surroundings is estimated from.
FEWEST_BED_POINTS, MOST_BED_POINTS = 125_000, 1_000_000
LEAST_R2 = 0.5  # smallest coefficient of determination of a regression that is used


def read_inputs(options: CorrectOptions, view: CloudView) -> Plan:
    """Read the inputs of a correction and check them against each other; estimate nothing."""
    options = with_index(options)
    inputs = options.part(Inputs)
    if inputs.port is not None:  # without a water surface
        for name, allowed in (
            ("camera_set", ("auto", "all")), ("occlusion", ("auto", "off")),
            ("method", ("auto", "consistent")),
        ):  # fmt: skip
            if (value := getattr(options, name)) not in allowed:
                sentence = f"{name.replace('_', '-')} {value} has no effect with a port. Omit it;"
                sentence += " the method is consistent."
                raise SettingError("port.excludes", sentence, option=name)
    elif not options.cameras:
        options.check_no_cameras()
    blocks = read_blocks(inputs, view)
    if inputs.port is not None:
        require_orientation(blocks.cameras, "A port")
        found = FoundSurface(WaterPlane(np.inf))  # all points are below it
    else:
        found = inputs.surface(view)
        if blocks.match is None and not isinstance(options.cameras, Cameras):
            # Without angles or lens, visibility is unknown, unless the user gives a method or a
            # limit of the rays. On the sample scene the bed is 0.9 m off with all 40 cameras, and
            # 0.02 m with those in whose frame the points are.
            cameras, is_open = blocks.cameras, options.method == options.max_angle == "auto"
            if is_open and len(cameras) and cameras.lenses is None:
                missing = "angles" if cameras.rotations is None else "lens"
                sentence = f"The cameras have no {missing}, so the images of a point are not known."
                sentence += " Export poses with angles and give the lens (--sensor), or limit the"
                sentence += " rays (--max-angle 35)."
                raise SettingError("cameras.no_frames", sentence, missing=missing)
        blocks = blocks._replace(level_offset_m=inputs.level_offset_m(blocks.cameras))
    plan = plan_of(options, view, blocks, found, labelling_of(options, view))
    check_tilt(found.surface)
    if plan.survey.settings.method == "regression" and inputs.check_depths is None:
        sentence = "Method regression needs check-depths, a CSV of measured depths. Give it."
        raise SettingError("option.together", sentence, options=[])
    return replace(plan, input_notes=(*blocks.cameras.notes, *plan.input_notes))


def plan_of(
    options: CorrectOptions, view: CloudView, blocks: CameraInputs, found: FoundSurface,
    labelling: Labelling, line: DepthRegression | None = None,
) -> Plan:  # fmt: skip
    """Return the plan of a correction with nothing estimated yet.

    The options have a number as refractive index; `line` is that of a regression if it is known.
    """
    cameras, views, match, transfer, offset = blocks
    kind, some_unlisted, inputs = None, False, options.part(Inputs)
    if views is not None:
        kind, start = views.kind, views.start
        some_unlisted = len(start) <= view.points or not bool((np.diff(start) > 0).all())
    if inputs.port is not None:
        settings: ScienceOptions = replace(options, method="consistent")
    else:
        check_above_water(cameras, found.surface, offset)
        is_own = options.water_per_image is not None
        settings = learning.resolved(options, cameras, kind, own_water=is_own)
    own = own_water_of(options.water_per_image, cameras, found.surface, view, offset)
    survey = Survey(found.surface, cameras, settings, offset, Learned(line), own_water=own)
    return Plan(
        options, inputs, view, survey, found, labelling, match, kind, some_unlisted, transfer,
        input_notes=tuple(coded("water.surface", found.notes)),
    )  # fmt: skip


def plan_correction(plan: Plan) -> Plan:
    """Return the plan with everything estimated that points have in common; resolve ``auto``.

    The cloud is read a few times: for the surroundings of labels, the surface that occludes points,
    a sample that shows the reconstruction type, and the points of its view list.
    """
    inputs, view, transfer = plan.inputs, plan.view, plan.transfer
    water, first = plan.found.surface, None
    if plan.kind is not None or transfer is not None:
        # the first points show whether the list is in the order of the cloud, or has coordinates
        first = sample_of(view, np.arange(min(CHUNK_POINTS, view.points)), water)
        if plan.match is not None:
            plan = replace(plan, match=plan.match.with_image_order(first.xyz))
        if transfer is not None:
            transfer.check_models(first.xyz)
    if inputs.port is not None:  # no water surface, and no reconstruction type to detect
        return plan
    parts = parts_of(_all_chunks(plan), water)
    plan = replace(plan, labelling=plan.labelling.scanned(parts, view.low, view.high))
    if inputs.check_depths is not None:
        line = fit_check_depths(inputs.check_depths, parts_of(_all_chunks(plan), water))
        survey = replace(plan.survey, learned=plan.survey.learned._replace(regression=line))
        notes = coded("regression.fit", (line.words, *line.notes))
        plan = replace(plan, survey=survey, notes=tuple(notes))
    plan = _estimated_from_cloud(plan)
    has_line = plan.survey.learned.regression is not None
    if plan.options.dimensions == "all" and len(plan.cameras) and not has_line:
        plan = _with_pose_errors(plan)
    if first is not None and plan.kind is not None:  # the type of the list, by the first points
        points = transferred(plan, first, 0)[0]
        batch = replace(batch_of(points, plan.survey, plan.original), views=points.views)
        # a file of view lists does not state what its images are
        is_open = plan.match is not None and plan.inputs.views_are == "auto"
        is_open = is_open and plan.kind == "depth-maps"
        verdict = learning.weigh_lists(learning.submerged_of(batch), is_open=is_open)
        if verdict is not None:
            kind = verdict.chosen.kind or plan.kind
            survey = learning.with_verdict(plan.survey, verdict)
            plan = replace(plan, survey=survey, kind=kind, verdicts=(verdict,))
    remarks = dict.fromkeys(note for one in plan.verdicts for note in one.warnings())
    return replace(plan, notes=(*plan.notes, *coded("cloud.reconstruction", remarks)))


def fit_check_depths(path: File, parts: Iterable[Part]) -> DepthRegression:
    """Fit true depth = a + b * apparent depth to the check depths of a file.

    The parts are the entire apparent cloud, each point with the water above it; they are read once,
    in bounded memory. Points of noise (classes 7 and 18) do not count.

    The apparent depth at a check depth is the median of the nearest submerged points, 3 to 16,
    within four times the distance between neighbouring points there. Check depths with fewer are
    excluded, with a note.
    """
    checks, notes = read_check_depths(path), list[str]()
    apparent, level, nearest_m, radius = apparent_depths(checks.xy, parts)
    covered = ~np.isnan(apparent)
    if not covered.all():
        first = int(np.argmin(covered))
        notes.append(
            f"{checks.where(first)}: {int((~covered).sum())} of {len(checks)} check depths have no"
            f" bed around them: {FEWEST} submerged points are needed within {radius:.2f} m, the"
            f" nearest is {nearest_m[first]:,.2f} m away. Check that they have the cloud's CRS and"
            " are in the water."
        )
        if covered.sum() < LEAST_COUNT:
            raise GeometryError("check_depths.no_bed", notes[0], covered=int(covered.sum()))
    # heights are subtracted from the water above them
    true = level - checks.value_m if checks.are_heights else checks.value_m
    above = np.flatnonzero(covered & (true < 0.0))
    if len(above):  # heights only: the reader has refused negative depths
        first = int(above[0])
        height_m = float(checks.value_m[first])
        raise GeometryError(
            "check_depths.above_water",
            f"{checks.where(first)}: the height {height_m:.2f} m is above the water,"
            f" {level[first]:.2f} m there ({len(above)} of {int(covered.sum())} are). Give heights"
            " of the bed in the cloud's vertical datum, or depths in a column depth.",
            height_m=height_m,
            count=len(above),
        )
    try:
        found = fit_depths(apparent[covered], true[covered])
    except GeometryError as error:
        raise GeometryError(error.code, f"{checks.name}: {error}", **error.values) from error
    if found.r2 < LEAST_R2:
        raise GeometryError(
            "check_depths.low_r2",
            f"{checks.name}: r2 {found.r2:.3f} of the regression over {found.count} check depths is"
            f" below {LEAST_R2:g}. Check their CRS and the water level.",
            r2=found.r2,
            least=LEAST_R2,
        )
    return replace(found, notes=(*notes, *found.notes))


def _with_pose_errors(plan: Plan) -> Plan:
    """Return the plan with the errors of adjusted poses, if the adjustment left its members.

    A note says if these are damaged, or of other cameras.
    """
    path = plan.inputs.cameras
    try:
        found = None if isinstance(path, Cameras) else find_members(path)
        if found is None:
            return plan
        where, all_members = found
        if (members := all_members.aligned(plan.cameras)) is None:
            sentence = "belongs to other cameras, so SigmaZ does not include errors of the poses."
            sentence += " Use the cameras that the adjustment wrote, or remove the file."
            raise bad_file(where, "cameras.poses", sentence)
    except InputError as error:
        note = PcfixWarning("cameras.poses", error)
        return replace(plan, input_notes=(*plan.input_notes, note))
    rows = np.arange(0, plan.view.points, 1 + plan.view.points // SAMPLE_POINTS)
    sample = sample_of(plan.view, rows, plan.found.surface, plan.match)
    errors = pose_errors(sample, plan.survey, members, plan.transfer)
    return replace(plan, survey=with_poses(plan.survey, errors))


def _all_chunks(plan: Plan) -> Iterator[Points]:
    """Yield the whole cloud, transferred to the adjusted cameras if there are any."""
    row = 0
    for points in plan.view.chunks(plan.found.surface):
        yield points if plan.transfer is None else transferred(plan, points, row)[0]
        row += len(points.xyz)


def _estimated_from_cloud(plan: Plan) -> Plan:
    """Resolve every option that is ``auto``, and estimate what the points have in common."""
    survey, view, some_unlisted = plan.survey, plan.view, plan.some_unlisted
    # listed cameras saw their points, so that nothing occludes them
    may_occlude = plan.kind is None or survey.settings.occlusion != "auto"
    sample, near, occluder = _scanned(
        plan, sample=some_unlisted or learning.wants_sample(survey, plan.kind),
        occluder=may_occlude or some_unlisted,
    )  # fmt: skip
    if may_occlude:
        survey = replace(survey, learned=survey.learned._replace(occluder=occluder))
    if sample is None:
        return replace(plan, survey=survey)
    if plan.transfer is None:
        ties = plan.inputs.tie_points(view.crs)
    elif (ties := both_models(plan.inputs)[0].tie_points(view.crs)) is not None:
        # of the original model, numbered as the cameras of the transfer
        views, entry = renumbered(ties.views, plan.transfer.row)
        ties = replace(ties, views=views, image_xy=ties.image_xy[entry])
    sample, factor = learning.with_factor(replace(sample, survey=survey))
    notes = [*plan.notes, *coded("cloud.depth_factor", [] if factor is None else [factor])]
    hint = hint_of(plan.options.software or view.software)
    if plan.kind is None:
        survey, verdicts = learning.learn_of_sample(sample, ties, hint, near)
        return replace(plan, survey=survey, verdicts=verdicts, notes=tuple(notes))
    survey = learning.with_matcher(sample, ties)
    if some_unlisted:
        # other points get the reconstruction type that is detected, and may be occluded
        given = survey.settings if survey.own_water is not None else plan.options
        if factor is not None:
            given = replace(given, depth_factor=factor.factor)
        settings = learning.resolved(given, plan.cameras, None)
        learned = survey.learned._replace(occluder=occluder)
        bare = replace(sample, survey=replace(survey, settings=settings, learned=learned))
        unlisted, verdicts = learning.learn_of_sample(bare, ties, hint, near)
        survey = replace(survey, unlisted=unlisted)
        words = ["Points missing in the view list are corrected without it.", *map(str, verdicts)]
        notes.append(PcfixWarning("views.unlisted", " ".join(words)))
    return replace(plan, survey=survey, notes=tuple(notes))


def _scanned(
    plan: Plan, *, sample: bool, occluder: bool
) -> tuple[Batch | None, Batch | None, Occluder | None]:
    """Read the whole cloud once, for a sample of it and for the surface that occludes points.

    The sample is evenly spread over the order of the cloud, without noise. If its points may be too
    far apart to detect the reconstruction type, submerged points in squares are returned too.
    """
    view, survey, builder = plan.view, plan.survey, None
    if occluder and view.points and wants_occlusion(survey.cameras, survey.settings):
        builder = OccluderBuilder(view.low, view.high, view.points)
    if not sample and builder is None:
        return None, None, None
    # the bed of depth maps needs about 5 points per square metre, wherever the cloud is denser
    dense = BED_POINTS_A_M2 * float(np.prod(np.fmax(view.high - view.low, 1.0)))
    step = max(1, view.points // int(np.clip(dense, FEWEST_BED_POINTS, MOST_BED_POINTS)))
    near_step = max(1, view.points // int(max(dense, FEWEST_BED_POINTS)))
    squares = None
    if sample and near_step < step:
        # patches for the detection of the type must be as dense as the cloud: take some squares
        centres = survey.cameras.centres
        unknown = np.full(len(centres), np.nan)
        above = centres[:, 2] - surface_above(survey.water, centres, unknown).height_m
        above = above[above > 0.0]
        squares = Squares(PATCH_WIDTH * (float(np.median(above)) if len(above) else HEIGHT_M))

    def every(step: int, row: int, points: Points) -> Batch:
        """Return each point of a chunk whose row in the cloud is a multiple of the step."""
        some = points._replace(views=None).take(slice(-row % step, None, step))
        some = some.take(np.flatnonzero(~np.isin(some.classes, NOISE_CLASSES)))
        return batch_of(some, survey, plan.original)

    taken, row = list[Batch](), 0
    for points in _all_chunks(plan):
        if builder is not None:
            builder.add(points.xyz, points.classes)
        if sample:
            taken.append(every(step, row, points))
        if squares is not None:
            squares.add(learning.submerged_of(every(near_step, row, points)))
        row += len(points.xyz)
    return (
        stacked(taken) if sample else None,
        None if squares is None else squares.all(),
        None if builder is None else builder.build(),
    )

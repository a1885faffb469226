"""The first step of a run: poses that have absorbed the refraction are adjusted before all else."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, get_args

from pcfix.adjust.diagnosis import MOST_STATED_M, Diagnosis
from pcfix.adjust.evidence import Evidence
from pcfix.errors import PcfixError, PcfixWarning, SettingError
from pcfix.flow.adjust import SUMMARY, adjust_into
from pcfix.flow.adjust_job import Survey
from pcfix.flow.diagnosis import diagnose, focal_length_of, given_focal_lengths, has_datum, ties_of
from pcfix.flow.inputs import Inputs
from pcfix.flow.next_steps import MODELS
from pcfix.flow.surfaces import CloudView, view_of
from pcfix.io.files import read_json
from pcfix.io.gnss_positions import read_gnss
from pcfix.io.ground_control import read_ground_control
from pcfix.io.members import FILE as MEMBERS
from pcfix.io.tiles import Clouds, cloud_of
from pcfix.kernels import threads
from pcfix.model import Cameras, WaterDimension, WaterSurface
from pcfix.options.declare import File
from pcfix.options.survey import AdjustRules, AdjustWhen

FOLDER = "adjusted"


class Decision(NamedTuple):
    """Whether a run adjusts, why, whether that is worth a line, and whether the poses are right."""

    adjust: bool
    why: str
    is_said: bool = True
    is_fine: bool = False


def outputs_of(folder: Path) -> list[Path]:
    """Return what an adjustment may leave in the folder of a run, its report first."""
    colmap = [f"colmap/{name}.bin" for name in ("cameras", "images", "points3D")]
    names = ["report.html", SUMMARY, MEMBERS, *colmap, "colmap/georeference.json", *MODELS[1:]]
    return [folder / FOLDER / name for name in names]


@dataclass(frozen=True)
class AdjustStep:
    """What a run is asked of its first step.

    cloud, inputs, index : of the run. gcps, gnss, lens : files that are of use to an adjustment
    only, see `pcfix.adjust_cameras`.
    """

    cloud: Clouds
    inputs: Inputs
    index: float
    when: AdjustWhen = "auto"
    gcps: File | None = None
    gnss: File | None = None
    lens: File | None = None

    def __post_init__(self) -> None:
        """Refuse what does not go with each other."""
        if self.when not in get_args(AdjustWhen):
            names = ", ".join(get_args(AdjustWhen))
            raise SettingError(f"adjust '{self.when}' must be among {names}.")
        if self.when == "no" and self.survey:
            raise SettingError(
                f"{self.survey[0]} is of use to an adjustment only; leave it out, or let --adjust"
                " be auto or yes."
            )
        if self.when == "yes" and self.inputs.cameras is None:
            raise SettingError(
                "adjust yes: there are no cameras to adjust; give them, or leave it."
            )
        if self.when == "yes" and self.unfit:
            raise SettingError(f"adjust yes: {self.unfit}; leave one of the two out.")

    @property
    def survey(self) -> list[str]:
        """The names of the files that were given for an adjustment alone."""
        return [name for name in ("gcps", "gnss", "lens") if getattr(self, name) is not None]

    @property
    def unfit(self) -> str:
        """Why an adjustment does not go with the other options; empty where it does."""
        if self.inputs.cameras is None:
            return "there are no cameras to adjust"
        if self.inputs.adjusted_from is not None:
            return "with adjusted-from the cameras are adjusted already"
        if self.inputs.tide is not None:
            return "a tide gives each image its own water level, and an adjustment takes one"
        return ""


def adjust_first(
    step: AdjustStep, folder: Path, files: list[Path], jobs: int | None = None
) -> dict[str, Any]:
    """Adjust the cameras of a run into its folder where that is asked for, or called for.

    The files are inputs of the run, which the adjustment must not replace.

    Returns
    -------
    dict
        `adjusted`, a bool; `model`, what of the folder of the adjustment has the cameras; `why`;
        `is_said`, whether that is worth a line; `is_fine`, whether the poses are known to be right.

    Raises
    ------
    PcfixError
        If an adjustment was asked for, or files were given for it, and it cannot be done. Else
        the run goes on with the cameras as they are.
    """
    adjusts, why, is_said, is_fine, model = False, "", False, False, None
    try:
        adjusts, why, is_said, is_fine = _decide(step)
        if adjusts:
            model = _adjust(step, folder / FOLDER, files, jobs)
    except PcfixError as error:
        if step.when == "yes" or step.survey:
            raise
        # what cannot be read stops the correction, with the same sentence
        adjusts, why, is_said = False, str(error), adjusts
    return {"adjusted": adjusts, "model": model, "why": why, "is_said": is_said, "is_fine": is_fine}


def is_worth_saying(step: dict[str, Any], absorbed: bool) -> bool:
    """Whether it matters that a run did not adjust: if asked, or if the poses turn out to be bent.

    The step is what `adjust_first` returned; `absorbed` stands in the summary of the correction.
    """
    return step["is_said"] or bool(step["why"] and absorbed)


def _decide(step: AdjustStep) -> Decision:
    """Return whether to adjust: on request, or where the poses are bent and there is a datum."""
    if step.when == "yes":
        return Decision(True, "that was asked for")
    if step.when == "no":
        return Decision(False, "", is_said=False)
    inputs, is_said = step.inputs, bool(step.survey)
    if step.unfit:
        return Decision(False, step.unfit, is_said)
    view = view_of(cloud_of(step.cloud))
    with warnings.catch_warnings():  # the correction shows them
        warnings.simplefilter("ignore", PcfixWarning)
        cameras = inputs.block(view.crs)[0]
        if step.gnss is not None:
            cameras = read_gnss(step.gnss, cameras)
        elif step.gcps is None and not has_datum(cameras, str(inputs.cameras)):
            return Decision(False, _NO_DATUM, is_said)
        water = inputs.surface(view).surface
        if isinstance(water, WaterDimension):
            return Decision(False, f"{water} is known at the points of the cloud alone")
        return _verdict(_diagnosed(step, cameras, water, view))


_NO_DATUM = (
    "nothing says where the block is: no --gcps, no --gnss, and no positions of the GNSS to"
    f" {MOST_STATED_M:g} m in the camera file"
)


def _diagnosed(
    step: AdjustStep, cameras: Cameras, water: WaterSurface, view: CloudView
) -> Diagnosis:
    """Look for signs of absorbed refraction.

    What the result is compared with is none of them: the cloud must not depend on it.
    """
    lens, model = step.lens, str(step.inputs.cameras)
    evidence = Evidence(
        cameras, model, water, step.index, view=view,
        control=None if step.gcps is None else read_ground_control(step.gcps, cameras).surveyed,
        calibrated=given_focal_lengths(model) if lens is None else focal_length_of(lens),
        in_passing=not step.survey,
    )  # fmt: skip
    if evidence.has_rays:
        evidence = replace(evidence, ties=ties_of(step.inputs, view.crs))
    return diagnose(evidence)


def _verdict(found: Diagnosis) -> Decision:
    sign = found.decided_by
    if sign is None:
        why = (
            "nothing tells whether the poses have absorbed the refraction; --adjust yes does it"
            " all the same"
        )
        return Decision(False, why)
    if not sign.speaks:
        shown = sign.plainly if sign.name == "tie points" else sign.words
        why = f"the poses have not absorbed the refraction: {shown}"
        return Decision(False, why, is_fine=True)
    return Decision(True, f"the poses had absorbed the refraction: {sign.plainly or sign.words}")


def _adjust(step: AdjustStep, target: Path, files: Sequence[Path], jobs: int | None) -> str:
    """Adjust, and return which of `MODELS` has the cameras."""
    for path in files:
        if target.resolve() in path.resolve().parents:
            raise SettingError(
                f"{path}: lies in {target}, which the adjustment replaces; give another OUT_DIR."
            )
    survey, rules = Survey(step.gcps, step.gnss, step.lens), AdjustRules(index=step.index)
    with threads(jobs):
        adjust_into(target, step.inputs, survey, rules, step.cloud, overwrite=True)
    return next(name for name in MODELS if (target / name).exists())


def figures_of(folder: Path) -> dict[str, Any]:
    """Return what the adjustment of a run came to, as of `pcfix.report.adjustment`."""
    return dict(read_json(folder / FOLDER / SUMMARY))

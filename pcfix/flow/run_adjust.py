"""The first step of a run: poses that have absorbed the refraction are adjusted."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

from pcfix.adjust.diagnosis import MOST_STATED_M, Evidence
from pcfix.errors import PcfixError, PcfixWarning, SettingError
from pcfix.flow.adjust import SUMMARY, Survey, adjust_into
from pcfix.flow.diagnosis import diagnose, focal_length_of, given_focal_lengths, has_datum, ties_of
from pcfix.flow.inputs import Inputs
from pcfix.flow.next_steps import MODELS
from pcfix.flow.surfaces import view_of
from pcfix.io.files import read_json
from pcfix.io.gnss_positions import read_gnss
from pcfix.io.ground_control import read_ground_control
from pcfix.io.members import FILE as MEMBERS
from pcfix.io.tiles import Clouds, cloud_of
from pcfix.kernels import threads
from pcfix.model import WaterDimension
from pcfix.options.declare import File
from pcfix.options.survey import AdjustRules, AdjustWhen

FOLDER = "adjusted"


def outputs_of(folder: Path) -> list[Path]:
    """Return what an adjustment may leave in the folder of a run, its report first."""
    colmap = [f"colmap/{name}.bin" for name in ("cameras", "images", "points3D")]
    names = ["report.html", SUMMARY, MEMBERS, *colmap, "colmap/georeference.json", *MODELS[1:]]
    return [folder / FOLDER / name for name in names]


def figures_of(folder: Path) -> dict[str, Any]:
    """Return the summary of the adjustment of a run, as of `pcfix.adjust.result`."""
    return dict(read_json(folder / FOLDER / SUMMARY))


@dataclass(frozen=True)
class AdjustStep:
    """Settings of the first step of a run.

    cloud, inputs, index : of the run. gcps, gnss, lens : files that only an adjustment uses, see
    `pcfix.adjust_cameras`.
    """

    cloud: Clouds
    inputs: Inputs
    index: float
    when: AdjustWhen = "auto"
    gcps: File | None = None
    gnss: File | None = None
    lens: File | None = None

    def __post_init__(self) -> None:
        """Refuse settings that exclude each other."""
        wrong, code = "", "option.conflict"
        if self.when not in get_args(AdjustWhen):
            code, wrong = "option.choice", f"use {', '.join(get_args(AdjustWhen))}"
        elif self.when == "no" and self.survey:
            wrong = f"{self.survey[0]} is for an adjustment only. Remove it, or use auto or yes"
        elif self.when == "yes" and self.unfit:
            wrong = f"{self.unfit}. Remove one of the two options"
        if wrong:
            raise SettingError(
                code, f"--adjust {self.when}: {wrong}.", option="adjust", value=self.when
            )

    @property
    def survey(self) -> list[str]:
        """Names of the files that were given for an adjustment only."""
        return [name for name in ("gcps", "gnss", "lens") if getattr(self, name) is not None]

    @property
    def unfit(self) -> str:
        """Why an adjustment is impossible with the other options; empty if it is possible."""
        if self.inputs.cameras is None:
            return "there are no cameras to adjust"
        if self.inputs.adjusted_from is not None:
            return "with adjusted-from the cameras are adjusted already"
        if self.inputs.tide is not None:
            return "a tide gives each image its own water level, and an adjustment has one"
        return ""


def adjust_first(
    step: AdjustStep, folder: Path, files: list[Path], jobs: int | None = None
) -> dict[str, Any]:
    """Adjust the cameras of a run into its folder if asked, or if they need it.

    The files are inputs of the run, which the adjustment must not replace.

    Returns
    -------
    dict
        `adjusted`, a bool; `model`, what of the folder of the adjustment has the cameras; `why`;
        `is_said`, whether that is worth a line; `is_fine`, whether the poses are known to be right.

    Raises
    ------
    PcfixError
        If an adjustment was asked for, or files were given for it, and it is impossible. Otherwise
        the run continues with the original cameras.
    """
    found = {"adjusted": False, "model": None, "why": "", "is_said": False, "is_fine": False}
    try:
        found |= _decide(step)
        if found["adjusted"]:
            found["model"] = _adjust(step, folder / FOLDER, files, jobs)
    except PcfixError as error:
        if step.when == "yes" or step.survey:
            raise
        # a file that cannot be read will stop the correction, with the same message
        found |= {"adjusted": False, "why": str(error), "is_said": found["adjusted"]}
    return found


def is_worth_saying(step: dict[str, Any], absorbed: bool) -> bool:
    """Return whether to report that a run did not adjust: if asked, or if the poses are bent.

    The step is what `adjust_first` returned; `absorbed` is in the summary of the correction.
    """
    return step["is_said"] or bool(step["why"] and absorbed)


def _decide(step: AdjustStep) -> dict[str, Any]:
    """Decide whether to adjust: on request, or if the poses are bent and there is a datum.

    Signs of absorbed refraction do not include the survey with which the result is compared: the
    cloud must not depend on it.
    """
    inputs, lens, model = step.inputs, step.lens, str(step.inputs.cameras)
    if step.when == "yes":
        return {"adjusted": True, "why": "that was asked for", "is_said": True}
    if step.when == "no":
        return {}
    is_said = bool(step.survey)
    if step.unfit:
        return {"why": step.unfit, "is_said": is_said}
    view = view_of(cloud_of(step.cloud))
    with warnings.catch_warnings():  # the correction shows them
        warnings.simplefilter("ignore", PcfixWarning)
        cameras = inputs.block(view.crs)[0]
        if step.gnss is not None:
            cameras = read_gnss(step.gnss, cameras)
        elif step.gcps is None and not has_datum(cameras, model):
            why = (
                "there is no datum: no --gcps, no --gnss, and no GNSS positions better than"
                f" {MOST_STATED_M:g} m in the camera file"
            )
            return {"why": why, "is_said": is_said}
        water = inputs.surface(view).surface
        if isinstance(water, WaterDimension):
            why = f"the water {water} is known at points of the cloud only"
            return {"why": why, "is_said": True}
        evidence = Evidence(
            cameras, model, water, step.index, view=view,
            control=None if step.gcps is None else read_ground_control(step.gcps, cameras).surveyed,
            calibrated=given_focal_lengths(model) if lens is None else focal_length_of(lens),
            in_passing=not step.survey,
        )  # fmt: skip
        if evidence.has_rays:
            evidence = replace(evidence, ties=ties_of(inputs, view.crs))
        found = diagnose(evidence)
    sign = found.decided_by
    if sign is None:
        why = "nothing shows whether the poses absorbed the refraction; --adjust yes adjusts anyway"
        return {"why": why, "is_said": True}
    did = "absorbed" if sign.speaks else "did not absorb"
    why = f"the poses {did} the refraction: {sign.words}"
    return {"adjusted": sign.speaks, "why": why, "is_said": True, "is_fine": not sign.speaks}


def _adjust(step: AdjustStep, target: Path, files: list[Path], jobs: int | None) -> str:
    """Adjust, and return which of `MODELS` has the cameras."""
    for path in files:
        if target.resolve() in path.resolve().parents:
            raise SettingError(
                "output.is_input",
                f"{path}: lies in {target}, which the adjustment replaces. Give another OUT_DIR.",
                path=path,
            )
    survey, rules = Survey(step.gcps, step.gnss, step.lens), AdjustRules(index=step.index)
    with threads(jobs):
        adjust_into(target, step.inputs, survey, rules, step.cloud, overwrite=True)
    return next(name for name in MODELS if (target / name).exists())

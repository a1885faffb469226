"""The first step of a run: adjust poses that have absorbed refraction."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pcfix.adjust.diagnosis import MOST_STATED_M, Evidence
from pcfix.errors import PcfixError, PcfixWarning, SettingError
from pcfix.flow.adjust import SUMMARY, adjust_into
from pcfix.flow.diagnosis import diagnose, has_datum
from pcfix.flow.inputs import Inputs, ties_of
from pcfix.flow.next_steps import FOLDER, MODELS
from pcfix.flow.surfaces import view_of
from pcfix.io.files import read_json
from pcfix.io.gnss_positions import read_gnss
from pcfix.io.ground_control import read_ground_control
from pcfix.io.members import FILE as MEMBERS
from pcfix.model import WaterDimension
from pcfix.options.survey import AdjustOptions
from pcfix.running import threads
from pcfix.water.index import with_index

if TYPE_CHECKING:
    from pcfix.flow.request import Request


def outputs_of(folder: Path) -> list[Path]:
    """Return the files that an adjustment may leave in the folder of a run, its report first."""
    colmap = [f"colmap/{name}.bin" for name in ("cameras", "images", "points3D")]
    names = ["report.html", SUMMARY, MEMBERS, *colmap, "colmap/georeference.json", *MODELS[1:]]
    return [folder / FOLDER / name for name in names]


def figures_of(folder: Path) -> dict[str, Any]:
    """Return the summary of the adjustment of a run, as of `pcfix.adjust.result`."""
    return dict(read_json(folder / FOLDER / SUMMARY))


def adjust_first(request: Request, folder: Path, files: list[Path]) -> dict[str, Any]:
    """Adjust the cameras of a run into its folder if asked, or if they need it.

    The files are inputs of the run, which the adjustment must not replace.

    Returns
    -------
    dict
        `adjusted`, a bool; `model`, the file or folder with the cameras in that of the adjustment;
        `why`; `is_said`, whether that is worth a line; `is_fine`, whether the poses are known to be
        right.
    """
    found = {"adjusted": False, "model": None, "why": "", "is_said": False, "is_fine": False}
    try:
        found |= _decide(request)
        if found["adjusted"]:
            found["model"] = _adjust(request, folder / FOLDER, files)
    except PcfixError as error:
        if request.adjust == "yes" or request.only_to_adjust:
            raise
        # a file that cannot be read will stop the correction, with the same message
        found |= {"adjusted": False, "why": str(error), "is_said": found["adjusted"]}
    return found


def _decide(request: Request) -> dict[str, Any]:
    """Decide whether to adjust: on request, or if the poses are bent and there is a datum.

    Signs of absorbed refraction do not include the survey with which the result is compared: the
    cloud must not depend on it.
    """
    if request.adjust == "yes":
        return {"adjusted": True, "why": "that was asked for", "is_said": True}
    if request.adjust == "no":
        return {}
    inputs, model = request.part(Inputs), str(request.cameras)
    is_said = bool(request.only_to_adjust)
    if request.why_not_adjust:
        return {"why": request.why_not_adjust, "is_said": is_said}
    view = view_of(request.source)
    # the correction shows the warnings
    with warnings.catch_warnings(action="ignore", category=PcfixWarning):
        cameras = inputs.block(view.crs)[0]
        if request.gnss is not None:
            cameras = read_gnss(request.gnss, cameras)
        elif request.gcps is None and not has_datum(cameras, model):
            why = (
                "there is no datum: no --gcps, no --gnss, and no GNSS positions better than"
                f" {MOST_STATED_M:g} m in the camera file"
            )
            return {"why": why, "is_said": is_said}
        water = inputs.surface(view).surface
        if isinstance(water, WaterDimension):
            why = f"the water {water} is known at points of the cloud only"
            return {"why": why, "is_said": True}
        gcps = None if request.gcps is None else read_ground_control(request.gcps, cameras)
        evidence = Evidence(
            cameras, model, water, with_index(request).refractive_index, view=view,
            control=None if gcps is None else gcps.surveyed,
            in_passing=not is_said, ties=ties_of(inputs, view.crs),
        )  # fmt: skip
        sign = diagnose(evidence).decided_by
    if sign is None:
        why = "nothing shows whether the poses absorbed the refraction; --adjust yes adjusts anyway"
        return {"why": why, "is_said": True}
    did = "absorbed" if sign.speaks else "did not absorb"
    why = f"the poses {did} the refraction: {sign.words}"
    return {"adjusted": sign.speaks, "why": why, "is_said": True, "is_fine": not sign.speaks}


def _adjust(request: Request, target: Path, files: list[Path]) -> str:
    """Adjust, and return which of `MODELS` has the cameras."""
    inside = next((path for path in files if target.resolve() in path.resolve().parents), None)
    if inside is not None:
        raise SettingError(
            "output.is_input",
            f"{inside}: is in {target}, which the adjustment replaces. Give another OUT_DIR.",
            path=inside,
        )
    given = AdjustOptions(
        gcps=request.gcps, gnss=request.gnss, lens=request.lens,
        index=with_index(request).refractive_index, overwrite=True,
    )  # fmt: skip
    with threads(request.jobs):
        adjust_into(target, request.part(Inputs), given, request.source)
    return next(name for name in MODELS if (target / name).exists())

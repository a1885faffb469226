"""Whether the poses of a job have absorbed the refraction: what the signs are looked for in."""

from __future__ import annotations

import shlex
import warnings
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pcfix.adjust.diagnosis import (
    Diagnosis,
    Sign,
    diagnosis_of,
    gnss_is_suspicious,
    gnss_sign,
    tie_point_sign,
)
from pcfix.errors import GeometryError, InputError, PcfixError, PcfixWarning
from pcfix.flow.survey_signs import (
    Evidence,
    focal_of,
    sample_of,
    signs_of_control,
    signs_of_reference,
)
from pcfix.model import Cameras
from pcfix.water.surface import is_submerged, surface_above

if TYPE_CHECKING:
    from pcfix.adjust.mend import Mended
    from pcfix.flow.inputs import Inputs
    from pcfix.flow.surfaces import CloudView
    from pcfix.model import FloatArray, TiePoints, WaterSurface

    AnyPath = str | PathLike[str]

TIE_POINTS, LEAST_TIE_VIEWS = 3000, 3
CLOUD_POINTS, POINTS_PER_IMAGE = 1500, 10
MOST_IMAGES = 600
"""Of which the pattern of absorbed refraction is computed; the cost grows with their cube."""
QUICK_IMAGES, QUICK_BYTES = 200, 25_000_000
"""In passing, where nobody asked: blocks and models that take no more than a second or two."""


def diagnose(evidence: Evidence) -> Diagnosis:
    """Look for every sign that the evidence allows.

    Raises
    ------
    PcfixError
        If the cloud cannot be read.
    """
    signs: list[Sign] = []
    if evidence.has_rays:
        signs += _signs_of_rays(evidence)
    if evidence.calibrated and (found := focal_of(evidence)) is not None:
        signs.append(found)
    if evidence.control is not None:
        signs += signs_of_control(evidence, evidence.control)
    if evidence.reference is not None:
        signs += signs_of_reference(evidence, evidence.reference)
    return diagnosis_of(signs)


def diagnose_in_passing(
    inputs: Inputs, cameras: Cameras, water: WaterSurface, refractive_index: float, view: CloudView
) -> str:
    """Warn, once, if what a correction is made with anyway says that the poses are bent.

    Parameters
    ----------
    inputs : Inputs
    cameras : Cameras
        In the cloud's CRS.
    water : WaterSurface
    refractive_index : float
    view : CloudView

    Returns
    -------
    str
        The warning; empty where there is nothing to say, or no way to know.
    """
    if getattr(inputs, "adjusted_from", None) is not None:
        return ""
    path = None if isinstance(inputs.cameras, Cameras) else inputs.cameras
    evidence = Evidence(
        cameras, str(path or "cameras"), water, refractive_index,
        view=view, in_passing=True,
    )  # fmt: skip
    try:
        if path is not None and _size_of(Path(path)) <= QUICK_BYTES:
            evidence = replace(
                evidence,
                ties=ties_of(inputs, view.crs) if evidence.has_rays else None,
                calibrated=given_focal_lengths(path),
            )
        found = diagnose(evidence)
    except (PcfixError, OSError):  # a look in passing stops no correction
        return ""
    sentence = found.sentence(command_of(inputs, view.name))
    if sentence:
        warnings.warn(sentence, PcfixWarning, stacklevel=3)
    return sentence


def ties_of(inputs: Inputs, crs: Any) -> TiePoints | None:
    """Return the tie points of the camera file in the cloud's CRS, where it has any."""
    with warnings.catch_warnings():  # they were shown when the cameras were read
        warnings.simplefilter("ignore", PcfixWarning)
        return inputs.tie_points(crs)


def _size_of(path: Path) -> int:
    """Return how many bytes a camera file and what lies with it have."""
    folder = path.with_suffix(".files") if path.suffix == ".psx" else path
    if folder.is_dir():
        return sum(one.stat().st_size for one in folder.rglob("*") if one.is_file())
    return path.stat().st_size


def command_of(inputs: Inputs, cloud: str, **more: AnyPath | None) -> str:
    """Return the command that mends the poses."""
    model = "MODEL" if isinstance(inputs.cameras, Cameras) else str(inputs.cameras)
    water = inputs.water if isinstance(inputs.water, str | PathLike | float | int) else "SPEC"
    words = ["pcfix", "adjust", model, "OUT", "--water", f"{water}", "--cloud", cloud]
    given: dict[str, Any] = {
        "sensor": inputs.sensor, "cameras-crs": inputs.cameras_crs, "angles": inputs.angles, **more
    }  # fmt: skip
    if inputs.cameras_offset_m is not None:
        given["cameras-offset"] = ",".join(f"{value:.12g}" for value in inputs.cameras_offset_m)
    for name, value in given.items():
        if value is not None:
            words += [f"--{name}", str(value)]
    return shlex.join(words)


def given_focal_lengths(path: AnyPath) -> dict[str, float]:
    """Return focal length by width of the calibrations that a camera file was given."""
    from pcfix.io.cameras.metashape.sensors import given_lenses

    found = given_lenses(Path(path))
    return {name: lens.focal / lens.width for name, lens in found.items()}


def focal_length_of(path: AnyPath) -> dict[str, float]:
    """Return focal length by width of a calibration file, for any sensor."""
    from pcfix.io.cameras.table import read_sensor

    lens = read_sensor(Path(path))
    return {"": lens.focal / lens.width}


def _signs_of_rays(evidence: Evidence) -> list[Sign]:
    """Look at tie points, and at the GNSS."""
    signs: list[Sign] = []
    apparent: FloatArray | None = None
    ties = None if evidence.ties is None else _some_ties(evidence, evidence.ties)
    if ties is not None:
        signs.append(ties.sign)
        apparent = ties.apparent
    off = _gnss(evidence)
    bent = ties is not None and bool(ties.sign.speaks)
    asked = off.known and not evidence.in_passing
    if not (bent or off.suspicious or asked):
        return signs + ([off.calm] if off.calm is not None else [])
    try:
        mended = _mended(evidence, apparent)
    except GeometryError as error:
        return [*signs, *off.unsure(str(error))]
    if ties is not None and bent:
        signs = [ties.with_size(mended)]
    if off.known:
        signs.append(off.sign(evidence.cameras, mended))
    return signs


class _Ties(NamedTuple):
    """The sign of tie points, what made it, and where straight rays put them."""

    sign: Sign
    made_of: tuple[Any, Any, FloatArray]
    apparent: FloatArray

    def with_size(self, mended: Mended) -> Sign:
        """Return the sign with the size of the error."""
        return tie_point_sign(*self.made_of, mended)


def _some_ties(evidence: Evidence, ties: TiePoints) -> _Ties | None:
    """Intersect some tie points straight and refracted."""
    from pcfix.adjust.intersect import intersect_fixed, plain_block
    from pcfix.adjust.mend import deeper

    seen_by = np.diff(ties.views.start)
    rows = np.flatnonzero((seen_by >= LEAST_TIE_VIEWS) & np.isfinite(ties.xyz).all(axis=1))
    if not len(rows):
        return None
    rows = rows[:: max(1, len(rows) // TIE_POINTS)]
    views = ties.views.take(rows)
    first = np.repeat(ties.views.start[rows] - views.start[:-1], np.diff(views.start))
    image_xy = ties.image_xy[first + np.arange(len(views.camera))]
    dry = np.zeros(len(rows), np.bool_)
    n = evidence.refractive_index
    block = plain_block(
        evidence.cameras, ties.xyz[rows], views.start, views.camera, image_xy, None, n, dry
    )
    straight = intersect_fixed(block)
    above = surface_above(evidence.water, straight.xyz)
    depth = above.height_m - straight.xyz[:, 2]
    wet = is_submerged(straight.xyz[:, 2], above)
    begin = deeper(straight.xyz, above.height_m, wet, n)
    refracted = intersect_fixed(replace(block, xyz=begin, wet=wet, water=evidence.water))
    fits = np.isfinite(straight.squares)
    return _Ties(
        tie_point_sign(straight, refracted, depth), (straight, refracted, depth),
        straight.xyz[fits],
    )  # fmt: skip


class _Gnss(NamedTuple):
    """Adjusted minus GNSS, its stated standard deviation, and whether that is worth a look."""

    off_m: FloatArray
    sigma_m: FloatArray
    suspicious: bool

    @property
    def known(self) -> bool:
        """Whether there are positions enough."""
        return int(np.isfinite(self.off_m).sum()) >= 24

    @property
    def calm(self) -> Sign | None:
        """Say that nothing is to be seen, where there are positions."""
        if not self.known:
            return None
        rms = float(np.sqrt(np.nanmean(self.off_m**2)))
        words = f"centres minus GNSS are {rms:.3f} m rms, without a pattern"
        return Sign("GNSS", words, {"rms_m": rms}, None)

    def unsure(self, why: str) -> list[Sign]:
        """Say that a pattern could not be compared with that of the water."""
        if not self.known:
            return []
        rms = float(np.sqrt(np.nanmean(self.off_m**2)))
        words = f"centres minus GNSS are {rms:.3f} m rms; what made their pattern is open ({why})"
        return [Sign("GNSS", words, {"rms_m": rms}, None)]

    def sign(self, cameras: Cameras, mended: Mended) -> Sign:
        """Look for the pattern that the water would make."""
        from pcfix.adjust.problem import similarity_gradients

        centres = cameras.centres[mended.row]
        return gnss_sign(
            self.off_m[mended.row], self.sigma_m[mended.row],
            similarity_gradients(centres - centres.mean(axis=0)), mended,
            centres - mended.cameras.centres,
        )  # fmt: skip


def _gnss(evidence: Evidence) -> _Gnss:
    from pcfix.adjust.problem import similarity_gradients
    from pcfix.io.gnss_positions import gnss_in_frame_of

    cameras = evidence.cameras
    if cameras.gnss is None:
        nothing = np.full((len(cameras), 3), np.nan)
        return _Gnss(nothing, nothing, suspicious=False)
    try:
        found = gnss_in_frame_of(cameras, evidence.name)
    except InputError:
        nothing = np.full((len(cameras), 3), np.nan)
        return _Gnss(nothing, nothing, suspicious=False)
    off = cameras.centres - found.xyz
    by = similarity_gradients(cameras.centres - cameras.centres.mean(axis=0))
    suspicious = gnss_is_suspicious(cameras.centres, off, found.sigma_m, by)
    return _Gnss(off, found.sigma_m, suspicious)


def _mended(evidence: Evidence, apparent: FloatArray | None) -> Mended:
    """Return the poses as an adjustment with water would have them.

    Raises
    ------
    GeometryError
        If the block is too large, or its points do not determine them.
    """
    from pcfix.adjust.mend import mended

    count, most = len(evidence.cameras), QUICK_IMAGES if evidence.in_passing else MOST_IMAGES
    if count > most:
        raise GeometryError(f"{count} images are more than {most}")
    wanted = max(CLOUD_POINTS, POINTS_PER_IMAGE * count)
    if apparent is None:
        if evidence.view is None:
            raise GeometryError("there is no cloud")
        apparent = sample_of(evidence.view, wanted)
    some = apparent[:: max(1, len(apparent) // wanted)]
    return mended(some, evidence.cameras, evidence.water, evidence.refractive_index)

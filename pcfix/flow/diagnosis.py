"""Whether the poses of a job have absorbed the refraction: what is read to tell."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pcfix.adjust.diagnosis import MOST_STATED_M, Diagnosis
from pcfix.adjust.evidence import Evidence, diagnosed
from pcfix.adjust.gather import Datum
from pcfix.errors import InputError, PcfixError, PcfixWarning
from pcfix.flow.inputs import Inputs
from pcfix.flow.next_steps import adjust_words
from pcfix.flow.surfaces import CloudView
from pcfix.io.cameras.metashape.sensors import given_lenses
from pcfix.io.cameras.table.sensor import read_sensor
from pcfix.io.gnss_positions import gnss_in_frame_of
from pcfix.model import Cameras, TiePoints, WaterSurface
from pcfix.options.declare import File
from pcfix.options.shared import DEFAULT_REFRACTIVE_INDEX

LEAST_POSITIONS = 3
"""Of the GNSS, that say where a block is, how it is turned, and its scale."""

QUICK_BYTES = 25_000_000
"""Of a model, in passing, where nobody asked: it takes no more than a second or two."""


def diagnose(evidence: Evidence) -> Diagnosis:
    """Look for every sign that the evidence allows, the GNSS positions of the cameras included.

    Raises
    ------
    PcfixError
        If the cloud cannot be read.
    """
    if evidence.has_rays and evidence.cameras.gnss is not None:
        try:
            found = gnss_in_frame_of(evidence.cameras, evidence.name)
            evidence = replace(evidence, gnss=Datum(found.xyz, found.sigma_m))
        except InputError:  # then nothing can be said of them
            pass
    return diagnosed(evidence)


def diagnose_in_passing(
    inputs: Inputs, cameras: Cameras, water: WaterSurface, refractive_index: float, view: CloudView
) -> str:
    """Warn, once, if what a correction is made with anyway says that the poses are bent.

    Returns the warning; empty where there is nothing to say, or no way to know. The cameras are in
    the cloud's CRS.
    """
    if inputs.adjusted_from is not None:
        return ""
    path = None if isinstance(inputs.cameras, Cameras) else inputs.cameras
    evidence = Evidence(
        cameras, str(path or "cameras"), water, refractive_index, view=view, in_passing=True
    )
    try:
        if path is not None and _size_of(Path(path)) <= QUICK_BYTES:
            ties = ties_of(inputs, view.crs) if evidence.has_rays else None
            evidence = replace(evidence, ties=ties, calibrated=given_focal_lengths(path))
        found = diagnose(evidence)
    except (PcfixError, OSError):  # a look in passing stops no correction
        return ""
    name = str(path or "cameras")
    index = None if refractive_index == DEFAULT_REFRACTIVE_INDEX else refractive_index
    holds = has_datum(cameras, name)
    command, because = adjust_words(inputs, view.name, has_datum=holds, index=index)
    sentence = found.sentence(command, because)
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


def has_datum(cameras: Cameras, name: str) -> bool:
    """Whether the camera file has positions of the GNSS good enough to hold a block."""
    if cameras.gnss is None:
        return False
    try:
        found = gnss_in_frame_of(cameras, name)
    except InputError:
        return False
    known = np.isfinite(found.xyz).all(axis=1)
    if known.sum() < LEAST_POSITIONS:
        return False
    off = (cameras.centres - found.xyz)[known]
    spread = 1.4826 * np.median(np.abs(off - np.median(off, axis=0)))
    stated = found.sigma_m[known]
    return bool(np.median(np.where(np.isfinite(stated), stated, spread)) <= MOST_STATED_M)


def given_focal_lengths(path: File) -> dict[str, float]:
    """Return focal length by width of the calibrations that a camera file was given."""
    found = given_lenses(Path(path))
    return {name: lens.focal / lens.width for name, lens in found.items()}


def focal_length_of(path: File) -> dict[str, float]:
    """Return focal length by width of a calibration file, for any sensor."""
    lens = read_sensor(Path(path))
    return {"": lens.focal / lens.width}

"""Whether the poses of a job have absorbed the refraction: what is read to tell."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pcfix.adjust.diagnosis import MOST_STATED_M, Diagnosis, neighbours_sign
from pcfix.adjust.evidence import Evidence, diagnosed, export_of
from pcfix.adjust.gather import Datum
from pcfix.errors import InputError, PcfixError, PcfixWarning
from pcfix.flow.inputs import Inputs
from pcfix.flow.next_steps import adjust_words
from pcfix.flow.surfaces import CloudView
from pcfix.io.cameras.metashape.sensors import given_lenses
from pcfix.io.cameras.table.sensor import read_sensor
from pcfix.io.gnss_positions import gnss_in_frame_of
from pcfix.model import Cameras, TiePoints
from pcfix.options.declare import File
from pcfix.options.shared import DEFAULT_REFRACTIVE_INDEX
from pcfix.refract.reconstructions import Verdict

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


class Poses(NamedTuple):
    """What is known of the poses of a correction.

    absorbed : whether they have absorbed the refraction, None where nothing tells; words : that as
    a line of a summary; warning : empty where there is nothing to mend; signs : each in plain
    values.
    """

    absorbed: bool | None
    words: str
    warning: str = ""
    signs: tuple[dict[str, Any], ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return {"absorbed": self.absorbed, "words": self.words, "signs": list(self.signs)}


ADJUSTED = Poses(False, "adjusted with the light bent at the water (--adjusted-from)")


def diagnose_in_passing(
    inputs: Inputs, evidence: Evidence, view: CloudView, verdicts: tuple[Verdict, ...] = ()
) -> Poses:
    """Say what a correction is made with anyway tells of its poses; warn once if they are bent.

    The cameras and `quick_ties` of the evidence are in the cloud's CRS; the verdicts are what the
    cloud was taken for.
    """
    if inputs.adjusted_from is not None:
        return ADJUSTED
    path = None if isinstance(inputs.cameras, Cameras) else inputs.cameras
    told = [(one.straight, one.is_fused) for one in verdicts if one.straight is not None]
    sign = neighbours_sign(*told[-1][0], is_fused=told[-1][1]) if told else None
    evidence, why = replace(evidence, view=view, neighbours=sign, in_passing=True), ""
    try:
        if path is not None and _size_of(Path(path)) > QUICK_BYTES:
            why = f"a file of more than {QUICK_BYTES / 1e6:g} MB is looked at by 'pcfix cameras'"
        elif path is not None:
            ties = evidence.ties if evidence.has_rays else None
            evidence = replace(evidence, ties=ties, calibrated=given_focal_lengths(path))
        found = diagnose(evidence)
    except (PcfixError, OSError) as error:  # a look in passing stops no correction
        return Poses(None, f"not checked for absorbed refraction: {error}")
    n = evidence.refractive_index
    command, because = adjust_words(
        inputs, view.name, has_datum=has_datum(evidence.cameras, evidence.name),
        index=None if n == DEFAULT_REFRACTIVE_INDEX else n,
    )  # fmt: skip
    sentence = found.sentence(command, because)
    if sentence:
        warnings.warn(sentence, PcfixWarning, stacklevel=3)
    signs = tuple(found.as_dict()["signs"])
    return Poses(found.absorbed, _in_short(found, evidence.cameras, why), sentence, signs)


def _in_short(found: Diagnosis, cameras: Cameras, why: str) -> str:
    """Return the line of a summary; `why` says why a file was not looked at."""
    if found.decided_by is not None:
        name = found.decided_by.name
        if found.absorbed:
            return f"absorbed the refraction, by {name}; see the warning"
        return f"did not absorb the refraction, by {name}"
    open_ones = [sign.name for sign in found.signs if sign.name in ("tie points", "GNSS")]
    if not why and open_ones:
        why = f"{' and '.join(open_ones)} of the file tell too little (see 'pcfix cameras')"
    none = "the file has neither tie points nor GNSS; "
    return f"not checked for absorbed refraction: {why or none + export_of(cameras)}"


def ties_of(inputs: Inputs, crs: Any) -> TiePoints | None:
    """Return the tie points of the camera file in the cloud's CRS, where it has any."""
    with warnings.catch_warnings():  # they were shown when the cameras were read
        warnings.simplefilter("ignore", PcfixWarning)
        return inputs.tie_points(crs)


def quick_ties(inputs: Inputs, crs: Any) -> TiePoints | None:
    """Return the tie points of `ties_of` where reading them takes a second or two at most."""
    path = None if isinstance(inputs.cameras, Cameras) else Path(inputs.cameras)
    try:
        return None if path is None or _size_of(path) > QUICK_BYTES else ties_of(inputs, crs)
    except (PcfixError, OSError):  # a look in passing stops no correction
        return None


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

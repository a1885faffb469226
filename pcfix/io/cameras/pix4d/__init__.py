"""Pix4D: the ``params`` folder of a project, one of its files, or the project file itself.

Two tables give the exterior orientation. ``calibrated_camera_parameters.txt`` has for each image
its name and size, the matrix K, the distortion, the projection centre less the offset of
``offset.xyz``, and the rotation world to camera (x right, y down, z forward); pixels start at the
corner of the image, and the tangential coefficients are in OpenCV's order. A fisheye lens has
instead of K and the distortion an affine matrix and a polynomial of 2 theta / pi.
``calibrated_external_camera_parameters.txt`` has absolute centres and omega, phi, kappa of axes
x right, y up, z back: R = diag(1, -1, -1) (Rx(omega) Ry(phi) Rz(kappa))^T. The two agree to
1e-6 m where the offset is right; as an offset can be wrong, the absolute table is believed.

``pix4d_calibrated_internal_camera_parameters.cam`` has the interior orientation in millimetres,
``wkt.prj`` the CRS, and the project file (.p4d) where the GNSS said that the images were taken.
Image measurements are in ``tp_bingo.txt`` (mm from the image centre, y up, the size of the sensor
beside each name) and ``tp_pix4d.txt`` (pixels). ``calibrated_images_position.txt`` and
``pmatrix.txt`` repeat what the tables say.

References: Pix4D, "What does the Output Params Folder contain?" (support.pix4d.com, article
202977149), "How are the Internal and External Camera Parameters defined?" (article 202559089).
"""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras import checks
from pcfix.io.cameras.formats import Source
from pcfix.io.cameras.pix4d import files as project
from pcfix.io.cameras.pix4d import tables
from pcfix.io.cameras.pix4d.files import EXTERNAL, GEOGRAPHIC, PARAMETERS, Files
from pcfix.io.cameras.pix4d.files import read_observations as tie_points
from pcfix.model import Cameras, FloatArray, Lens

__all__ = ["read", "recognises", "tie_points"]

HEADERS = (
    ["filename", "imagewidth", "imageheight"],
    ["imagename", "x", "y", "z", "omega", "phi", "kappa"],
    ["imagename", "longitude", "latitude", "altitude", "omega", "phi", "kappa"],
)


def recognises(source: Source) -> bool:
    """Whether a file begins like one of the tables or a project, or a folder holds a table."""
    if source.path.is_dir():
        return project.holds_tables(source.path)
    return project.is_project(source) or project.first_line(source.text).lower().split() in HEADERS


def read(source: Source) -> Cameras:
    """Read poses and lenses, in the CRS of the project."""
    files = project.find(source)
    if not files.keys() & {"parameters", "external"}:
        raise InputError(
            f"{source.path}: has no {PARAMETERS} or {EXTERNAL} beside it; give the params folder"
            f" of the project ({GEOGRAPHIC} alone does not suffice)."
        )
    calibrations = tables.read_calibrations(files["calibration"]) if "calibration" in files else []
    if "parameters" in files:
        images = tables.read_parameters(files["parameters"])
        poses = _poses(files, images)
        used = [images[row] for row in poses.rows]
        lenses = tables.lenses_of_images(files["parameters"], used, calibrations)
    else:
        poses, lenses = _external_only(files, calibrations)
    labels, posed = tuple(poses.labels), set(poses.labels)
    gnss, others = (
        project.read_project(files["project"], labels) if "project" in files else (None, ())
    )
    wkt = project.read_text(files["wkt"]).strip() if "wkt" in files else ""
    return Cameras(
        labels=labels,
        centres=poses.centres,
        rotations=poses.rotations,
        lenses=lenses,
        crs=checks.crs(files["wkt"], wkt) if wkt else None,
        notes=(*poses.notes, *checks.repeated(source.path, labels)),
        gnss=gnss,
        unposed=tuple(dict.fromkeys(n for n in (*poses.unposed, *others) if n not in posed)),
        source="Pix4D",
    )


AGREE_M = 0.01
AGREE_DEG = 0.001


class Poses(NamedTuple):
    """The posed images: labels, centres, rotations, and their rows in the camera parameters."""

    labels: list[str]
    centres: FloatArray
    rotations: FloatArray
    rows: list[int]
    unposed: list[str]
    notes: tuple[str, ...]


def _external_only(
    files: Files, calibrations: list[tables.Calibration]
) -> tuple[Poses, tuple[Lens, ...] | None]:
    """Return the poses of the absolute table, with a lens where all images must share it."""
    labels, centres, rotations = tables.read_external(files["external"])
    lens = None
    if len(calibrations) == 1:
        lens = tables.lens_of_calibration(files["calibration"], calibrations[0])
    note = (
        f"{files['external']}: there is no {PARAMETERS} beside it that tells the lens of each"
        " image; frames are taken as boundless."
    )
    poses = Poses(labels, centres, rotations, [], [], () if lens else (note,))
    return poses, None if lens is None else (lens,) * len(labels)


def _poses(files: Files, images: list[tables.Image]) -> Poses:
    labels = [image.label for image in images]
    turns = [image.fields["rotation"].reshape(3, 3) for image in images]
    rotations = checks.rotations(files["parameters"], labels, turns)
    centres, notes = _absolute(files, images)
    if "external" not in files:
        return _those_known(labels, centres, rotations, notes)
    names, there, turned = tables.read_external(files["external"])
    row_of = _matched(labels, rotations, names, turned)
    both = [i for i, row in enumerate(row_of) if row is not None]
    rows = [row for row in row_of if row is not None]
    notes = _compared(files["external"], centres[both], rotations[both], there[rows], turned[rows])
    if notes:
        centres = np.full_like(centres, np.nan)
    centres[both], rotations[both] = there[rows], turned[rows]
    poses = _those_known(labels, centres, rotations, notes)
    return poses._replace(unposed=poses.unposed + sorted(set(names) - set(labels)))


def _those_known(
    labels: list[str], centres: FloatArray, rotations: FloatArray, notes: tuple[str, ...]
) -> Poses:
    known = np.isfinite(centres).all(axis=1)
    rows = np.flatnonzero(known).tolist()
    unposed = [labels[i] for i in np.flatnonzero(~known)]
    return Poses([labels[i] for i in rows], centres[known], rotations[known], rows, unposed, notes)


def _absolute(files: Files, images: list[tables.Image]) -> tuple[FloatArray, tuple[str, ...]]:
    """Return the centres with the offset added; NaN where several offsets name no such image."""
    local = np.array([image.fields["centre"] for image in images])
    if "offset" not in files and "external" in files:
        return np.full_like(local, np.nan), ()
    if "offset" not in files:
        note = (
            f"{files['parameters']}: its positions are relative to an offset and there is no"
            " offset.xyz beside it; add the offset to the cameras yourself."
        )
        return local, (note,)
    offsets = tables.read_offsets(files["offset"])
    if len({values.tobytes() for _, values in offsets}) == 1:
        return local + offsets[0][1], ()
    added = np.full_like(local, np.nan)
    for i, image in enumerate(images):
        fitting = [values for label, values in offsets if label and image.label.startswith(label)]
        if fitting:
            added[i] = local[i] + fitting[0]
    return added, ()


def _matched(
    labels: list[str], rotations: FloatArray, names: list[str], turned: FloatArray
) -> list[int | None]:
    """Return the row of each label among the names; of equal names the one turned most alike."""
    rows: dict[str, list[int]] = defaultdict(list)
    for row, name in enumerate(names):
        rows[name].append(row)
    matched: list[int | None] = []
    for label, rotation in zip(labels, rotations, strict=True):
        left = rows[label]
        unlike = np.linalg.norm(turned[left] - rotation, axis=(1, 2))
        matched.append(left.pop(int(np.argmin(unlike))) if left else None)
    return matched


def _compared(
    path: Path, local: FloatArray, rotations: FloatArray, centres: FloatArray, turned: FloatArray
) -> tuple[str, ...]:
    """Return what to tell when the two tables disagree; the first may lack its offset."""
    if len(centres) == 0:
        raise InputError(f"{path}: names none of the images of {PARAMETERS} beside it.")
    distances = np.linalg.norm(local - centres, axis=1)
    apart = float(distances[np.isfinite(distances)].max(initial=0.0))
    sines = np.linalg.norm(rotations - turned, axis=(1, 2)) / np.sqrt(8.0)
    turn = float(np.degrees(2.0 * np.arcsin(np.clip(sines, 0.0, 1.0))).max())
    if apart <= AGREE_M and turn <= AGREE_DEG:
        return ()
    note = (
        f"{path}: its poses differ by up to {apart:.2f} m and {turn:.3f} degrees from those of"
        f" {PARAMETERS} with offset.xyz; the absolute ones are used, and images that only the"
        " other table has are left out."
    )
    return (note,)

"""MicMac: a folder Ori-*/ of Orientation-<image>.xml, or one such file.

`Externe` has the projection centre (`Centre`) and the matrix camera to world as rows L1, L2, L3
(`CodageMatr`); the camera is x right, y down, z forward. The interior orientation is `Interne` in
the same file or another file, `FileInterne`, named from the folder in which MicMac ran; it is
looked for beside the orientation first. `OrIntImaM2C` is an affine map from the camera's pixels
to those of a scaled image. Where MicMac's pixels begin, at the corner or the centre of the first,
its formats do not say; they are taken as they are. The files name no CRS.

Distortion that Brown's model does not hold is replaced by the nearest lens, and the largest
difference is told where it is more than half a pixel.

References: M. Pierrot-Deseilligny and others, "MicMac, Apero, Pastis and other beverages in a
nutshell", https://github.com/micmacIGN/Documentation; include/XML_GEN/ParamChantierPhotogram.xml
of https://github.com/micmacIGN/micmac for the elements.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import PurePosixPath
from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras import checks
from pcfix.io.cameras.micmac.calibration import Calibration, parse
from pcfix.io.cameras.micmac.fit import nearest
from pcfix.io.cameras.xml import numbers, read_xml
from pcfix.model import Cameras, Lens

if TYPE_CHECKING:
    from pathlib import Path
    from xml.etree.ElementTree import Element

    from pcfix.io.cameras.formats import Source
    from pcfix.model import FloatArray

SOFTWARE = "MicMac"
PREFIX, SUFFIX = "Orientation-", ".xml"
TOLD_PX = 0.5

_CONVENTIONS = ("", "eConvApero_DistM2C", "eConvApero_DistC2M")


def recognises(source: Source) -> bool:
    """Whether a folder has orientations by their names, or a file is one."""
    if source.path.is_dir():
        return any(name.startswith(PREFIX) and name.endswith(SUFFIX) for name in source.names)
    return "<OrientationConique" in source.text


def read(source: Source) -> Cameras:
    """Read every orientation of a folder, or the one."""
    paths = [source.path]
    if source.path.is_dir():
        paths = sorted(p for p in source.path.glob(f"{PREFIX}*{SUFFIX}") if p.is_file())
    known: dict[Path, tuple[Lens, str]] = {}
    poses = [_orientation(path, known) for path in paths]
    return Cameras(
        labels=tuple(_image(path) for path in paths),
        centres=np.array([centre for centre, _, _ in poses]),
        rotations=np.array([rotation for _, rotation, _ in poses]),
        lenses=tuple(lens for _, _, lens in poses),
        notes=tuple(note for _, note in known.values() if note),
        source=SOFTWARE,
    )


def _image(path: Path) -> str:
    return path.name.removesuffix(SUFFIX).removeprefix(PREFIX)


def _orientation(
    path: Path, known: dict[Path, tuple[Lens, str]]
) -> tuple[FloatArray, FloatArray, Lens]:
    """Return centre, rotation world to camera, and lens."""
    root = read_xml(path)
    conic = _first(path, root, "OrientationConique")
    projection = conic.findtext("TypeProj", "eProjStenope").strip()
    if projection != "eProjStenope":
        raise InputError(
            f"{path}: image {_image(path)}: the projection {projection} is no camera's."
        )
    centre, rotation = _exterior(path, _first(path, conic, "Externe"))
    return centre, rotation, _scanned(path, conic.find("OrIntImaM2C"), _lens(path, conic, known))


def _exterior(path: Path, outer: Element) -> tuple[FloatArray, FloatArray]:
    image = f"image {_image(path)}"
    convention = outer.findtext("KnownConv", "").strip()
    matrix = outer.find("ParamRotation/CodageMatr")
    if convention not in _CONVENTIONS or matrix is None:
        raise InputError(
            f"{path}: {image}: its rotation is not a matrix in MicMac's own convention"
            f" ({convention or 'no CodageMatr'}); write the orientations anew with OriConvert."
        )
    rows = [numbers(path, f"{image}, {tag}", matrix.findtext(tag), 3) for tag in ("L1", "L2", "L3")]
    centre = numbers(path, f"{image}, Centre", outer.findtext("Centre"), 3)
    return centre, checks.rotation(path, _image(path), np.array(rows)).T


def _lens(path: Path, conic: Element, known: dict[Path, tuple[Lens, str]]) -> Lens:
    """Return the lens inside the file, or that of the file it names."""
    inner = conic.find("Interne")
    where = path if inner is not None else _calibration_file(path, conic)
    if where not in known:
        if inner is None:
            inner = _first(where, read_xml(where), "CalibrationInternConique")
        known[where] = _calibrated(parse(where, inner))
    return known[where][0]


def _calibrated(calibration: Calibration) -> tuple[Lens, str]:
    """Return the lens, and what to tell of it where it is not the calibration itself."""
    if calibration.exact:
        return calibration.brown(), ""
    lens, miss = nearest(calibration)
    if miss < TOLD_PX:
        return lens, ""
    return lens, (
        f"{calibration.path}: the distortion has terms that pcfix does not model; the lens used"
        f" instead is up to {miss:.1f} pixels off in the frame, enough to choose cameras by but not"
        " to adjust with."
    )


def _calibration_file(path: Path, conic: Element) -> Path:
    name = PurePosixPath((conic.findtext("FileInterne") or "").strip().replace("\\", "/"))
    project = path.resolve().parent.parent
    for candidate in (path.parent / name.name, project / name):
        inside = candidate.resolve().is_relative_to(project)
        if name.name and inside and candidate.is_file():
            return candidate
    raise InputError(
        f"{path}: image {_image(path)}: its calibration '{name}' is neither beside it nor in"
        f" {project}; copy it beside the orientation."
    )


def _scanned(path: Path, element: Element | None, lens: Lens) -> Lens:
    """Return the lens of an image that is an affine map of the camera's."""
    if element is None:
        return lens
    where = f"image {_image(path)}"
    origin, along_x, along_y = (
        numbers(path, f"{where}, {tag}", element.findtext(tag), 2) for tag in ("I00", "V10", "V01")
    )
    turn = np.column_stack([along_x, along_y])
    if not origin.any() and (turn == np.eye(2)).all():
        return lens
    inner = turn @ np.array([[lens.focal + lens.b1, lens.b2], [lens.b3, lens.focal]])
    x, y = origin + turn @ np.array([lens.principal_x, lens.principal_y])
    width, height = np.abs(turn) @ np.array([lens.width, lens.height])
    scanned = replace(
        lens,
        focal=float(inner[1, 1]),
        b1=float(inner[0, 0] - inner[1, 1]),
        b2=float(inner[0, 1]),
        b3=float(inner[1, 0]),
        principal_x=float(x),
        principal_y=float(y),
        width=float(width),
        height=float(height),
    )
    return checks.lens(path, f"of {where}", scanned)


def _first(path: Path, root: Element, tag: str) -> Element:
    """Return the element of this name, the root or inside it."""
    found = root if root.tag == tag else root.find(f".//{tag}")
    if found is None:
        raise InputError(f"{path}: has no {tag}; it is cut off or no orientation of MicMac.")
    return found

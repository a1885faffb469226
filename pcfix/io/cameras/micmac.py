"""MicMac: a folder Ori-*/ of Orientation-<image>.xml (MMVII: Ori-PerspCentral-), or one such file.

`Externe` has the projection centre (`Centre`) and the matrix camera to world as rows L1, L2, L3
(`CodageMatr`); the camera is x right, y down, z forward. The interior orientation is `Interne` in
the same file or another file, `FileInterne`, named from the folder in which MicMac ran; it is
looked for beside the orientation first. `OrIntImaM2C` is an affine map from the camera's pixels
to those of a scaled image. Where MicMac's pixels begin, at the corner or the centre of the first,
its formats do not say; they are taken as they are. The files name no CRS.

An ideal position F (x, y) / z + PP, in pixels, goes through the distortion of the calibration to
the observed one (eConvApero_DistM2C), or from the observed to the ideal one (eConvApero_DistC2M).
Read are the formulas that `pcfix.model.Lens` holds exactly, d being the distance from the centre of
distortion: none; radial, d (k1 d^2 + k2 d^4 + ...); and Fraser's with decentring P1 (2 x^2 + d^2) +
2 P2 x y beside it. The affinity b1 x + b2 y of Fraser's is of the ideal place, that of a lens of
the distorted one: it is read where that makes no difference, up to `AFFINITY_PX`. mm3d ConvertCalib
turns any other formula into one of these.

MMVII has the centre (`Center`) and the camera's axes in the world (`AxeI`, `AxeJ`, `AxeK`), the
same matrix by columns, and the calibration in a file beside it. Its distortion is of the ideal
place (X, Y) / Z and leads to the observed one: K1, K2, ... radial, p1 and p2 as P1 and P2 above, b1
and b2 as there; anything beyond is refused.

References: M. Pierrot-Deseilligny and others, "MicMac, Apero, Pastis and other beverages in a
nutshell", https://github.com/micmacIGN/Documentation, "Distortion models" and ConvertCalib;
include/XML_GEN/ParamChantierPhotogram.xml of https://github.com/micmacIGN/micmac for the elements;
MMVII's files write the formula of each coefficient beside it.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path, PurePosixPath
from xml.etree.ElementTree import Element

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras import checks
from pcfix.io.cameras.checks import number, numbers, read_xml
from pcfix.io.cameras.formats import Source
from pcfix.model import Cameras, FloatArray, Lens

PREFIX, PREFIX_2, SUFFIX = "Orientation-", "Ori-PerspCentral-", ".xml"
UNIFIED = ("eModele_DRad_PPaEqPPs", "eModele_Fraser_PPaEqPPs")
"""Of `ModUnif`: radial and Fraser's about the principal point; five k, P1, P2, b1, b2."""
NO_DISTORTION = ("ModNoDist", "eModelePolyDeg0")
AFFINITY_PX = 0.1
"""Largest distance in the frame that a lens with Fraser's affinity may be off."""

_IS_INVERSE = {"": False, "eConvApero_DistM2C": False, "eConvApero_DistC2M": True}


def recognises(source: Source) -> bool:
    """Whether a folder has orientations by their names, or a file is one."""
    if source.path.is_dir():
        begins = (PREFIX, PREFIX_2)
        return any(name.startswith(begins) and name.endswith(SUFFIX) for name in source.names)
    return "<OrientationConique" in source.text or "<NameInternalCalib>" in source.text


def read(source: Source) -> Cameras:
    """Read every orientation of a folder, or the one."""
    paths = [source.path]
    if source.path.is_dir():
        found = [sorted(source.path.glob(f"{one}*{SUFFIX}")) for one in (PREFIX, PREFIX_2)]
        paths = [path for path in found[0] or found[1] if path.is_file()]
    known: dict[Path, Lens] = {}
    poses = [_orientation(path, known) for path in paths]
    return Cameras(
        labels=tuple(_image(path) for path in paths),
        centres=np.array([centre for centre, _, _ in poses]),
        rotations=np.array([rotation for _, rotation, _ in poses]),
        lenses=tuple(lens for _, _, lens in poses),
        source="MicMac",
    )


def _image(path: Path) -> str:
    return path.name.removesuffix(SUFFIX).removeprefix(PREFIX).removeprefix(PREFIX_2)


def _orientation(path: Path, known: dict[Path, Lens]) -> tuple[FloatArray, FloatArray, Lens]:
    """Return centre, rotation world to camera, and lens."""
    image = f"image {_image(path)}"
    root = read_xml(path)
    if root.find(".//NameInternalCalib") is not None:
        return _orientation_2(path, root, known)
    conic = _first(path, root, "OrientationConique")
    projection = conic.findtext("TypeProj", "eProjStenope").strip()
    if projection != "eProjStenope":
        raise InputError(f"{path}: {image}: the projection {projection} is no camera's.")
    outer = _first(path, conic, "Externe")
    convention = outer.findtext("KnownConv", "").strip()
    matrix = outer.find("ParamRotation/CodageMatr")
    if convention not in _IS_INVERSE or matrix is None:
        raise InputError(
            f"{path}: {image}: its rotation is not a matrix in MicMac's own convention"
            f" ({convention or 'no CodageMatr'}); write the orientations anew with OriConvert."
        )
    rows = [numbers(path, f"{image}, {tag}", matrix.findtext(tag), 3) for tag in ("L1", "L2", "L3")]
    centre = numbers(path, f"{image}, Centre", outer.findtext("Centre"), 3)
    rotation = checks.rotation(path, _image(path), np.array(rows)).T
    return centre, rotation, _scanned(path, conic.find("OrIntImaM2C"), _lens(path, conic, known))


def _orientation_2(
    path: Path, root: Element, known: dict[Path, Lens]
) -> tuple[FloatArray, FloatArray, Lens]:
    """Return the same of a file of MMVII."""
    image = _image(path)
    axes = [
        numbers(path, f"image {image}, {tag}", root.findtext(f".//RotMatrix/{tag}"), 3)
        for tag in ("AxeI", "AxeJ", "AxeK")
    ]
    centre = numbers(path, f"image {image}, Center", root.findtext(".//Center"), 3)
    name = (root.findtext(".//NameInternalCalib") or "").strip().strip('"')
    where = path.parent / f"{PurePosixPath(name).name}{SUFFIX}"
    if where not in known:
        if not where.is_file():
            raise InputError(
                f"{path}: image {image}: its calibration '{where.name}' is not beside it; copy it"
                " there."
            )
        known[where] = _calibration_2(where, read_xml(where))
    return centre, checks.rotation(path, image, np.array(axes)), known[where]


def _calibration_2(path: Path, root: Element) -> Lens:
    """Return the lens of a calibration of MMVII."""
    projection = root.findtext(".//Projection", "").strip().strip('"')
    if projection != "Stenope":
        raise _not_held(path, f"of the projection {projection or 'that it does not name'}")
    focal = number(path, "F", root.findtext(".//PerfectProj/F"))
    x, y = numbers(path, "PP", root.findtext(".//PerfectProj/PP"), 2).tolist()
    width, height = numbers(path, "NbPix", root.findtext(".//PixelFrame/NbPix"), 2).tolist()
    given = {
        str(term.tag): number(path, str(term.tag), term.text)
        for part in root.iterfind(".//Distorsion/*")
        for term in part
    }
    held = {f"K{i}" for i in range(1, 10)} | {"p1", "p2", "b1", "b2"}
    others = sorted(name for name, value in given.items() if value and name not in held)
    if others:
        raise _not_held(path, f"with the terms {', '.join(others)}")
    radial = tuple(given.get(f"K{i}", 0.0) for i in range(1, 10))
    p1, p2, b1, b2 = (given.get(name, 0.0) for name in ("p1", "p2", "b1", "b2"))
    lens = Lens(
        *(focal, width, height, x, y, b1 * focal, b2 * focal),
        radial=checks.without_zeros(radial),
        tangential=checks.without_zeros((p1, p2)),
        sensor=path.stem,
    )
    checks.lens(path, path.stem, lens)
    corners = np.array([[0.0, 0.0], [width, 0.0], [0.0, height], [width, height]])
    r = np.hypot(*((corners - [x, y]) / focal).T).max()
    with np.errstate(over="ignore", invalid="ignore"):
        away = r * sum(abs(k) * r ** (2 * i + 2) for i, k in enumerate(radial))
        if not focal * np.hypot(b1, b2) * away <= AFFINITY_PX:
            raise _not_held(path, "with an affinity (b1, b2)")
    return lens


def _lens(path: Path, conic: Element, known: dict[Path, Lens]) -> Lens:
    """Return the lens inside the file, or that of the file it names."""
    inner = conic.find("Interne")
    where = path if inner is not None else _calibration_file(path, conic)
    if where not in known:
        if inner is None:
            inner = _first(where, read_xml(where), "CalibrationInternConique")
        known[where] = _calibration(where, inner)
    return known[where]


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


def _calibration(path: Path, element: Element) -> Lens:
    """Return the lens of an `Interne` or `CalibrationInternConique`."""
    convention = element.findtext("KnownConv", "").strip()
    if convention not in _IS_INVERSE:
        raise InputError(
            f"{path}: the calibration is in the convention {convention}; pcfix reads those of"
            " MicMac's own results (eConvApero_DistM2C, eConvApero_DistC2M)."
        )
    focal = number(path, "F", element.findtext("F"))
    if focal <= 0.0:
        raise InputError(f"{path}: the focal length F is {focal:g}; calibrate again.")
    x, y = numbers(path, "PP", element.findtext("PP"), 2).tolist()
    width, height = numbers(path, "SzIm", element.findtext("SzIm"), 2).tolist()
    models = [model for entry in element.iter("CalibDistortion") for model in entry]
    models = [model for model in models if _name(model) not in NO_DISTORTION]
    if len(models) > 1:
        raise _not_held(path, " after ".join(_name(model) for model in models))
    (cx, cy), radial, rest = (x, y), np.empty(0), np.empty(0)
    for model in models:
        (cx, cy), radial, rest = _distortion(path, model, (x, y))
    b1, b2 = rest[2:].tolist() or (0.0, 0.0)
    if b1 or b2:
        corners = np.array([[0.0, 0.0], [width, 0.0], [0.0, height], [width, height]])
        d = np.hypot(*(corners - [cx, cy]).T).max()
        away = abs(d * sum(k * d ** (2 * i + 2) for i, k in enumerate(radial.tolist())))
        if _IS_INVERSE[convention] or not np.hypot(b1, b2) * away <= AFFINITY_PX:
            raise _not_held(path, f"{_name(models[0])} with an affinity (b1, b2)")
    with np.errstate(over="ignore", invalid="ignore"):
        radial = radial * np.float64(focal) ** (2 * np.arange(len(radial)) + 2)
    lens = Lens(
        *(focal, width, height, x + b1 * (x - cx) + b2 * (y - cy), y, b1 * focal, b2 * focal),
        radial=tuple(radial.tolist()),
        tangential=tuple((rest[:2] * focal).tolist()),
        distortion_centre=((cx - x) / focal, (cy - y) / focal),
        inverse=_IS_INVERSE[convention],
        sensor=path.stem,
    )
    return checks.lens(path, path.stem, lens)


def _name(model: Element) -> str:
    return model.findtext("TypeModele", "").strip() or str(model.tag)


def _not_held(path: Path, name: str) -> InputError:
    return InputError(
        f"{path}: the calibration has the distortion {name}, which pcfix does not model; convert it"
        " to a radial or Fraser's one (mm3d ConvertCalib)."
    )


def _distortion(
    path: Path, model: Element, principal: tuple[float, float]
) -> tuple[tuple[float, float], FloatArray, FloatArray]:
    """Return the centre (pixels), k1, k2, ... and P1, P2, b1, b2 of a distortion."""
    name = _name(model)
    if name in UNIFIED:
        given = [number(path, "Params", e.text) for e in model.findall("Params")]
        if any(given[9:]):
            raise InputError(f"{path}: {name} has {len(given)} Params instead of 9.")
        values = np.array([*given[:9], *(0.0,) * (9 - len(given))])
        return principal, values[:5], values[5:]
    if name not in ("ModRad", "ModPhgrStd"):
        raise _not_held(path, name)
    inside = model.find("RadialePart")
    part = model if inside is None else inside
    x, y = numbers(path, "CDist", part.findtext("CDist"), 2).tolist()
    terms = [number(path, "CoeffDist", e.text) for e in part.findall("CoeffDist")]
    tags = () if name == "ModRad" else ("P1", "P2", "b1", "b2")
    rest = [number(path, tag, model.findtext(tag, "0")) for tag in tags]
    return (x, y), np.array(terms), np.array(rest)


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
    (m00, m01), (m10, m11) = inner.tolist()
    place = origin + turn @ np.array([lens.principal_x, lens.principal_y])
    size = np.abs(turn) @ np.array([lens.width, lens.height])
    width, height, x, y = np.concatenate([size, place]).tolist()
    scanned = replace(lens, focal=m11, b1=m00 - m11, b2=m01, b3=m10)
    scanned = replace(scanned, principal_x=x, principal_y=y, width=width, height=height)
    return checks.lens(path, f"of {where}", scanned)


def _first(path: Path, root: Element, tag: str) -> Element:
    """Return the element of this name, the root or inside it."""
    found = root if root.tag == tag else root.find(f".//{tag}")
    if found is None:
        raise InputError(f"{path}: has no {tag}; it is cut off or no orientation of MicMac.")
    return found

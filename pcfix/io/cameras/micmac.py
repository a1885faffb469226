"""MicMac: a folder Ori-*/ of Orientation-<image>.xml (MMVII: Ori-PerspCentral-), or one such file.

`Externe` has the projection centre (`Centre`) and the matrix camera to world as rows L1, L2, L3
(`CodageMatr`); the camera is x right, y down, z forward. The interior orientation is `Interne` in
the same file, or in the file that `FileInterne` names. Scanned images, with an `OrIntImaM2C`, are
refused. The format does not say whether pixels begin at the corner or the centre of the first, so
nothing is added. The files name no CRS.

An ideal position F (x, y) / z + PP, in pixels, is distorted to the observed one
(eConvApero_DistM2C), or the observed to the ideal one (eConvApero_DistC2M). Read are no distortion;
radial, d (k1 d^2 + k2 d^4 + ...) with d from the centre of distortion; and Fraser's with decentring
P1 (2 x^2 + d^2) + 2 P2 x y. The affinity b1 x + b2 y of Fraser's is of the ideal place, that of
`pcfix.model.Lens` of the distorted one; they differ by the product of affinity and distortion,
mostly below 0.1 px. mm3d ConvertCalib converts other formulas.

MMVII has the centre (`Center`) and the camera's axes in the world (`AxeI`, `AxeJ`, `AxeK`), and the
calibration in a file next to it: ideal places (X, Y) / Z to observed ones with K1, K2, ... radial,
p1, p2, b1 and b2 as above.

References: M. Pierrot-Deseilligny and others, "MicMac, Apero, Pastis and other beverages in a
nutshell", https://github.com/micmacIGN/Documentation, "Distortion models" and ConvertCalib;
include/XML_GEN/ParamChantierPhotogram.xml of https://github.com/micmacIGN/micmac; MMVII's files
write the formula of each coefficient next to it.
"""

from pathlib import Path, PurePosixPath
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras import checks
from pcfix.io.cameras.checks import Source, damaged, number, numbers, read_xml, text_of
from pcfix.model import Cameras, FloatArray, Lens

PREFIX, PREFIX_2, SUFFIX = "Orientation-", "Ori-PerspCentral-", ".xml"
CONTENT, INSIDE = "<OrientationConique|<NameInternalCalib>", rf"({PREFIX}|{PREFIX_2}).*\{SUFFIX}"
NAMES = (*(f"k{i}" for i in range(1, 10)), "p1", "p2", "b1", "b2")
_IS_INVERSE = {"": False, "eConvApero_DistM2C": False, "eConvApero_DistC2M": True}


def read(source: Source) -> Cameras:
    """Read every orientation of a folder, or the one."""
    paths = [source.path]
    if source.path.is_dir():
        found = [sorted(source.path.glob(f"{one}*{SUFFIX}")) for one in (PREFIX, PREFIX_2)]
        paths = [path for path in found[0] or found[1] if path.is_file()]
    names = [path.name.removesuffix(SUFFIX).removeprefix(PREFIX) for path in paths]
    labels = tuple(name.removeprefix(PREFIX_2) for name in names)
    centres, rotations, lenses = zip(*map(_orientation, paths), strict=True)
    return Cameras(labels, np.array(centres), np.array(rotations), lenses)


def _orientation(path: Path) -> tuple[FloatArray, FloatArray, Lens]:
    """Return centre, rotation world to camera, and lens."""
    root = read_xml(path)
    if named := text_of(root, ".//NameInternalCalib"):  # MMVII
        tags = ("AxeI", "AxeJ", "AxeK")
        axes = [numbers(path, tag, root.findtext(f".//RotMatrix/{tag}"), 3) for tag in tags]
        centre = numbers(path, "Center", root.findtext(".//Center"), 3)
        where = path.with_name(f"{PurePosixPath(named).name}{SUFFIX}")
        inside = read_xml(where)
        projection = text_of(inside, ".//Projection")
        if projection != "Stenope":
            raise _not_held(where, f"projection {projection}")
        focal = number(where, "F", inside.findtext(".//PerfectProj/F"))
        principal = numbers(where, "PP", inside.findtext(".//PerfectProj/PP"), 2)
        size = numbers(where, "NbPix", inside.findtext(".//PixelFrame/NbPix"), 2)
        terms = [term for part in inside.iterfind(".//Distorsion/*") for term in part]
        given = {str(term.tag).lower(): number(where, str(term.tag), term.text) for term in terms}
        if others := sorted(k for k, v in given.items() if v and k not in NAMES):
            raise _not_held(where, f"terms {', '.join(others)}")
        frame = np.array([size, principal, principal])
        return centre, np.array(axes), _lens(where, focal, frame, given)
    conic = _first(path, root, "OrientationConique")
    projection = text_of(conic, "TypeProj") or "eProjStenope"
    outer = _first(path, conic, "Externe")
    convention, matrix = text_of(outer, "KnownConv"), outer.find("ParamRotation/CodageMatr")
    if projection != "eProjStenope" or convention not in _IS_INVERSE or matrix is None:
        what = f"the projection {projection} with rotations by {convention or 'angles'}"
        raise checks.unsupported(path, what, "Write the orientations again with OriConvert")
    rows = [numbers(path, tag, matrix.findtext(tag), 3) for tag in ("L1", "L2", "L3")]
    centre = numbers(path, "Centre", outer.findtext("Centre"), 3)
    inner, where = conic.find("Interne"), path
    if inner is None:
        name = PurePosixPath(text_of(conic, "FileInterne").replace("\\", "/"))
        where = path.parent / name.name
        where = where if where.is_file() else path.resolve().parent.parent / name
        inner = _first(where, read_xml(where), "CalibrationInternConique")
    scan = conic.find("OrIntImaM2C")
    if scan is not None:
        text = " ".join(scan.findtext(tag) or "" for tag in ("I00", "V10", "V01"))
        if (numbers(path, "OrIntImaM2C", text, 6) != [0.0, 0.0, 1.0, 0.0, 0.0, 1.0]).any():
            raise _not_held(path, "map to a scanned image (OrIntImaM2C)")
    return centre, np.array(rows).T, _calibration(where, inner)


def _calibration(path: Path, element: Element) -> Lens:
    """Return the lens of an `Interne` or `CalibrationInternConique`."""
    convention = text_of(element, "KnownConv")
    if convention not in _IS_INVERSE:
        raise _not_held(path, f"convention {convention}")
    focal = number(path, "F", element.findtext("F"))
    principal, size = (numbers(path, tag, element.findtext(tag), 2) for tag in ("PP", "SzIm"))
    found = [model for entry in element.iter("CalibDistortion") for model in entry]
    named = [(text_of(model, "TypeModele") or str(model.tag), model) for model in found]
    models = [one for one in named if one[0] not in ("ModNoDist", "eModelePolyDeg0")]  # none
    if len(models) > 1:
        raise _not_held(path, " after ".join(name for name, _ in models))
    centre, given = principal, dict[str, float]()
    for name, model in models:
        # of ModUnif: radial and Fraser's about the principal point; five k, P1, P2, b1, b2
        if name in ("eModele_DRad_PPaEqPPs", "eModele_Fraser_PPaEqPPs"):
            values = [number(path, "Params", e.text) for e in model.findall("Params")]
            if any(values[9:]):
                raise damaged(path, f"{name} has {len(values)} Params instead of 9")
            given = dict(zip((*NAMES[:5], *NAMES[-4:]), values, strict=False))
        elif name in ("ModRad", "ModPhgrStd"):
            inside = model.find("RadialePart")
            part = model if inside is None else inside
            centre = numbers(path, "CDist", part.findtext("CDist"), 2)
            terms = [number(path, "CoeffDist", e.text) for e in part.findall("CoeffDist")]
            given = {f"k{i}": term for i, term in enumerate(terms, start=1)}
            for tag in ("P1", "P2", "b1", "b2") if name == "ModPhgrStd" else ():
                given[tag.lower()] = number(path, tag, model.findtext(tag, "0"))
        else:
            raise _not_held(path, name)
    if _IS_INVERSE[convention] and (given.get("b1") or given.get("b2")):
        raise _not_held(path, "affinity (b1, b2) of the observed place")
    # MicMac's coefficients are of places in pixels, those of a Lens of places over the focal length
    powers = {"p1": 1, "p2": 1, "b1": 0, "b2": 0}
    given = {k: value * focal ** powers.get(k, 2 * int(k[1:])) for k, value in given.items()}
    frame = np.array([size, principal, centre])
    return _lens(path, focal, frame, given, inverse=_IS_INVERSE[convention])


def _lens(
    path: Path, focal: float, frame: FloatArray, given: dict[str, float], *, inverse: bool = False
) -> Lens:
    """Return the lens of coefficients k1, k2, ..., p1, p2, b1, b2 of places over the focal length.

    The `frame` is its size, the principal point and the centre of the distortion, pixels.
    """
    b1, b2 = given.get("b1", 0.0), given.get("b2", 0.0)
    (width, height), (x, y), (cx, cy) = frame.tolist()
    values = given | {"fx": focal + b1 * focal, "fy": focal, "skew": b2 * focal}
    values |= {"cx": x + b1 * (x - cx) + b2 * (y - cy), "cy": y}
    middle = ((cx - x) / focal, (cy - y) / focal)
    more: dict[str, Any] = {"distortion_centre": middle, "inverse": inverse, "sensor": path.stem}
    return checks.lens_by_name(values, width, height, **more)


def _not_held(path: Path, what: str) -> InputError:
    remedy = "Convert the calibration to a radial or Fraser's one (mm3d ConvertCalib)"
    return checks.unsupported(path, f"a calibration with the {what}", remedy, model=what)


def _first(path: Path, root: Element, tag: str) -> Element:
    """Return the element of this name, the root or inside it."""
    found = next(root.iter(tag), None)
    if found is None:
        raise damaged(path, f"{tag} is missing")
    return found

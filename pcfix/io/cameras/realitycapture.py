"""RealityCapture and RealityScan: .xmp files next to the images, one each.

The fields of the namespace ``xcr`` are attributes or child elements. `Rotation` is world to
camera by rows (x right, y down, z forward) and `Position` the projection centre. With
scale = max(width, height) and f = FocalLength35mm / 36 scale:

    u = width / 2 + U scale + f x' + Skew scale y'
    v = height / 2 + V scale + AspectRatio f y'

The coefficients are k1, k2, k3, k4, t1, t2 of Brown's formula, in his order,
x' = ... + t1 (r^2 + 2 x^2) + 2 t2 x y; models named brown3 leave k4 out, those without "t2" the
last two. The division model undoes the distortion after the calibration matrix, about the centre
of the image: m = m' / (1 + k1 |m'|^2), m and m' divided by the scale.

The size of an image is that of the image next to the file, or has the proportions of ``--sensor``.
Positions called relative or rigid are in a local frame; absolute ones are in the CRS of the export,
which the file does not name; its `latitude` and `longitude` are others.

References: Epic Games, "RealityScan/RealityCapture XMP camera math" and RealityScan Help, "XMP
Metadata" (tools/xmpalign). The software's own templates for OpenCV and projection matrices, and the
converters of AliceVision and EasyVolcap, agree. No file with measurements was there for a check.
"""

from pathlib import Path

import numpy as np

from pcfix.io.cameras import checks
from pcfix.io.cameras.checks import Source, image_size, lens_by_name, number, numbers, read_xml
from pcfix.io.cameras.table import FILM_MM, read_sensor, sensor_file
from pcfix.model import Cameras, Lens

NAMESPACE = "http://www.capturingreality.com/ns/xcr/"
DESCRIPTION = "{http://www.w3.org/1999/02/22-rdf-syntax-ns#}Description"
# The coefficients of each model, in the order of its files, which list six.
MODELS = {
    "perspective": "",
    "brown3": "k1 k2 k3",
    "brown4": "k1 k2 k3 k4",
    "brown3t2": "k1 k2 k3 - p1 p2",
    "brown4t2": "k1 k2 k3 k4 p1 p2",
    "division": "d1",
}
IMAGES = (".jpg", ".jpeg", ".tif", ".tiff", ".png", ".webp", ".bmp", ".exr", ".jp2")


def recognises(source: Source) -> bool:
    """Whether a file, or one of the .xmp files of a folder, uses RealityCapture's namespace."""
    return bool(_files(source.path))


def read(source: Source) -> Cameras:
    """Read the poses, and the lenses where the size of the images is known."""
    path = source.path
    folder = path if path.is_dir() else path.parent
    pictures = {p.stem: p.name for p in folder.iterdir() if p.suffix.lower() in IMAGES}
    images: dict[Path, dict[str, str]] = {}
    for file in _files(path):
        images[file] = {}
        for one in read_xml(file).iter(DESCRIPTION):
            fields = one.attrib | {str(child.tag): child.text or "" for child in one}
            own = {k: v.strip() for k, v in fields.items() if k.startswith("{" + NAMESPACE)}
            images[file] |= {name.partition("}")[2]: text for name, text in own.items()}
    names = {file: pictures.get(file.stem, file.stem) for file in images}
    posed = {f: of for f, of in images.items() if {"Rotation", "Position"} <= of.keys()}
    if not posed:
        raise checks.no_pose(path, "has no xcr:Rotation and xcr:Position")
    sensor = sensor_file(source)
    lens = None if sensor is None else read_sensor(sensor)
    given = None if lens is None else (lens.width, lens.height)
    frames = {file: image_size(folder, names[file]) or given for file in posed}
    lenses = [_lens(file, posed[file], *frame) for file, frame in frames.items() if frame]
    relative = any(of.get("Coordinates", "absolute") != "absolute" for of in posed.values())
    rotations = [numbers(f, "xcr:Rotation", of["Rotation"], 9) for f, of in posed.items()]
    positions = [numbers(f, "xcr:Position", of["Position"], 3) for f, of in posed.items()]
    return Cameras(
        labels=tuple(names[file] for file in posed),
        centres=np.array(positions),
        rotations=np.array(rotations).reshape(-1, 3, 3),
        lenses=tuple(lenses) if len(lenses) == len(posed) else None,
        crs="local" if relative else None,
        unposed=tuple(names[file] for file in images if file not in posed),
    )


def _files(path: Path) -> list[Path]:
    """Return the one file, or those of a folder, if they use RealityCapture's namespace."""
    inside = (p for p in path.glob("*") if p.suffix.lower() == ".xmp" and p.is_file())
    listed = sorted(inside) if path.is_dir() else [path]
    named = [file for file in listed if file.stem != "_common"]  # which is of no image
    return [file for file in named if NAMESPACE.encode() in Source(file).head]


def _lens(path: Path, fields: dict[str, str], width: float, height: float) -> Lens:
    """Return the lens of an image, in the unit of its frame."""

    def value(name: str, default: str = "0") -> float:
        return number(path, f"xcr:{name}", fields.get(name, default))

    across = value("FocalLength35mm", "") / FILM_MM  # all in units of the larger side
    down = across * value("AspectRatio", "1")
    x, y = (value(f"PrincipalPoint{axis}") for axis in "UV")
    model = fields.get("DistortionModel", "perspective")
    if model not in MODELS:
        what = f"the distortion model '{model}'"
        raise checks.unsupported(path, what, f"Export with one of {', '.join(MODELS)}", model=model)
    words = fields.get("DistortionCoeficients", "")  # misspelt in the files too
    found = numbers(path, "xcr:DistortionCoeficients", words, len(words.split())).tolist()
    values = dict(zip(MODELS[model].split(), found, strict=False))
    values |= {"fx": across, "fy": down, "dx": x, "dy": y, "skew": value("Skew")}
    if model != "division":
        return lens_by_name(values, width, height, relative=True)
    # In plane coordinates the centre of the image is at minus the principal point over the focal
    # length, and a length there is a share of the image divided by that of the focal length.
    values["d1"] = values.get("d1", 0.0) * across**2
    more = {"distortion_centre": (-x / across, -y / down), "inverse": True}
    return lens_by_name(values, width, height, relative=True, **more)

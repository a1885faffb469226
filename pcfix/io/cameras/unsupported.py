"""Files that are known but not read: each is refused with its name and a way round.

Only what no reader has claimed comes here. Recognised are signatures, keywords in the first bytes,
the names of files that are one part of an export and, of folders, the names inside.
"""

from __future__ import annotations

import re
from typing import NamedTuple, NoReturn

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras.formats import Source
from pcfix.io.tables import number

ANY_CAMERAS = "give the file or folder with the camera poses"
OMEGA_PHI_KAPPA = (
    "write a table with the header label,x,y,z,omega,phi,kappa and give its lens by --sensor"
)
COLMAP = "export a COLMAP model (cameras, images, points3D)"
METASHAPE = "in Metashape, File > Export > Export Cameras, Agisoft XML"


class Refusal(NamedTuple):
    """A format: what it is, what its content matches, and what to do instead."""

    what: str
    pattern: bytes
    remedy: str


OPENMVG = Refusal("a scene of OpenMVG", rb'"sfm_data_version"', f"{COLMAP} (openMVG2Colmap)")
ALICEVISION = Refusal(
    "a scene of AliceVision (Meshroom)",
    rb'"viewId"|"featuresFolders"|"pipelineVersion"',
    f"{COLMAP} (aliceVision_exportColmap)",
)
NERFSTUDIO = Refusal(
    "a scene of nerfstudio or instant-ngp",
    rb'"transform_matrix"|"camera_angle_x"|"fl_x"',
    "give the model from which it was converted; its axes and scale are no longer the cloud's",
)
IMAGES = Refusal("an image", rb"\A(\xff\xd8\xff|II[*+]\0|MM\0[*+]|\x89PNG)", ANY_CAMERAS)
PIX4D = Refusal(
    "a project of Pix4D", rb"<pix4uav|<!DOCTYPE Pix4D", "give its folder 1_initial/params"
)
MICMAC = Refusal(
    "a calibration of MicMac",
    rb"<(CalibrationInternConique|InternalCalibration)>",
    "give the folder that holds the orientations, Orientation-*.xml or Ori-PerspCentral-*.xml",
)
ODM = Refusal(
    "a list of lenses of OpenDroneMap or OpenSfM, without poses",
    rb'"projection_type"',
    "give reconstruction.json or shots.geojson of the same project, or its folder",
)

FILES = (
    IMAGES,
    Refusal("a point cloud (LAS, LAZ)", rb"\ALASF", ANY_CAMERAS),
    Refusal("a point cloud or mesh (PLY)", rb"\Aply\r?\n", ANY_CAMERAS),
    Refusal("a GeoPackage or other SQLite database", rb"\ASQLite format 3\0", ANY_CAMERAS),
    Refusal("a shapefile", rb"\A\0\0\x27\x0a", ANY_CAMERAS),
    Refusal("an archive (gzip)", rb"\A\x1f\x8b", f"unpack it, then {ANY_CAMERAS}"),
    Refusal("an archive (ZIP)", rb"\APK[\x03\x05]", f"unpack it, then {ANY_CAMERAS}"),
    Refusal("a scene of OpenMVS", rb"\AMVS[I\0]", f"{COLMAP} from what OpenMVS was run on"),
    PIX4D,
    Refusal(
        "a project of Metashape without its poses",
        rb"\A\s*(<\?xml[^>]*>\s*)?<document[^>]*\bpath=",
        f"keep the folder .files beside it, or {METASHAPE}",
    ),
    Refusal(
        "a project of RealityCapture",
        rb"<Reality(Capture|Scan)",
        "export Internal/External camera parameters (CSV) or XMP files",
    ),
    Refusal("a map of Google Earth (KML)", rb"<kml[\s>]", ANY_CAMERAS),
    Refusal("a survey job (Trimble, Leica)", rb"<(JOBFile|HeXML|LandXML)[\s>]", ANY_CAMERAS),
    Refusal(
        "a list of ground control points (ODM)",
        rb"\A(EPSG:\d|\+proj=|WGS84 UTM )[^\n]*\n\s*[-+.\d]+[ \t]+[-+.\d]+[ \t]",
        ANY_CAMERAS,
    ),
    Refusal("a table of the sensor", rb"\A(\xef\xbb\xbf)?focal", "give it by --sensor"),
    Refusal(
        "a project of Inpho (Trimble)",
        rb"\A\s*\$PROJECT\b|^\s*\$(PHOTO_NUM|EXT_ORI)\b",
        OMEGA_PHI_KAPPA,
    ),
    Refusal(
        "a support file of SOCET SET",
        rb"^\s*(SENSOR_TYPE|IMAGE_SUPPORT|SENSOR_SERIAL_NUMBER|TRIANGULATION_TYPE)\s",
        OMEGA_PHI_KAPPA,
    ),
    Refusal("a file of BINGO", rb"^\s*(ORI[AE]|PRO[JI]|GEOI|BILD)\s+\S+\s+\S", OMEGA_PHI_KAPPA),
    MICMAC,
    ODM,
    OPENMVG,
    ALICEVISION,
    NERFSTUDIO,
)
"""The first that matches counts."""

PIX4D_TABLES = (
    "give calibrated_camera_parameters.txt of the same export, or the params folder that holds it"
)
PARTS = tuple(
    (rf"(?i)(.*_)?{name}", Refusal(what, b"", PIX4D_TABLES))
    for name, what in (
        (r"calibrated_images_position\.txt", "a list of positions by Pix4D, without angles"),
        (r"pmatrix\.txt", "a list of projection matrices by Pix4D, without the distortion"),
        (r"offset\.xyz", "the offset of a project of Pix4D"),
        (r"internal_camera_parameters\.cam", "a calibration of Pix4D, without poses"),
        (
            r"camera_parameters(_wgs84)?_error\.txt",
            "a table of standard errors by Pix4D, without poses",
        ),
    )
)
"""What the name of a file says that is one part of an export."""
FOLDERS = (
    *PARTS,
    (r"AutoCal.*\.xml|Calib-PerspCentral-.*\.xml", MICMAC),
    (r"cameras\.json|camera_models\.json", ODM),
    (r"sfm_data\.(json|bin)", OPENMVG),
    (r".*\.(sfm|mg)", ALICEVISION),
    (r"transforms\.json", NERFSTUDIO),
    (r"1_initial", PIX4D),
    (r"(?i).*\.(jpe?g|tiff?|png|dng)", IMAGES._replace(what="a folder of images")),
)
"""What the name of a file inside says of a folder."""
PATB = Refusal("a text like PATB's .ori, with rotation matrices", b"", OMEGA_PHI_KAPPA)
BARE = Refusal(
    "a table without a header",
    b"",
    "put one above the rows, for example label,x,y,z,omega,phi,kappa",
)


def recognises(source: Source) -> bool:
    """Whether the content is one of these."""
    return _refusal(source) is not None


def is_part(source: Source) -> bool:
    """Whether a file is by its name one part of an export that alone has no poses."""
    return source.path.is_file() and any(re.fullmatch(p, source.path.name) for p, _ in PARTS)


def read(source: Source) -> NoReturn:
    """Refuse the file."""
    found = _refusal(source) or Refusal("a format that pcfix does not read", b"", ANY_CAMERAS)
    raise InputError(
        f"{source.path}: is {found.what}, which pcfix does not read as cameras; {found.remedy}."
    )


def _refusal(source: Source) -> Refusal | None:
    """Return what the content is, or None where it is not known."""
    if source.path.is_dir():
        for pattern, found in FOLDERS:
            for name in sorted(source.names):
                if re.fullmatch(pattern, name):
                    return found._replace(what=f"a folder with {name}: {found.what}")
        return None
    part = next((f for name, f in PARTS if re.fullmatch(name, source.path.name)), None)
    if part is not None:
        return part
    for each in FILES:
        if re.search(each.pattern, source.head, re.MULTILINE):
            return each
    return None if b"\0" in source.head else _bare_numbers(source.text)


def _bare_numbers(text: str) -> Refusal | None:
    """Return what a text is whose lines are numbers, but for the name of the image."""
    lines = (text.rpartition("\n")[0] or text).splitlines()  # the last may be cut off
    rows = []
    for line in lines:
        if line.strip() and not line.startswith("#"):
            values = [number(word) for word in re.split(r"[,;\s]+", line.strip())]
            values = values[1:] if np.isnan(values[0]) else values  # after at most one name
            rows.append([] if np.isnan(values).any() else values)
    for i in range(len(rows) - 2):
        if all(len(row) == 3 for row in rows[i : i + 3]):
            three = np.array(rows[i : i + 3])
            with np.errstate(all="ignore"):
                if np.abs(three @ three.T - np.eye(3)).max() < 1e-3:
                    return PATB
    return BARE if rows and all(len(row) >= 3 for row in rows[:20]) else None

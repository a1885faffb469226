"""Files that are known but not read: each is refused with its name and a remedy.

Only files that no reader has claimed come here. They are recognised by signatures and keywords in
the first bytes, by the names of files that are one part of an export and, in folders, by the names
inside.
"""

from __future__ import annotations

import re
from typing import NamedTuple, NoReturn

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras.formats import Source
from pcfix.io.tables import number


class Refusal(NamedTuple):
    """A kind of file that is not read, and what to do instead."""

    what: str
    remedy: str


POSES = "Give the file or folder with the camera poses"
UNPACK = "Unpack it, then give the file or folder with the camera poses"
OPK = "Write a table with the header label,x,y,z,omega,phi,kappa and give its lens by --sensor"
COLMAP = "Export a COLMAP model (cameras, images, points3D)"

IMAGE = Refusal("an image", POSES)
PIX4D = Refusal("a project of Pix4D", "Give its folder 1_initial/params")
MICMAC = Refusal(
    "a calibration of MicMac",
    "Give the folder that holds the orientations, Orientation-*.xml or Ori-PerspCentral-*.xml",
)
ODM = Refusal(
    "a list of lenses of OpenDroneMap or OpenSfM, without poses",
    "Give reconstruction.json or shots.geojson of the same project, or its folder",
)
OPENMVG = Refusal("a scene of OpenMVG", f"{COLMAP} with openMVG2Colmap")
ALICEVISION = Refusal(
    "a scene of AliceVision (Meshroom)", f"{COLMAP} with aliceVision_exportColmap"
)
NERFSTUDIO = Refusal(
    "a scene of nerfstudio or instant-ngp",
    "Give the model from which it was converted; its axes and scale are no longer the cloud's",
)

CONTENTS = (
    (rb"\A(\xff\xd8\xff|II[*+]\0|MM\0[*+]|\x89PNG)", IMAGE),
    (rb"\ALASF", Refusal("a point cloud (LAS, LAZ)", POSES)),
    (rb"\Aply\r?\n", Refusal("a point cloud or mesh (PLY)", POSES)),
    (rb"\ASQLite format 3\0", Refusal("a GeoPackage or other SQLite database", POSES)),
    (rb"\A\0\0\x27\x0a", Refusal("a shapefile", POSES)),
    (rb"\A\x1f\x8b", Refusal("an archive (gzip)", UNPACK)),
    (rb"\APK[\x03\x05]", Refusal("an archive (ZIP)", UNPACK)),
    (rb"\AMVS[I\0]", Refusal("a scene of OpenMVS", f"{COLMAP} from what OpenMVS was run on")),
    (rb"<!DOCTYPE Pix4D", PIX4D),
    (
        rb"<Reality(Capture|Scan)",
        Refusal(
            "a project of RealityCapture",
            "Export Internal/External camera parameters (CSV) or XMP files",
        ),
    ),
    (rb"<kml[\s>]", Refusal("a map of Google Earth (KML)", POSES)),
    (rb"<(JOBFile|HeXML|LandXML)[\s>]", Refusal("a survey job (Trimble, Leica)", POSES)),
    (
        rb"\A(EPSG:\d|\+proj=|WGS84 UTM )[^\n]*\n\s*[-+.\d]+[ \t]+[-+.\d]+[ \t]",
        Refusal("a list of ground control points (ODM)", POSES),
    ),
    (rb"\A(\xef\xbb\xbf)?focal", Refusal("a table of the sensor", "Give it by --sensor")),
    (
        rb"\A\s*\$PROJECT\b|^\s*\$(PHOTO_NUM|EXT_ORI)\b",
        Refusal("a project of Inpho (Trimble)", OPK),
    ),
    (
        rb"^\s*(SENSOR_TYPE|IMAGE_SUPPORT|SENSOR_SERIAL_NUMBER|TRIANGULATION_TYPE)\s",
        Refusal("a support file of SOCET SET", OPK),
    ),
    (rb"^\s*(ORI[AE]|PRO[JI]|GEOI|BILD)\s+\S+\s+\S", Refusal("a file of BINGO", OPK)),
    (rb"<(CalibrationInternConique|InternalCalibration)>", MICMAC),
    (rb'"projection_type"', ODM),
    (rb'"sfm_data_version"', OPENMVG),
    (rb'"viewId"|"featuresFolders"|"pipelineVersion"', ALICEVISION),
    (rb'"transform_matrix"|"camera_angle_x"|"fl_x"', NERFSTUDIO),
)
"""What the first bytes of a file match; the first counts."""

PIX4D_TABLES = (
    "Give calibrated_camera_parameters.txt of the same export, or the params folder that holds it"
)
PARTS = tuple(
    (rf"(?i)(.*_)?{name}", Refusal(f"{what} of Pix4D", PIX4D_TABLES))
    for name, what in (
        (r"calibrated_images_position\.txt", "a list of positions without angles"),
        (r"pmatrix\.txt", "a list of projection matrices without the distortion"),
        (r"offset\.xyz", "the offset of a project"),
        (r"internal_camera_parameters\.cam", "a calibration without poses"),
        (r"camera_parameters(_wgs84)?_error\.txt", "a table of standard errors without poses"),
    )
)
"""Names of files that are one part of an export."""
FOLDERS = (
    *PARTS,
    (r"AutoCal.*\.xml|Calib-PerspCentral-.*\.xml", MICMAC),
    (r"cameras\.json|camera_models\.json", ODM),
    (r"sfm_data\.(json|bin)", OPENMVG),
    (r".*\.(sfm|mg)", ALICEVISION),
    (r"transforms\.json", NERFSTUDIO),
    (r"1_initial", PIX4D),
    (r"(?i).*\.(jpe?g|tiff?|png|dng)", Refusal("a folder of images", POSES)),
)
"""Names of files inside a folder, and what the folder is then."""
PATB = Refusal("a text like PATB's .ori, with rotation matrices", OPK)
BARE = Refusal(
    "a table without a header", "Put one above the rows, for example label,x,y,z,omega,phi,kappa"
)


def recognises(source: Source) -> bool:
    """Whether the content is one of these."""
    return _refusal(source) is not None


def is_part(source: Source) -> bool:
    """Whether a file is by its name one part of an export that alone has no poses."""
    return source.path.is_file() and any(re.fullmatch(p, source.path.name) for p, _ in PARTS)


def read(source: Source) -> NoReturn:
    """Refuse the file."""
    found = _refusal(source) or Refusal("a format that pcfix does not read", POSES)
    raise InputError(
        "cameras.not_read",
        f"{source.path}: is {found.what}, which pcfix does not read as cameras. {found.remedy}.",
        path=source.path,
        what=found.what,
    )


def _refusal(source: Source) -> Refusal | None:
    """Return what the content is, or None where it is not known."""
    if source.path.is_dir():
        for pattern, found in FOLDERS:
            for name in sorted(source.names):
                if re.fullmatch(pattern, name):
                    return found._replace(what=f"a folder with {name}: {found.what}")
        return None
    for name, found in PARTS:
        if re.fullmatch(name, source.path.name):
            return found
    for content, found in CONTENTS:
        if re.search(content, source.head, re.MULTILINE):
            return found
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

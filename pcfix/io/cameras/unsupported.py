"""Files that are known but not read: each is refused with its name and a remedy.

Only files that no reader has claimed come here. They are recognised by signatures and keywords in
the first bytes, by the names of files that are one part of an export and, in folders, by the names
inside.
"""

from __future__ import annotations

import re
from typing import NoReturn

import numpy as np

from pcfix.errors import bad_file
from pcfix.io.cameras.checks import Source
from pcfix.io.tables import number

POSES = "Give the file or folder with the camera poses"
OPK = "Write a table with the header label,x,y,z,omega,phi,kappa and give its lens by --sensor"
COLMAP = "Export a COLMAP model (cameras, images, points3D)"
TABLES = "Give calibrated_camera_parameters.txt of the same export, or its folder params"
Refusal = tuple[str, str]  # what a file is, and what to do instead
PIX4D = "a project of Pix4D", "Give its folder 1_initial/params"
MICMAC = "a calibration of MicMac", "Give the folder with its orientations"
ODM = "a list of lenses of OpenDroneMap or OpenSfM, without poses", "Give reconstruction.json"
OPENMVG = "a scene of OpenMVG", COLMAP
ALICEVISION = "a scene of AliceVision (Meshroom)", COLMAP
NERF = "a scene of nerfstudio or instant-ngp", "Give the model from which it was converted"
RC = "a project of RealityCapture", "Export Internal/External camera parameters or XMP files"
SOCET = "a support file of SOCET SET", OPK
GCPS = "a list of ground control points (ODM)", POSES
CONTENTS: tuple[tuple[bytes, Refusal], ...] = (
    (rb"\A(\xff\xd8\xff|II[*+]\0|MM\0[*+]|\x89PNG)", ("an image", POSES)),
    (rb"\ALASF", ("a point cloud (LAS, LAZ)", POSES)),
    (rb"\Aply\r?\n", ("a point cloud or mesh (PLY)", POSES)),
    (rb"\ASQLite format 3\0", ("a GeoPackage or other SQLite database", POSES)),
    (rb"\A\0\0\x27\x0a", ("a shapefile", POSES)),
    (rb"\A\x1f\x8b", ("an archive (gzip)", POSES)),
    (rb"\APK[\x03\x05]", ("an archive (ZIP)", POSES)),
    (rb"\AMVS[I\0]", ("a scene of OpenMVS", COLMAP)),
    (rb"<!DOCTYPE Pix4D", PIX4D),
    (rb"<Reality(Capture|Scan)", RC),
    (rb"<kml[\s>]", ("a map of Google Earth (KML)", POSES)),
    (rb"<(JOBFile|HeXML|LandXML)[\s>]", ("a survey job (Trimble, Leica)", POSES)),
    (rb"\A(EPSG:\d|\+proj=|WGS84 UTM )[^\n]*\n\s*[-+.\d]+[ \t]+[-+.\d]+[ \t]", GCPS),
    (rb"\A(\xef\xbb\xbf)?focal", ("a table of the sensor", "Give it by --sensor")),
    (rb"\A\s*\$PROJECT\b|^\s*\$(PHOTO_NUM|EXT_ORI)\b", ("a project of Inpho (Trimble)", OPK)),
    (rb"^\s*(SENSOR_TYPE|IMAGE_SUPPORT|TRIANGULATION_TYPE)\s", SOCET),
    (rb"^\s*(ORI[AE]|PRO[JI]|GEOI|BILD)\s+\S+\s+\S", ("a file of BINGO", OPK)),
    (rb"<(CalibrationInternConique|InternalCalibration)>", MICMAC),
    (rb'"projection_type"', ODM),
    (rb'"sfm_data_version"', OPENMVG),
    (rb'"viewId"|"featuresFolders"|"pipelineVersion"', ALICEVISION),
    (rb'"transform_matrix"|"camera_angle_x"|"fl_x"', NERF),
)
"""What the first bytes of a file match; the first counts."""
PARTS: tuple[tuple[str, Refusal], ...] = (
    (r"(?i)(.*_)?calibrated_images_position\.txt", ("a list of positions of Pix4D", TABLES)),
    (r"(?i)(.*_)?pmatrix\.txt", ("a list of projection matrices of Pix4D", TABLES)),
    (r"(?i)(.*_)?offset\.xyz", ("the offset of a project of Pix4D", TABLES)),
    (r"(?i)(.*_)?internal_camera_parameters\.cam", ("a calibration of Pix4D", TABLES)),
    (r"(?i)(.*_)?camera_parameters(_wgs84)?_error\.txt", ("standard errors of Pix4D", TABLES)),
)
"""Names of files that are one part of an export."""
FOLDERS: tuple[tuple[str, Refusal], ...] = (
    *PARTS,
    (r"AutoCal.*\.xml|Calib-PerspCentral-.*\.xml", MICMAC),
    (r"cameras\.json|camera_models\.json", ODM),
    (r"sfm_data\.(json|bin)", OPENMVG),
    (r".*\.(sfm|mg)", ALICEVISION),
    (r"transforms\.json", NERF),
    (r"1_initial", PIX4D),
    (r"(?i).*\.(jpe?g|tiff?|png|dng)", ("a folder of images", POSES)),
)
"""Names of files inside a folder, and what the folder is then."""


def recognises(source: Source) -> bool:
    """Whether the content is one of these."""
    return _refusal(source) is not None


def is_part(source: Source) -> bool:
    """Whether a file is by its name a part of an export without poses."""
    return source.path.is_file() and any(re.fullmatch(p, source.path.name) for p, _ in PARTS)


def read(source: Source) -> NoReturn:
    """Refuse the file."""
    what, remedy = _refusal(source) or ("a format that pcfix does not read", POSES)
    sentence = f"is {what}, which pcfix does not read as cameras. {remedy}."
    raise bad_file(source.path, "cameras.not_read", sentence, what=what)


def _refusal(source: Source) -> Refusal | None:
    """Return what the content is, or None where it is not known."""
    if source.path.is_dir():
        inside = ((one, n) for one in FOLDERS for n in sorted(source.names))
        found = next(((one[1], n) for one, n in inside if re.fullmatch(one[0], n)), None)
        return found and (f"a folder with {found[1]}: {found[0][0]}", found[0][1])
    by_name = (found for name, found in PARTS if re.fullmatch(name, source.path.name))
    by_head = (found for head, found in CONTENTS if re.search(head, source.head, re.MULTILINE))
    known = next(by_name, None) or next(by_head, None)
    if known or b"\0" in source.head:
        return known
    counts = []  # of numbers in a line, after at most one name; the last line may be cut off
    for line in (source.text.rpartition("\n")[0] or source.text).splitlines():
        if line.strip() and not line.startswith("#"):
            values = [number(word) for word in re.split(r"[,;\s]+", line.strip())]
            values = values[1:] if np.isnan(values[0]) else values
            counts.append(0 if np.isnan(values).any() else len(values))
    is_bare = bool(counts) and min(counts[:20]) >= 2
    header = "Write one, for example label,x,y,z,omega,phi,kappa"
    return ("a table without a header", header) if is_bare else None

"""Files that are known but not read: each is refused with its name and a remedy.

Files reach this module if no reader has recognised them. They are recognised by signatures and
keywords in the first bytes, or by their name. A folder is refused for the first such file in it.
"""

from __future__ import annotations

import re
from pathlib import Path

from pcfix.errors import bad_file
from pcfix.io.cameras.checks import Source

POSES = "Give the file or folder with the camera poses"
OPK = "Write a table with the header label,x,y,z,omega,phi,kappa and give its lens by --sensor"
COLMAP = "Export a COLMAP model (cameras, images, points3D)"
GCPS = "a list of ground control points (ODM)", POSES
BARE = "a table without a header", "Write one, for example label,x,y,z,omega,phi,kappa"
MICMAC = "a calibration of MicMac", "Give the folder with its orientations"
LENSES = "a list of lenses (OpenDroneMap), without poses", "Give reconstruction.json"
NERF = "a scene of nerfstudio or instant-ngp", "Give the model from which it was converted"
PIX4D_PART = ["a part of the parameters of Pix4D", "Give calibrated_camera_parameters.txt"]
CONTENTS: tuple[tuple[bytes, str, str], ...] = (
    (rb"\A(\xff\xd8\xff|II[*+]\0|MM\0[*+]|\x89PNG)", "an image", POSES),
    (rb"\ALASF", "a point cloud (LAS, LAZ)", POSES),
    (rb"\Aply\r?\n", "a point cloud or mesh (PLY)", POSES),
    (rb"\A(SQLite format 3\0|\0\0\x27\x0a)", "a vector file", POSES),
    (rb"\A(\x1f\x8b|PK[\x03\x05])", "an archive", POSES),
    (rb"\AMVS[I\0]", "a scene of OpenMVS", COLMAP),
    (rb"<!DOCTYPE Pix4D", "a project of Pix4D", "Give its folder 1_initial/params"),
    (rb"<Reality(Capture|Scan)", "a project of RealityCapture", "Export XMP files"),
    (rb"<kml[\s>]", "a map of Google Earth (KML)", POSES),
    (rb"\A(EPSG:|\+proj=|WGS84 UTM )[^\n]*\n\s*([-+.\d]+[ \t]+){2}", *GCPS),
    (rb"\A(\xef\xbb\xbf)?focal", "a table of the sensor", "Give it by --sensor"),
    (rb"\A\s*\$PROJECT\b|^\s*\$(PHOTO_NUM|EXT_ORI)\b", "a project of Inpho (Trimble)", OPK),
    (rb"^\s*(SENSOR_TYPE|TRIANGULATION_TYPE)\s", "a support file of SOCET SET", OPK),
    (rb"^\s*(ORI[AE]|PRO[JI]|GEOI|BILD)\s+\S+\s+\S", "a file of BINGO", OPK),
    (rb"<(CalibrationInternConique|InternalCalibration)>", *MICMAC),
    (rb'"projection_type"', *LENSES),
    (rb'"sfm_data_version"', "a scene of OpenMVG", COLMAP),
    (rb'"viewId"|"featuresFolders"|"pipelineVersion"', "a scene of AliceVision (Meshroom)", COLMAP),
    (rb'"transform_matrix"|"camera_angle_x"|"fl_x"', *NERF),
    # numbers, after one name at most
    (rb"\A\s*([^\s,;]+[,;\s]+)?[-+.\d]+([,; \t]+[-+.\d]+)+\s*$", *BARE),
)
"""Patterns of the first bytes of a file, what it is, and what to do; the first match decides."""
PART = re.compile(
    r"(?i)(.*_)?(calibrated_images_position\.txt|pmatrix\.txt|offset\.xyz"
    r"|internal_camera_parameters\.cam|camera_parameters(_wgs84)?_error\.txt)"
)
"""Files of Pix4D's parameters without poses."""


def is_part(path: Path) -> bool:
    """Whether a file is by its name a part of an export; standard errors look like poses."""
    return path.is_file() and bool(PART.fullmatch(path.name))


def refuse(source: Source) -> None:
    """Raise InputError if the file, or one in the folder, is one of these."""
    is_folder = source.path.is_dir()
    files = filter(Path.is_file, source.path.iterdir()) if is_folder else [source.path]
    for file in sorted(files):
        head, found = Source(file).head, [PIX4D_PART] if is_part(file) else []
        found += [of for pattern, *of in CONTENTS if re.search(pattern, head, re.MULTILINE)]
        if found:
            what, remedy = found[0]
            sentence = f"has {file.name}, {what}" if is_folder else f"is {what}"
            sentence += f", which pcfix does not read as cameras. {remedy}."
            raise bad_file(source.path, "cameras.not_read", sentence, what=what)

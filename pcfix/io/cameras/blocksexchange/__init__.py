"""BlocksExchange XML: ContextCapture, iTwin Capture Modeler, DJI Terra.

A block has photogroups, each with one lens and its photos. A rotation takes world axes to camera
axes, which `CameraOrientation` names by where x and y point in the image (XRightYDown, the
default, is x right, y down, z forward); it is a matrix M_ij by rows, or omega, phi, kappa with
M = (Rx Ry Rz)^T in those same camera axes. Yaw, pitch, roll (or heading) are refused, as their
definition could not be checked against a file. Component 1 is the block; photos of another one
are in a frame of their own.

Pixels start at the centre of the first pixel, so half a pixel is added to principal point and
measurements. The focal length is in mm with the largest side of the sensor, or in pixels; the
focal length down the image is `AspectRatio` times that, `Skew` is in pixels. P1 and P2 are in
Brown's order, x' = ... + P1 (r^2 + 2 x^2) + 2 P2 x y. A fisheye has a matrix and a polynomial
P0 + P1 q + P2 q^2 + ... of q = 2 theta / pi; without the matrix, it is pi / 2 times the focal
length. Places in mm (xmm, ymm) are in the camera axes, from the centre of the sensor for the
principal point and from the principal point for measurements.

Where the GNSS said that a photo was taken is in Pose/Metadata, or in the GPS of ExifData. Tie
points can be in a file of their own, and either file in a zip archive (.xmlz).

References: Bentley, ContextCapture User Guide, "BlocksExchange XML/XMLZ format", "Perspective
camera model", "Fisheye camera model"; Bentley developer documentation, "CC Orientations". The
order of P1 and P2 and the factor pi / 2 follow converters that cite those pages.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pcfix.io.cameras.blocksexchange.document import is_archive_of_block, read_document
from pcfix.io.cameras.blocksexchange.photos import read_photos
from pcfix.io.cameras.blocksexchange.ties import read_ties

if TYPE_CHECKING:
    from pcfix.io.cameras.formats import Source
    from pcfix.model import Cameras, TiePoints

__all__ = ["SOFTWARE", "read", "recognises", "tie_points"]

SOFTWARE = "BlocksExchange (ContextCapture, iTwin Capture, DJI Terra)"


def recognises(source: Source) -> bool:
    """Whether the root element is BlocksExchange, in a plain file or a zip archive."""
    return "<BlocksExchange" in source.text or is_archive_of_block(source)


def read(source: Source) -> Cameras:
    """Read poses and lenses, in the CRS of the block."""
    return read_photos(source.path, read_document(source.path)[0])[0]


def tie_points(source: Source, cameras: Cameras) -> TiePoints:
    """Read the tie points of the block; those of a CRS of their own lose their coordinates."""
    root, texts = read_document(source.path)
    return read_ties(source.path, texts, cameras, read_photos(source.path, root)[1])

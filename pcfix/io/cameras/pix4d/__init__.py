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

from typing import TYPE_CHECKING

from pcfix.io.cameras.pix4d.block import read_block
from pcfix.io.cameras.pix4d.files import first_line, holds_tables, is_project
from pcfix.io.cameras.pix4d.observations import read_observations

if TYPE_CHECKING:
    from pcfix.io.cameras.formats import Source
    from pcfix.model import Cameras, TiePoints

__all__ = ["SOFTWARE", "read", "recognises", "tie_points"]

SOFTWARE = "Pix4D"
HEADERS = (
    ["filename", "imagewidth", "imageheight"],
    ["imagename", "x", "y", "z", "omega", "phi", "kappa"],
    ["imagename", "longitude", "latitude", "altitude", "omega", "phi", "kappa"],
)


def recognises(source: Source) -> bool:
    """Whether a file begins like one of the tables or a project, or a folder holds a table."""
    if source.path.is_dir():
        return holds_tables(source.path)
    return is_project(source) or first_line(source.text).lower().split() in HEADERS


def read(source: Source) -> Cameras:
    """Read poses and lenses, in the CRS of the project."""
    return read_block(source)


def tie_points(source: Source, cameras: Cameras) -> TiePoints:
    """Read the image measurements; only control points have coordinates."""
    return read_observations(source, cameras)

"""Agisoft Metashape and PhotoScan: exported cameras or markers, and whole projects.

Read are the XML of *Export Cameras* and *Export Markers*, projects of one file (.psz, a zip) and
projects with a folder (.psx, whose documents lie in zips in ``<name>.files``).

Convention. ``camera/transform`` is a 4x4 matrix from the camera (x right, y down, z forward) to the
chunk, whose origin, axes and scale mean nothing. The ``transform`` of the camera's component, or of
the chunk, leads on to the world as s R X + t. With a CRS in ``reference`` the world is geocentric,
on the datum of that CRS, whatever its kind; heights there are ellipsoidal, and only the export to
that CRS brings a geoid in. With ``LOCAL_CS``, or no transform, the world is local. The image of a
slave camera (``master_id``) has the pose T_master [R, t], with the rotation and location of its
sensor in the master's frame, t in the unit of the chunk. EXIF orientations turn only what is
displayed: matrices and pixels are those of the image as stored.

The formulas of a calibration stand in `calibration`, markers and tie points in `ties`.

References: "Agisoft Metashape User Manual, Professional Edition", appendix "Camera models";
"Metashape Python Reference", Chunk.transform, Sensor.location, CoordinateSystem.geoccs;
``save_estimated_reference.py`` in github.com/agisoft-llc/metashape-scripts.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pcfix.io.cameras.metashape import documents, ties
from pcfix.io.cameras.metashape.block import read_block
from pcfix.io.cameras.metashape.calibration import read_calibration
from pcfix.io.cameras.metashape.positions import gnss_positions
from pcfix.model import Cameras

if TYPE_CHECKING:
    from pcfix.io.cameras.formats import Source
    from pcfix.model import TiePoints

__all__ = ["SOFTWARE", "read", "read_calibration", "recognises", "tie_points"]

SOFTWARE = "Agisoft Metashape"


def recognises(source: Source) -> bool:
    """Whether it is a document with a chunk, or a project that holds one."""
    return documents.recognises(source)


def read(source: Source) -> Cameras:
    """Read the aligned images of a chunk, in the world of that chunk.

    Parameters
    ----------
    source : Source
        An XML file, a .psx or .psz, or the ``.files`` folder of a .psx.

    Returns
    -------
    Cameras
        Geocentric with `project_crs` the CRS of the chunk, or in a ``local`` frame.

    Raises
    ------
    InputError
        If a document is missing or damaged, no image is aligned, or a number cannot be right.
    """
    chunk = documents.open_chunk(source.path)
    block = read_block(chunk)
    gnss, notes = gnss_positions(chunk, block)
    return Cameras(
        labels=tuple(image.label for image in block.images),
        centres=block.centres,
        rotations=block.rotations,
        lenses=block.lenses,
        crs=block.world.crs,
        project_crs=block.world.project_crs,
        gnss=gnss,
        unposed=block.unposed,
        notes=(*chunk.notes, *block.notes, *notes),
        source=chunk.software,
    )


def tie_points(source: Source, cameras: Cameras) -> TiePoints:
    """Read the tie points of a project, and the markers, with what was measured of them.

    Parameters
    ----------
    source : Source
    cameras : Cameras
        What `read` gave for the same source.

    Returns
    -------
    TiePoints
        First the tie points, then the markers; a marker has no position (NaN), as the file tells
        only where the survey put it. Projections that Metashape itself computed are left out.

    Raises
    ------
    InputError
        If there is nothing that two images saw, or a document is damaged.
    """
    chunk = documents.open_chunk(source.path)
    return ties.read(chunk, read_block(chunk), len(cameras))

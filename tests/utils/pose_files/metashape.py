"""Agisoft Metashape."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from tests.utils.pose_files.block import (
    Y_UP,
    PoseFile,
    geocentric_poses,
    omega_phi_kappa,
    words,
    yaw_pitch_roll,
)
from tests.utils.pose_files.lenses import metashape_calibration

if TYPE_CHECKING:
    from pathlib import Path

    from tests.utils.pose_files.block import Block

CHUNK_SCALE = 7.3
CHUNK_TURN = Rotation.from_euler("XYZ", [20.0, -35.0, 110.0], degrees=True).as_matrix()


def metashape_xml(
    path: Path, block: Block, centres: np.ndarray, rotations: np.ndarray, reference: str
) -> None:
    """Write poses of a world, by way of a chunk with a scale, turn and place of its own."""
    shift = centres.mean(axis=0) + np.array([11.0, -7.0, 3.0])
    in_chunk = (centres - shift) @ CHUNK_TURN / CHUNK_SCALE
    lines = []
    for i, label in enumerate(block.labels):
        matrix = np.eye(4)
        matrix[:3, :3] = CHUNK_TURN.T @ rotations[i].T
        matrix[:3, 3] = in_chunk[i]
        lines.append(
            f'<camera id="{i}" sensor_id="0" label="{label}">'
            f"<transform>{words(matrix)}</transform></camera>"
        )
    size = f'<resolution width="{block.width}" height="{block.height}"/>'
    path.write_text(
        '<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.0.0"><chunk label="c"'
        f' enabled="true"><sensors next_id="1"><sensor id="0" label="s" type="frame">{size}'
        f'<calibration type="frame" class="adjusted">{size}<f>{block.focal_px!r}</f></calibration>'
        f'</sensor></sensors><cameras next_id="{len(lines)}">{"".join(lines)}</cameras>'
        f"<transform><rotation>{words(CHUNK_TURN)}</rotation><translation>{words(shift)}"
        f"</translation><scale>{CHUNK_SCALE}</scale></transform><reference>{reference}</reference>"
        "</chunk></document>"
    )


def metashape_georeferenced(folder: Path, block: Block) -> PoseFile:
    path = folder / "cameras.xml"
    metashape_xml(path, block, *geocentric_poses(block), block.crs.to_wkt("WKT1_GDAL"))
    return PoseFile(path, {})


def metashape_local(folder: Path, block: Block) -> PoseFile:
    path = folder / "cameras.xml"
    reference = 'LOCAL_CS["Local",LOCAL_DATUM["Local Datum",0],UNIT["metre",1]]'
    metashape_xml(path, block, block.centres - block.origin, block.rotations, reference)
    return PoseFile(path, {"cameras_crs": "local", "cameras_offset": tuple(block.origin)})


def metashape_omega_phi_kappa(folder: Path, block: Block) -> PoseFile:
    names = ["PhotoID", *"XYZ", "Omega", "Phi", "Kappa"]
    names += [f"r{i}{j}" for i in "123" for j in "123"]
    lines = [f"# Cameras ({len(block.labels)})", f"# {', '.join(names)}"]
    for i, (label, centre, rotation) in enumerate(block.poses()):
        angles = omega_phi_kappa(block.rotations)[i]
        lines.append(label + "\t" + words(centre, angles, Y_UP @ rotation, by="\t"))
    path = folder / "opk.txt"
    path.write_text("\n".join(lines) + "\n")
    return PoseFile(path, {"sensor": metashape_calibration(folder, block)})


def metashape_reference(folder: Path, block: Block) -> PoseFile:
    """Write what the GNSS said, some metres off, beside the estimated poses."""
    places = [*("X/Easting", "Y/Northing", "Z/Altitude"), "Yaw", "Pitch", "Roll"]
    places += ["Accuracy_X/Y/Z_(m)", "Error_(m)", "X_error", "Y_error", "Z_error"]
    places += [f"{name}_est" for name in ("X", "Y", "Z", "Yaw", "Pitch", "Roll")]
    lines = [
        f"# CoordinateSystem: {block.crs.to_wkt('WKT1_GDAL')}", "#Label,Enable," + ",".join(places)
    ]  # fmt: skip
    angles = yaw_pitch_roll(block.rotations)
    for i, label in enumerate(block.labels):
        off = np.array([2.0, -3.0, 5.0])
        given = words(block.centres[i] + off, angles[i] + 4.0, 0.5, 6.2, off, by=",")
        lines.append(f"{label},1,{given},{words(block.centres[i], angles[i], by=',')}")
    path = folder / "reference.csv"
    path.write_text("\n".join(lines) + "\n")
    return PoseFile(path, {"sensor": metashape_calibration(folder, block)})

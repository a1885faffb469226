"""Plain tables."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tests.utils.pose_files.block import (
    PoseFile,
    aircraft_angles,
    omega_phi_kappa,
    quaternions,
    words,
    yaw_pitch_roll,
)
from tests.utils.pose_files.lenses import sensor_mm, sensor_px

if TYPE_CHECKING:
    from pathlib import Path

    from tests.utils.pose_files.block import Block


def write_table(folder: Path, block: Block, names: str, numbers: np.ndarray) -> Path:
    rows = np.column_stack([block.centres, numbers])
    lines = [f"label,x,y,z,{names}"]
    lines += [
        f"{label},{words(row, by=',')}" for label, row in zip(block.labels, rows, strict=True)
    ]
    path = folder / "cameras.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def table_yaw_pitch_roll(folder: Path, block: Block) -> PoseFile:
    """Write what pyBathySfM reads: the sensor is found beside the table."""
    sensor_mm(folder, block)
    angles = yaw_pitch_roll(block.rotations)
    return PoseFile(write_table(folder, block, "yaw,pitch,roll", angles), {})


def table_aircraft(folder: Path, block: Block) -> PoseFile:
    path = write_table(folder, block, "yaw,pitch,roll", aircraft_angles(block.rotations))
    return PoseFile(path, {"angles": "aircraft", "sensor": sensor_px(folder, block)})


def table_omega_phi_kappa(folder: Path, block: Block) -> PoseFile:
    path = write_table(folder, block, "omega,phi,kappa", omega_phi_kappa(block.rotations))
    return PoseFile(path, {"sensor": sensor_px(folder, block)})


def table_quaternion(folder: Path, block: Block) -> PoseFile:
    path = write_table(folder, block, "qw,qx,qy,qz", quaternions(block))
    return PoseFile(path, {"sensor": sensor_px(folder, block)})


def table_matrix(folder: Path, block: Block) -> PoseFile:
    names = ",".join(f"r{i}{j}" for i in "123" for j in "123")
    path = write_table(folder, block, names, block.rotations.reshape(-1, 9))
    return PoseFile(path, {"sensor": sensor_px(folder, block)})

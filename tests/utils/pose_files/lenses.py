"""The files beside poses: sensors, calibrations and images."""

from __future__ import annotations

import io
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from tests.utils.pose_files.block import words

if TYPE_CHECKING:
    from pathlib import Path

    from tests.utils.pose_files.block import Block


@lru_cache(maxsize=4)
def blank(width: int, height: int) -> bytes:
    stream = io.BytesIO()
    Image.new("1", (width, height)).save(stream, "PNG")
    return stream.getvalue()


def write_images(folder: Path, block: Block) -> None:
    """Write black images of the right size, which is all that a reader needs of them."""
    for label in block.labels:
        (folder / label).write_bytes(blank(block.width, block.height))


def sensor_px(folder: Path, block: Block) -> Path:
    path = folder / "lens.csv"
    numbers = f"{block.focal_px!r},{block.width},{block.height}"
    path.write_text(f"focal_px,width_px,height_px\n{numbers}\n")
    return path


def sensor_mm(folder: Path, block: Block) -> Path:
    """Write a sensor 13.2 mm wide."""
    mm = 13.2 / block.width
    path = folder / "sensor.csv"
    sides = words(mm * np.array([block.focal_px, block.width, block.height]), by=",")
    path.write_text(f"focal,sensor_x,sensor_y\n{sides}\n")
    return path


def metashape_calibration(folder: Path, block: Block) -> Path:
    path = folder / "calibration.xml"
    path.write_text(
        '<?xml version="1.0" encoding="UTF-8"?>\n<calibration><projection>frame</projection>'
        f"<width>{block.width}</width><height>{block.height}</height><f>{block.focal_px!r}</f>"
        "<cx>0</cx><cy>0</cy></calibration>"
    )
    return path

"""Software that writes sparse models: COLMAP, Bundler, VisualSFM, MicMac."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

import numpy as np

from tests.utils.pose_files.block import Y_UP, PoseFile, quaternions, words
from tests.utils.pose_files.lenses import write_images

if TYPE_CHECKING:
    from pathlib import Path

    from tests.utils.pose_files.block import Block


def shifted_poses(block: Block) -> tuple[np.ndarray, np.ndarray]:
    """Return quaternions and translations of a model that was brought near its origin."""
    shifted = block.centres - block.origin
    return quaternions(block), -np.einsum("kij,kj->ki", block.rotations, shifted)


def pinhole(block: Block) -> tuple[float, ...]:
    return block.focal_px, block.focal_px, block.width / 2, block.height / 2


def colmap_text(folder: Path, block: Block) -> PoseFile:
    lines = ["# Image list with two lines of data per image:"]
    for i, (q, t) in enumerate(zip(*shifted_poses(block), strict=True)):
        lines += [f"{i + 1} {words(q, t)} 1 {block.labels[i]}", ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    camera = f"1 PINHOLE {block.width} {block.height} {words(pinhole(block))}\n"
    (folder / "cameras.txt").write_text(camera)
    (folder / "points3D.txt").write_text("# 3D point list\n")
    return PoseFile(folder, {"cameras_offset": tuple(block.origin)})


def colmap_binary(folder: Path, block: Block) -> PoseFile:
    data = struct.pack("<Q", len(block.labels))
    for i, (q, t) in enumerate(zip(*shifted_poses(block), strict=True)):
        data += struct.pack("<I7dI", i + 1, *q, *t, 1)
        data += block.labels[i].encode() + b"\0" + struct.pack("<Q", 0)
    (folder / "images.bin").write_bytes(data)
    camera = struct.pack("<QIiQQ4d", 1, 1, 1, block.width, block.height, *pinhole(block))
    (folder / "cameras.bin").write_bytes(camera)
    (folder / "points3D.bin").write_bytes(struct.pack("<Q", 0))
    return PoseFile(folder, {"cameras_offset": tuple(block.origin)})


def bundler(folder: Path, block: Block) -> PoseFile:
    """Write a camera that looks along -z."""
    lines = ["# Bundle file v0.3", f"{len(block.labels)} 0"]
    for _, centre, rotation in block.poses():
        matrix = Y_UP @ rotation
        lines += [f"{block.focal_px!r} 0 0", *map(words, matrix), words(-matrix @ centre)]
    path = folder / "bundle.out"
    path.write_text("\n".join(lines) + "\n")
    (folder / "list.txt").write_text("\n".join(block.labels) + "\n")
    write_images(folder, block)
    return PoseFile(path, {})


def visual_sfm(folder: Path, block: Block) -> PoseFile:
    lines = ["NVM_V3 ", "", str(len(block.labels))]
    for label, q, centre in zip(block.labels, quaternions(block), block.centres, strict=True):
        lines.append(f"{label}\t{words(block.focal_px, q, centre)} 0 0 ")
    path = folder / "model.nvm"
    path.write_text("\n".join([*lines, "", "0", "", "0"]) + "\n")
    write_images(folder, block)
    return PoseFile(path, {})


def micmac(folder: Path, block: Block) -> PoseFile:
    """Write camera to world, and the lens in a file of its own."""
    folder = folder / "Ori-Block"
    folder.mkdir()
    middle = words(block.width / 2, block.height / 2)
    none = f"<ModRad><CDist>{middle}</CDist><CoeffDist>0</CoeffDist></ModRad>"
    (folder / "AutoCal_Foc-8800_Cam-Made.xml").write_text(
        '<?xml version="1.0" ?><ExportAPERO><CalibrationInternConique>'
        f"<KnownConv>eConvApero_DistM2C</KnownConv><PP>{middle}</PP><F>{block.focal_px!r}</F>"
        f"<SzIm>{block.width} {block.height}</SzIm><CalibDistortion>{none}</CalibDistortion>"
        "</CalibrationInternConique></ExportAPERO>"
    )
    for label, centre, rotation in block.poses():
        rows = "".join(f"<L{i + 1}>{words(row)}</L{i + 1}>" for i, row in enumerate(rotation.T))
        (folder / f"Orientation-{label}.xml").write_text(
            '<?xml version="1.0" ?><ExportAPERO><OrientationConique><TypeProj>eProjStenope'
            "</TypeProj><FileInterne>Ori-Block/AutoCal_Foc-8800_Cam-Made.xml</FileInterne>"
            "<RelativeNameFI>true</RelativeNameFI><Externe><KnownConv>eConvApero_DistM2C"
            f"</KnownConv><Centre>{words(centre)}</Centre><ParamRotation><CodageMatr>{rows}"
            "</CodageMatr></ParamRotation></Externe></OrientationConique></ExportAPERO>"
        )
    return PoseFile(folder, {})

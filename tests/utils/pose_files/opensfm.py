"""OpenSfM, and OpenDroneMap, which reconstructs with it."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from tests.utils.pose_files.block import PoseFile, convergence, to_degrees, topocentric_poses, words

if TYPE_CHECKING:
    from pathlib import Path

    from tests.utils.pose_files.block import Block


def opensfm_camera(block: Block) -> dict[str, Any]:
    share = block.focal_px / max(block.width, block.height)
    return {
        **{"projection_type": "brown", "width": block.width, "height": block.height},
        **{"focal_x": share, "focal_y": share, "c_x": 0.0, "c_y": 0.0},
        **dict.fromkeys(("k1", "k2", "k3", "p1", "p2"), 0.0),
    }


def write_reconstruction(
    path: Path, block: Block, lla: tuple[float, float, float], poses: Any
) -> None:
    path.parent.mkdir(exist_ok=True)
    shots = {}
    for label, centre, rotation in zip(block.labels, *poses, strict=True):
        turn = Rotation.from_matrix(rotation).as_rotvec().tolist()
        shift = (-rotation @ centre).tolist()
        shots[label] = {"rotation": turn, "translation": shift, "camera": "v2 made up"}
    reference = dict(zip(("latitude", "longitude", "altitude"), lla, strict=True))
    cameras = {"v2 made up": opensfm_camera(block)}
    whole = {"cameras": cameras, "shots": shots, "points": {}, "reference_lla": reference}
    path.write_text(json.dumps([whole]))


def opensfm(folder: Path, block: Block) -> PoseFile:
    lat, lon, height, *poses = topocentric_poses(block)
    path = folder / "reconstruction.json"
    write_reconstruction(path, block, (lat, lon, height), poses)
    return PoseFile(path, {})


def odm_crs(block: Block) -> str:
    """Return the CRS as in proj.txt: ODM knows UTM zones best."""
    if 32601 <= block.epsg <= 32660:
        zone = block.epsg - 32600
        return f"+proj=utm +zone={zone} +datum=WGS84 +units=m +no_defs +type=crs"
    return f"EPSG:{block.epsg}"


def odm_shots(folder: Path, block: Block) -> PoseFile:
    for name in ("odm_report", "odm_georeferencing"):
        (folder / name).mkdir()
    share = block.focal_px / max(block.width, block.height)
    features = []
    lon_lat = to_degrees(block, block.centres)
    for i, (label, centre, rotation) in enumerate(block.poses()):
        turn = Rotation.from_matrix(rotation).as_rotvec().tolist()
        frame = {"focal": share, "width": block.width, "height": block.height}
        place = [*lon_lat[i].tolist(), centre[2]]
        properties = {
            "filename": label, **frame, "translation": centre.tolist(), "rotation": turn
        }  # fmt: skip
        geometry = {"type": "Point", "coordinates": place}
        features.append({"type": "Feature", "properties": properties, "geometry": geometry})
    shots = {"type": "FeatureCollection", "features": features}
    (folder / "odm_report" / "shots.geojson").write_text(json.dumps(shots))
    (folder / "cameras.json").write_text(json.dumps({"made up": opensfm_camera(block)}))
    x, y, _ = block.origin
    coords = f"{odm_crs(block)}\n{x:.0f} {y:.0f}\n"
    (folder / "odm_georeferencing" / "coords.txt").write_text(coords)
    (folder / "odm_georeferencing" / "proj.txt").write_text(odm_crs(block))
    return PoseFile(folder, {})


def odm_reconstruction(folder: Path, block: Block) -> PoseFile:
    """Write newer ODM's frame: the axes of the map, from a reference at whole metres."""
    odm_shots(folder, block)
    (folder / "odm_report" / "shots.geojson").unlink()
    x, y, _ = block.origin
    lon, lat = to_degrees(block, block.origin).tolist()
    poses = block.centres - [x, y, 0.0], block.rotations
    path = folder / "opensfm" / "reconstruction.json"
    write_reconstruction(path, block, (lat, lon, 0.0), poses)
    return PoseFile(folder, {})


def odm_topocentric(folder: Path, block: Block) -> PoseFile:
    """Write ODM's frame up to 2020, and the matrix that makes map coordinates of it.

    It turns by the convergence at the reference, and scales in plan alone.
    """
    odm_shots(folder, block)
    (folder / "odm_report" / "shots.geojson").unlink()
    matrix, shift = np.diag([0.9996, 0.9996, 1.0]), block.origin * [1.0, 1.0, 0.0]
    matrix = matrix @ convergence(block, block.origin[None])[0]
    centres = (block.centres - shift) @ np.linalg.inv(matrix).T
    rotations = block.rotations @ convergence(block, block.origin[None])[0]
    lon, lat = to_degrees(block, block.origin).tolist()
    path = folder / "opensfm" / "reconstruction.json"
    write_reconstruction(path, block, (lat, lon, 0.0), (centres, rotations))
    rows = np.vstack([np.column_stack([matrix, shift]), [0.0, 0.0, 0.0, 1.0]])
    text = "\n".join(words(row) for row in rows)
    (folder / "opensfm" / "geocoords_transformation.txt").write_text(text)
    return PoseFile(folder, {})

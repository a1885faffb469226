"""OPF, by its published specification: a project, its parts, and tracks in a glTF model."""

import json
from pathlib import Path
from typing import Any, NamedTuple
from uuid import NAMESPACE_URL, uuid5

import numpy as np
from scipy.spatial.transform import Rotation

from pcfix.model import Cameras

FIRST_ID, SENSOR_ID = 18_000_000_000_000_000_000, 7  # ids are unsigned numbers of 64 bits
FLOAT, UNSIGNED = 5126, 5125


class Base(NamedTuple):
    """A CRS, whether its first axis is north, and metres in a unit of plan and of height."""

    definition: str
    north_first: bool = False
    plan_m: float = 1.0
    up_m: float = 1.0


def opf(folder: Path, block: Cameras, base: Base | None = None, ties: Any = None) -> Path:
    """Write a block whose centres are east, north, up in metres, with tracks if there are some.

    `ties` are points (m, 3), and of each observation its point, its camera, u and v. The lens is
    that of the first camera, without distortion, its principal point in the middle.
    """
    base, frame = base or Base(str(block.crs)), block.lenses[0]
    shift, size = shift_of(block), [frame.width, frame.height]
    up_back = (np.diag([1.0, -1.0, -1.0]) @ block.rotations).transpose(0, 2, 1)
    omega_phi_kappa = Rotation.from_matrix(up_back).as_euler("XYZ", degrees=True)
    # to the isometric frame from base coordinates: times the scale, exchanged, plus the shift
    scale = [base.plan_m, base.plan_m, base.up_m]
    cameras = [
        {
            "id": FIRST_ID + i,
            "sensor_id": SENSOR_ID,
            "position": (centre + shift).tolist(),
            "orientation_deg": angles.tolist(),
        }
        for i, (centre, angles) in enumerate(zip(block.centres, omega_phi_kappa, strict=True))
    ]
    lens = {
        "type": "perspective",
        "principal_point_px": [frame.width / 2, frame.height / 2],
        "focal_length_px": frame.focal,
        "radial_distortion": [0.0, 0.0, 0.0],
        "tangential_distortion": [0.0, 0.0],
    }
    sensor = {"id": SENSOR_ID, "name": "one", "image_size_px": size}
    parts = {
        "camera_list": ("camera-list", {"cameras": [
            {"id": FIRST_ID + i, "uri": f"file:///c:/my%20flight/{label}"}
            for i, label in enumerate(block.labels)
        ]}),
        "input_cameras": ("input-cameras", {"sensors": [
            {**sensor, "pixel_size_um": 2.4, "internals": lens, "shutter_type": "global",
             "bands": [{"name": "Grey", "weight": 1.0}]}
        ], "captures": []}),
        "scene_reference_frame": ("scene-reference-frame", {
            "crs": {"definition": base.definition},
            "base_to_canonical": {
                "shift": shift.tolist(), "scale": scale, "swap_xy": base.north_first
            },
        }),
        "calibration": ("calibrated-cameras", {
            "cameras": cameras, "sensors": [{"id": SENSOR_ID, "internals": lens}]
        }),
    }  # fmt: skip
    items = []
    for kind, (name, content) in parts.items():
        form = f"application/opf-{name}+json"
        write_json(folder / f"{name}.json", {"format": form, "version": "1.0", **content})
        resources = [{"uri": f"{name}.json", "format": form}]
        if kind == "calibration" and ties is not None:
            write_tracks(folder, shift, ties)
            resources.append({"uri": "tracks.gltf", "format": "model/gltf+json"})
        items.append({"id": uuid(kind), "type": kind, "resources": resources, "sources": []})
    project = {
        "format": "application/opf-project+json", "version": "1.0", "id": uuid("a"), "name": "one",
        "description": "", "generator": {"name": "PIX4Dmatic", "version": "1.6"}, "items": items,
    }  # fmt: skip
    write_json(folder / "project.opf", project)
    return folder / "project.opf"


def shift_of(block: Cameras) -> np.ndarray:
    """Return the shift from the map to the processing frame, near whole metres, (3,)."""
    return -np.round(block.centres.mean(axis=0)) - [0.25, 0.5, 0.125]


def uuid(name: str) -> str:
    return str(uuid5(NAMESPACE_URL, name))


def write_json(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=1))


def write_tracks(folder: Path, shift: np.ndarray, ties: Any) -> None:
    """Write tracks whose scene has y up, about a place of their own."""
    xyz, point, camera, uv = ties
    middle = np.round(np.median(xyz + shift, axis=0))
    order = np.argsort(point, kind="stable")
    count = np.bincount(point, minlength=len(xyz))
    first = np.cumsum(count) - count
    packed = b"".join(
        int(a).to_bytes(5, "little") + int(b).to_bytes(3, "little")
        for a, b in zip(first, count, strict=True)
    )
    buffers = {
        "positions": ((xyz + shift - middle).astype("<f4").tobytes(), FLOAT, "VEC3", len(xyz)),
        "ranges": (packed, UNSIGNED, "VEC2", len(xyz)),
        "ids": (camera[order].astype("<u4").tobytes(), UNSIGNED, "SCALAR", len(point)),
        "pixels": (uv[order].astype("<f4").tobytes(), FLOAT, "VEC2", len(point)),
        "features": (bytes(8 * len(point)), UNSIGNED, "VEC2", len(point)),
        "scales": (np.ones(len(point), "<f4").tobytes(), FLOAT, "SCALAR", len(point)),
    }
    for name, (data, *_) in buffers.items():
        (folder / f"{name}.bin").write_bytes(b"past" + data)
    x, y, z = middle.tolist()
    matches = {
        "cameraUids": [FIRST_ID + i for i in range(int(camera.max()) + 1)], "cameraIds": 2,
        "pointIndexRanges": 1,
        "imagePoints": {"pixelCoordinates": 3, "featureIds": 4, "scales": 5},
    }  # fmt: skip
    primitive = {
        "attributes": {"POSITION": 0}, "mode": 0,
        "extensions": {"OPF_mesh_primitive_matches": matches},
    }  # fmt: skip
    model = {
        "asset": {"version": "2.0", "extensions": {"OPF_asset_version": {"version": "1.0"}}},
        "scene": 0, "scenes": [{"nodes": [0]}],
        # by columns: x, y, z go to x, z, -y
        "nodes": [{"mesh": 0, "matrix": [1, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 0, x, z, -y, 1]}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": [
            {"bufferView": i, "componentType": kind, "type": wide, "count": n}
            for i, (_, kind, wide, n) in enumerate(buffers.values())
        ],
        "bufferViews": [
            {"buffer": i, "byteLength": len(data), "byteOffset": 4}
            for i, (data, *_) in enumerate(buffers.values())
        ],
        "buffers": [
            {"uri": f"{name}.bin", "byteLength": len(data) + 4}
            for name, (data, *_) in buffers.items()
        ],
    }  # fmt: skip
    write_json(folder / "tracks.gltf", model)

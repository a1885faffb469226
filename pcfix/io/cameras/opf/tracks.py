"""The tracks of a calibration: a glTF model and its buffers."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote

import numpy as np

from pcfix.errors import InputError, NoTiePointsError
from pcfix.io.cameras.checks import load_json, mapping, vector
from pcfix.io.cameras.formats import Source
from pcfix.io.cameras.opf.project import Part, frame_of, id_of, objects, open_project, text_of
from pcfix.io.cameras.tracks import tie_points as gathered
from pcfix.model import Cameras, FloatArray, IntArray, TiePoints

COMPONENTS = {"5121": "u1", "5123": "<u2", "5125": "<u4", "5126": "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
MATCHES = "OPF_mesh_primitive_matches"
OFFSET_BITS = 40


class Matches(NamedTuple):
    """Points of a node, and of each match its point, its camera (-1: not posed) and its place."""

    xyz: FloatArray
    point: IntArray
    camera: IntArray
    uv: FloatArray


def tie_points(source: Source, cameras: Cameras) -> TiePoints:
    """Read the tracks of the calibration."""
    project = open_project(source.path)
    path, calibrated = project.part("calibration", "calibrated-cameras")
    row_of = {id_of(path, shot): i for i, shot in enumerate(objects(path, calibrated, "cameras"))}
    models = project.files("calibration", "model/gltf+json")
    found = [node for model in models for node in _nodes(model, row_of)]
    if not any((node.camera >= 0).any() for node in found):
        raise NoTiePointsError(
            f"{project.path}: its calibration has no tracks in its {len(cameras)} images, and so"
            " no tie points."
        )
    before = np.cumsum([0, *(len(node.xyz) for node in found)])
    return gathered(
        frame_of(project).enter(np.concatenate([node.xyz for node in found])),
        np.concatenate([node.point + n for node, n in zip(found, before, strict=False)]),
        np.concatenate([node.camera for node in found]),
        np.concatenate([node.uv for node in found]),
    )


def _nodes(path: Path, row_of: dict[int, int]) -> Iterator[Matches]:
    """Yield the points and matches of the nodes of a model."""
    if not path.is_file():
        raise InputError(f"{path}: is missing; keep all files of the project together.")
    model = mapping(path, "the file", load_json(path))
    meshes = objects(path, model, "meshes")
    for node in objects(path, model, "nodes"):
        for primitive in objects(path, _at(path, meshes, node.get("mesh"), "mesh"), "primitives"):
            inner = mapping(path, "extensions", primitive.get("extensions", {}))
            matches = mapping(path, MATCHES, inner.get(MATCHES, {}))
            images = mapping(path, "imagePoints", matches.get("imagePoints", {}))
            if "pixelCoordinates" in images:
                attributes = mapping(path, "attributes", primitive.get("attributes"))
                xyz = _accessor(path, model, attributes.get("POSITION"), 3).astype(np.float64)
                uv = _accessor(path, model, images["pixelCoordinates"], 2).astype(np.float64)
                at, point, camera = _matched(path, model, matches, row_of)
                if len(point) and (at.max() >= len(uv) or point.max() >= len(xyz)):
                    raise _torn(path)
                yield Matches(_z_up(path, node, xyz), point, camera, uv[at])


def _matched(
    path: Path, model: Part, matches: Part, row_of: dict[int, int]
) -> tuple[IntArray, IntArray, IntArray]:
    """Return the rows of matches that points have, which point each is of, and its camera."""
    ranges = _accessor(path, model, matches.get("pointIndexRanges"), 2).astype(np.uint64)
    packed = ranges[:, 0] | ranges[:, 1] << np.uint64(32)
    first = (packed & np.uint64(2**OFFSET_BITS - 1)).astype(np.int64)
    count = (packed >> np.uint64(OFFSET_BITS)).astype(np.int64)
    index = _accessor(path, model, matches.get("cameraIds"), 1)[:, 0].astype(np.int64)
    ids = matches.get("cameraUids")
    known = ids if isinstance(ids, list) else []
    rows = [row_of.get(i, -1) if isinstance(i, int) else -1 for i in known]
    if (first + count > len(index)).any() or (index >= len(rows)).any():
        raise _torn(path)
    point = np.repeat(np.arange(len(count)), count)
    at = np.arange(len(point)) + np.repeat(first - (np.cumsum(count) - count), count)
    return at, point, np.array(rows, np.int64)[index[at]]


def _torn(path: Path) -> InputError:
    return InputError(f"{path}: its matches do not fit its points; export the project again.")


def _z_up(path: Path, node: Part, xyz: FloatArray) -> FloatArray:
    """Return points of a node in the processing CRS; the model itself has y up."""
    given = node.get("matrix", np.eye(4).ravel().tolist())
    matrix = vector(path, "matrix of a node", given, 16).reshape(4, 4).T
    x, y, z = (xyz @ matrix[:3, :3].T + matrix[:3, 3]).T
    return np.column_stack([x, -z, y])


def _at(path: Path, values: list[Part], index: Any, name: str) -> Part:
    if not isinstance(index, int) or not 0 <= index < len(values):
        raise InputError(f"{path}: has no {name} {index!r:.40}; the file is damaged, export again.")
    return values[index]


def _accessor(path: Path, model: Part, index: Any, width: int) -> Any:
    """Return the rows of an accessor, from the file of its buffer."""
    accessor = _at(path, objects(path, model, "accessors"), index, "accessor")
    view = _at(path, objects(path, model, "bufferViews"), accessor.get("bufferView"), "bufferView")
    buffer = _at(path, objects(path, model, "buffers"), view.get("buffer"), "buffer")
    kind, wide = COMPONENTS.get(str(accessor.get("componentType"))), accessor.get("type")
    start, count = view.get("byteOffset", 0), accessor.get("count")
    whole = all(isinstance(value, int) and value >= 0 for value in (start, count))
    if kind is None or count is None or WIDTHS.get(str(wide)) != width or not whole:
        raise InputError(f"{path}: accessor {index} is not {width} numbers a row; export it again.")
    where = path.parent / unquote(text_of(path, buffer, "uri"))
    size = np.dtype(kind).itemsize * width * int(count)
    data = where.read_bytes()[start : start + size] if where.is_file() else b""
    if len(data) < size:
        raise InputError(f"{where}: is missing or cut off; keep all files of the project together.")
    return np.frombuffer(data, kind).reshape(int(count), width)

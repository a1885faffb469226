"""The aligned images of a chunk: poses, lenses, and the way from the chunk to the world."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from pcfix.errors import PcfixWarning
from pcfix.io.cameras import checks
from pcfix.io.cameras.checks import damaged, number, numbers
from pcfix.io.cameras.metashape import sensors
from pcfix.io.cameras.metashape.documents import Chunk
from pcfix.io.crs import METRES, crs_text, is_local, parse_crs, shortened, unbound
from pcfix.model import Cameras, FloatArray, Lens


@dataclass(frozen=True, eq=False)
class Similarity:
    """world = scale rotation X + translation."""

    scale: float
    rotation: FloatArray
    translation: FloatArray

    def points(self, xyz: FloatArray) -> FloatArray:
        """Return points of the chunk, shape (n, 3), in the world."""
        return np.asarray(self.scale * xyz @ self.rotation.T + self.translation)


IDENTITY = Similarity(1.0, np.eye(3), np.zeros(3))


def _similarity(path: Path, element: Element | None) -> Similarity | None:
    """Return a transform of three parts, or of one 4x4 matrix that holds the scale too."""
    if element is None:
        return None
    where = "transform of the chunk"
    scale, rotation, translation = 1.0, np.eye(3), np.zeros(3)
    if (element.text or "").strip():
        matrix = numbers(path, where, element.text, 16).reshape(4, 4)
        scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
        rotation, translation = matrix[:3, :3] / (scale or 1.0), matrix[:3, 3]
    else:
        given = {tag: element.findtext(tag) for tag in ("scale", "rotation", "translation")}
        if not any(text is not None for text in given.values()):
            return None
        if given["scale"] is not None:
            scale = number(path, where, given["scale"])
        if given["rotation"] is not None:
            rotation = numbers(path, where, given["rotation"], 9).reshape(3, 3)
        if given["translation"] is not None:
            translation = numbers(path, where, given["translation"], 3)
    rotation = checks.rotations(path, [where], rotation)[0]
    if not scale > 0.0:
        raise damaged(path, f"{where}: the scale {scale:g} is not positive")
    return Similarity(scale, rotation, translation)


def _world(path: Path, chunk: Element) -> tuple[str, str | None, tuple[PcfixWarning, ...]]:
    """Return the frame that a chunk's transforms lead to, its CRS if another, and notes on them."""
    text = (chunk.findtext("reference") or "").strip()
    if not text or text.upper() == "LOCAL":
        return "local", None, ()
    crs = parse_crs(text, str(path))
    if is_local(crs):
        unit = crs.axis_info[0].unit_name
        sentence = (
            f"{path}: the local coordinates of the chunk are in {unit}, its transform in metres."
            " Scale a cloud that was exported in that unit."
        )
        note = PcfixWarning("cameras.local_unit", sentence, unit=unit)
        return "local", None, () if unit in METRES else (note,)
    base = None if crs.geodetic_crs is None else unbound(crs.geodetic_crs)
    if base is None:
        remedy = "Set it again in Metashape's reference settings"
        raise checks.unsupported(path, f"the CRS {shortened(text)}, which has no datum,", remedy)
    frame = crs_text(type(crs).from_json_dict(_geocentric(base.to_json_dict())))
    return frame, frame if crs.is_geocentric else text, ()


def _geocentric(base: dict[str, Any]) -> dict[str, Any]:
    """Return the geocentric CRS, as PROJJSON, on the datum of another."""
    axes = [
        {"name": f"Geocentric {a}", "abbreviation": a, "direction": f"geocentric{a}"} for a in "XYZ"
    ]
    return {
        "$schema": base["$schema"],
        "type": "GeodeticCRS",
        "name": base["name"],
        **{key: base[key] for key in ("datum", "datum_ensemble") if key in base},
        "coordinate_system": {
            "subtype": "Cartesian",
            "axis": [{**axis, "unit": "metre"} for axis in axes],
        },
    }


class Image(NamedTuple):
    """An image and the elements that speak of it; `component` is where its pose is at home."""

    id: str
    label: str
    element: Element
    sensor: Element | None
    component: str | None


class Block(NamedTuple):
    """The images with a pose, in the order of the file, and how the chunk lies in the world."""

    images: list[Image]
    places: list[Similarity]
    cameras: Cameras


def read_block(chunk: Chunk) -> Block:
    """Read the images of a chunk.

    Left out are images that are not aligned, disabled (they took no part in the dense cloud), not
    of a central projection, or in a component without a place in the frame of the others.
    """
    path, element = chunk.path, chunk.element
    images = _images(element)
    poses = _poses(path, images)
    kept, places, why = _select(path, element, [image for image in images if image.id in poses])
    if not kept:
        chunk_name = element.get("label") or "without a name"
        rest = ", ".join([f"{len(images) - len(poses)} are not aligned", *why])
        raise checks.no_pose(path, f"of the {len(images)} images of chunk {chunk_name} {rest}")
    local = IDENTITY in places
    crs, project_crs, of_world = ("local", None, ()) if local else _world(path, element)
    centres, rotations = _in_world([poses[image.id] for image in kept], places)
    lenses, of_lenses = _lenses(path, kept)
    chosen = {image.id for image in kept}
    cameras = Cameras(
        labels=tuple(image.label for image in kept),
        centres=centres,
        rotations=rotations,
        lenses=lenses,
        crs=crs,
        project_crs=project_crs,
        unposed=tuple(image.label for image in images if image.id not in chosen),
        notes=(
            *(PcfixWarning("cameras.left_out", f"{path}: {one}; left out.") for one in why),
            *of_lenses,
            *of_world,
        ),
        source=chunk.software,
    )
    return Block(kept, places, cameras)


def _images(chunk: Element) -> list[Image]:
    """Return the photos of a chunk, also those in groups; keyframes of animations are none."""
    found = {sensor.get("id"): sensor for sensor in chunk.iterfind("sensors/sensor")}
    listed = {
        number: component.get("id")
        for component in chunk.iterfind("components/component")
        for ids in component.iter("camera_ids")
        for number in (ids.text or "").split()
    }
    homes: dict[str, str | None] = {}
    images: list[Image] = []
    for camera in chunk.iterfind("cameras//camera"):
        if camera.get("type", "regular") == "regular":
            number = camera.get("id") or f"#{len(images)}"
            label = camera.get("label") or f"number {number}"
            home = camera.get("component_id") or listed.get(number)
            homes[number] = home or homes.get(camera.get("master_id") or "")
            sensor = found.get(camera.get("sensor_id"))
            images.append(Image(number, label, camera, sensor, homes[number]))
    return images


def _poses(path: Path, images: list[Image]) -> dict[str, FloatArray]:
    """Return camera to chunk, 4x4, of each image that is aligned or whose master is."""
    aligned = [image for image in images if (image.element.findtext("transform") or "").strip()]
    masters = dict(zip((image.id for image in aligned), _matrices(path, aligned), strict=True))
    offsets: dict[Element, FloatArray] = {}
    poses = dict(masters)
    for image in images:
        master = masters.get(image.element.get("master_id") or "")
        if image.id in masters or master is None or image.sensor is None:
            continue
        if image.sensor not in offsets:
            offsets[image.sensor] = sensors.offset_of(path, image.sensor)
        poses[image.id] = master @ offsets[image.sensor]
    return poses


def _matrices(path: Path, images: list[Image]) -> FloatArray:
    """Return the transforms of images, shape (k, 4, 4), with proper rotations."""
    rows = [
        numbers(path, f"image {image.label}, transform", image.element.findtext("transform"), 16)
        for image in images
    ]
    matrices = np.array(rows).reshape(-1, 4, 4)
    turns = matrices[:, :3, :3]
    checks.rotations(path, [image.label for image in images], turns)
    u, _, v = np.linalg.svd(turns)
    matrices[:, :3, :3] = u @ v
    return matrices


def _select(
    path: Path, chunk: Element, posed: list[Image]
) -> tuple[list[Image], list[Similarity], list[str]]:
    """Return the images to use, the way of each to the world, and what the others are."""
    kept, places = [], []
    why: Counter[str] = Counter()
    for image, place in zip(posed, _places(path, chunk, posed), strict=True):
        if image.element.get("enabled") == "false":
            why["aligned but disabled"] += 1
        elif image.sensor is not None and not sensors.is_central(image.sensor):
            kind = sensors.kind_of(image.sensor)
            why[f"of a {kind} sensor, for which there is no lens"] += 1
        elif place is None:
            why["in a component that has no transform to the frame of the others"] += 1
        else:
            kept.append(image)
            places.append(place)
    return kept, places, [f"{count} images are {reason}" for reason, count in why.items()]


def _places(path: Path, chunk: Element, posed: list[Image]) -> list[Similarity | None]:
    """Return the way of each image to the world, None where its component has no place in it.

    Every component has a frame of its own. One with a transform has a place in the world; one
    without has that of the chunk when it is the active or only one, as the chunk's transform is
    that of its active component. Where none has a place, the world is the frame of the chunk.
    """
    of_chunk = _similarity(path, chunk.find("transform"))
    components = chunk.findall("components/component")
    own = {c.get("id"): _similarity(path, c.find("transform")) for c in components}
    parent = chunk.find("components")
    active = None if parent is None else parent.get("active_id")
    main = active if active in own else next(iter(own), None)
    in_chunk = [i.component in (None, main) or i.component not in own for i in posed]
    places = [
        own.get(image.component) or (of_chunk if is_main else None)
        for image, is_main in zip(posed, in_chunk, strict=True)
    ]
    if any(places):
        return places
    return [IDENTITY if is_main else None for is_main in in_chunk]


def _in_world(poses: list[FloatArray], places: list[Similarity]) -> tuple[FloatArray, FloatArray]:
    """Return centres, shape (k, 3), and rotations world to camera, (k, 3, 3)."""
    to_chunk = np.array(poses)
    turn = np.array([place.rotation for place in places])
    scale = np.array([place.scale for place in places])
    shift = np.array([place.translation for place in places])
    centres = scale[:, None] * np.einsum("kij,kj->ki", turn, to_chunk[:, :3, 3]) + shift
    return centres, np.ascontiguousarray((turn @ to_chunk[:, :3, :3]).transpose(0, 2, 1))


def _lenses(path: Path, images: list[Image]) -> tuple[tuple[Lens, ...], list[PcfixWarning]]:
    """Return the lens of each image, one object per sensor, and notes."""
    found: dict[Element | None, Lens] = {}
    notes: list[PcfixWarning] = []
    for image in images:
        if image.sensor is None:
            raise damaged(path, f"sensor {image.element.get('sensor_id')} is missing")
        if image.sensor not in found:
            found[image.sensor] = sensors.lens_of(path, image.sensor, image.label)
            notes.extend(sensors.notes_on(path, image.sensor))
    return tuple(found[image.sensor] for image in images), notes

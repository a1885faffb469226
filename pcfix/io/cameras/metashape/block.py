"""The aligned images of a chunk: poses, lenses, and the way from the chunk to the world."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree.ElementTree import Element

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras import checks
from pcfix.io.cameras.checks import ROUNDING, number, numbers
from pcfix.io.cameras.metashape import sensors
from pcfix.io.cameras.metashape.documents import Chunk
from pcfix.io.crs import METRES, crs_text, is_local, parse_crs, shortened, unbound
from pcfix.model import FloatArray, Lens

if TYPE_CHECKING:
    from pyproj import CRS


@dataclass(frozen=True)
class World:
    """The frame of the centres, and the CRS of the chunk where that is another."""

    crs: str
    project_crs: str | None = None


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


class Placements:
    """Where each component of a chunk goes.

    Every component has a frame of its own. One with a transform has a place in the world; one
    without has that of the chunk when it is the active or only one, as the chunk's transform is
    that of its active component.
    """

    def __init__(self, path: Path, chunk: Element) -> None:
        parent = chunk.find("components")
        components = [] if parent is None else parent.findall("component")
        ids = [component.get("id") for component in components]
        active = None if parent is None else parent.get("active_id")
        self._main = active if active in ids or not ids else ids[0]
        self._chunk = _similarity(path, chunk.find("transform"))
        self._own = {c.get("id"): _similarity(path, c.find("transform")) for c in components}

    def is_main(self, component: str | None) -> bool:
        """Whether images of this component are in the frame of the chunk."""
        return component is None or component == self._main or component not in self._own

    def of(self, component: str | None) -> Similarity | None:
        """Return the way to the world, or None where the component has no place in it."""
        own = self._own.get(component)
        if own is not None:
            return own
        return self._chunk if self.is_main(component) else None


def _similarity(path: Path, element: Element | None) -> Similarity | None:
    """Return a transform of three parts, or of one 4x4 matrix that holds the scale too."""
    if element is None:
        return None
    where = "transform of the chunk"
    if (element.text or "").strip():
        matrix = numbers(path, where, element.text, 16).reshape(4, 4)
        scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
        return _checked(path, scale, matrix[:3, :3] / (scale or 1.0), matrix[:3, 3])
    rotation, translation, scale_of = (
        element.find(n) for n in ("rotation", "translation", "scale")
    )
    if rotation is None and translation is None and scale_of is None:
        return None
    return _checked(
        path,
        1.0 if scale_of is None else number(path, where, scale_of.text),
        np.eye(3) if rotation is None else numbers(path, where, rotation.text, 9).reshape(3, 3),
        np.zeros(3) if translation is None else numbers(path, where, translation.text, 3),
    )


def _checked(path: Path, scale: float, rotation: FloatArray, translation: FloatArray) -> Similarity:
    """Return the transform with the rotation next to the given one."""
    off = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if not (scale > 0.0 and off <= ROUNDING and np.linalg.det(rotation) > 0.0):
        raise InputError(
            f"{path}: the transform of the chunk is not a rotation with one positive scale (scale"
            f" {scale:g}); export the cameras again."
        )
    u, _, v = np.linalg.svd(rotation)
    return Similarity(scale, u @ v, translation)


def world_of(path: Path, chunk: Element) -> tuple[World, tuple[str, ...]]:
    """Return the world that the transforms of a chunk lead to, and notes on it."""
    text = (chunk.findtext("reference") or "").strip()
    if not text or text.upper() == "LOCAL":
        return World("local"), ()
    crs = parse_crs(text, str(path))
    if is_local(crs):
        return World("local"), _unit_notes(path, crs)
    base = None if crs.geodetic_crs is None else unbound(crs.geodetic_crs)
    if base is None:
        raise InputError(
            f"{path}: the CRS of the chunk, {shortened(text)}, has no datum; set it again in"
            " Metashape's reference settings."
        )
    frame = crs_text(type(crs).from_json_dict(_geocentric(base.to_json_dict())))
    return World(frame, frame if crs.is_geocentric else text), ()


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


def _unit_notes(path: Path, crs: CRS) -> tuple[str, ...]:
    unit = crs.axis_info[0].unit_name
    if unit in METRES:
        return ()
    return (
        f"{path}: the local coordinates of the chunk are in {unit}; its transform is in metres, so"
        " that a cloud exported in that unit has to be scaled.",
    )


@dataclass(frozen=True)
class Image:
    """An image and the elements that speak of it; `component` is where its pose is at home."""

    id: str
    label: str
    element: Element
    sensor: Element | None
    component: str | None


@dataclass(frozen=True, eq=False)
class Block:
    """The images with a pose, in the order of the file, and how the chunk lies in the world."""

    images: tuple[Image, ...]
    places: tuple[Similarity, ...]
    centres: FloatArray
    rotations: FloatArray
    lenses: tuple[Lens, ...]
    world: World
    unposed: tuple[str, ...]
    notes: tuple[str, ...]


def read_block(chunk: Chunk) -> Block:
    """Read the images of a chunk.

    Left out are images that are not aligned, disabled (they took no part in the dense cloud), not
    of a central projection, or in a component without a place in the frame of the others.
    """
    path, element = chunk.path, chunk.element
    images = _images(element)
    poses = _poses(path, images)
    kept, places, notes = _select(path, images, poses, Placements(path, element))
    if not kept:
        raise InputError(
            f"{path}: none of the {len(images)} images of the chunk"
            f" {element.get('label') or 'without a name'} can be used: {_why(images, poses, notes)}"
        )
    world, of_world = (World("local"), ()) if IDENTITY in places else world_of(path, element)
    centres, rotations = _in_world([poses[image.id] for image in kept], places)
    lenses, of_lenses = _lenses(path, kept)
    chosen = {image.id for image in kept}
    return Block(
        tuple(kept),
        tuple(places),
        centres,
        rotations,
        lenses,
        world,
        tuple(image.label for image in images if image.id not in chosen),
        (*notes, *of_lenses, *of_world),
    )


def _images(chunk: Element) -> list[Image]:
    """Return the photos of a chunk, also those in groups; keyframes of animations are none."""
    found = {sensor.get("id"): sensor for sensor in chunk.iterfind("sensors/sensor")}
    listed = _listed_components(chunk)
    homes: dict[str, str | None] = {}
    images: list[Image] = []
    for camera in chunk.iterfind("cameras//camera"):
        if camera.get("type", "regular") == "regular":
            number = camera.get("id") or f"#{len(images)}"
            label = camera.get("label") or f"number {number}"
            home = camera.get("component_id") or listed.get(number)
            home = home or homes.get(camera.get("master_id") or "")
            homes[number] = home
            images.append(Image(number, label, camera, found.get(camera.get("sensor_id")), home))
    return images


def _listed_components(chunk: Element) -> dict[str, str | None]:
    """Return the component of each image that a component lists."""
    return {
        number: component.get("id")
        for component in chunk.iterfind("components/component")
        for ids in component.iter("camera_ids")
        for number in (ids.text or "").split()
    }


def _poses(path: Path, images: list[Image]) -> dict[str, FloatArray]:
    """Return camera to chunk, 4x4, of each image that is aligned or whose master is."""
    aligned = [image for image in images if (image.element.findtext("transform") or "").strip()]
    matrices = _matrices(path, aligned)
    masters = {image.id: matrix for image, matrix in zip(aligned, matrices, strict=True)}
    offsets: dict[int, FloatArray] = {}
    poses = dict(masters)
    for image in images:
        master = masters.get(image.element.get("master_id") or "")
        if image.id in masters or master is None or image.sensor is None:
            continue
        key = id(image.sensor)
        if key not in offsets:
            offsets[key] = sensors.offset_of(path, image.sensor)
        poses[image.id] = master @ offsets[key]
    return poses


def _matrices(path: Path, images: list[Image]) -> FloatArray:
    """Return the transforms of images, shape (k, 4, 4), with proper rotations."""
    words = [(image.element.findtext("transform") or "").split() for image in images]
    try:
        matrices = np.array(words, dtype=np.float64).reshape(-1, 4, 4)
        damaged = not np.isfinite(matrices).all()
    except ValueError:
        damaged = True
    if damaged:  # one by one, to name the image
        rows = [
            numbers(path, f"image {image.label}, transform", " ".join(row), 16)
            for image, row in zip(images, words, strict=True)
        ]
        matrices = np.array(rows).reshape(-1, 4, 4)
    tilted = np.abs(matrices[:, 3] - [0.0, 0.0, 0.0, 1.0]).max(axis=1) > checks.ROUNDING
    labels = [image.label for image in images]
    if tilted.any():
        raise InputError(
            f"{path}: image {labels[int(np.argmax(tilted))]}: the last row of its transform is not"
            " 0 0 0 1; export the cameras again."
        )
    matrices[:, :3, :3] = _rotations(path, labels, matrices[:, :3, :3])
    return matrices


def _rotations(path: Path, labels: list[str], matrices: FloatArray) -> FloatArray:
    """Return the rotations next to matrices; those that are none meet `checks.rotation`."""
    off = np.abs(matrices @ matrices.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    for i in np.flatnonzero(~(off <= checks.ROUNDING) | (np.linalg.det(matrices) < 0.0)):
        checks.rotation(path, labels[i], matrices[i])
    u, _, v = np.linalg.svd(matrices)
    return np.asarray(u @ v)


def _select(
    path: Path, images: list[Image], poses: dict[str, FloatArray], placements: Placements
) -> tuple[list[Image], list[Similarity], tuple[str, ...]]:
    """Return the images to use, the way of each to the world, and notes on the others."""
    kept, places = [], []
    why: Counter[str] = Counter()
    posed = [image for image in images if image.id in poses]
    georeferenced = any(placements.of(image.component) is not None for image in posed)
    for image in posed:
        place = placements.of(image.component)
        if not georeferenced and placements.is_main(image.component):
            place = IDENTITY
        obstacle = _obstacle(image)
        if obstacle or place is None:
            why[obstacle or "in a component that has no transform to the frame of the others"] += 1
        else:
            kept.append(image)
            places.append(place)
    notes = (f"{path}: {n} images are {reason}; left out." for reason, n in why.items())
    return kept, places, tuple(notes)


def _obstacle(image: Image) -> str:
    """Return what keeps an aligned image from being used, if anything."""
    if image.element.get("enabled") == "false":
        return "aligned but disabled"
    if image.sensor is not None and not sensors.is_central(image.sensor):
        return f"of a {sensors.kind_of(image.sensor)} sensor, for which there is no lens"
    return ""


def _why(images: list[Image], poses: dict[str, FloatArray], notes: tuple[str, ...]) -> str:
    if not poses:
        return "no image is aligned; align the photos, or choose the chunk that is."
    parts = [note.partition(": ")[2].removesuffix("; left out.") for note in notes]
    return f"{len(images) - len(poses)} are not aligned, {', '.join(parts)}."


def _in_world(poses: list[FloatArray], places: list[Similarity]) -> tuple[FloatArray, FloatArray]:
    """Return centres, shape (k, 3), and rotations world to camera, (k, 3, 3)."""
    to_chunk = np.array(poses)
    turn = np.array([place.rotation for place in places])
    scale = np.array([place.scale for place in places])
    shift = np.array([place.translation for place in places])
    centres = scale[:, None] * np.einsum("kij,kj->ki", turn, to_chunk[:, :3, 3]) + shift
    return centres, np.ascontiguousarray((turn @ to_chunk[:, :3, :3]).transpose(0, 2, 1))


def _lenses(path: Path, images: list[Image]) -> tuple[tuple[Lens, ...], tuple[str, ...]]:
    """Return the lens of each image, one object per sensor, and notes."""
    found: dict[int, Lens] = {}
    notes: list[str] = []
    for image in images:
        if image.sensor is None:
            raise InputError(
                f"{path}: image {image.label}: its sensor {image.element.get('sensor_id')} is not"
                " in the file; export the cameras again."
            )
        if id(image.sensor) not in found:
            found[id(image.sensor)] = sensors.lens_of(path, image.sensor, image.label)
            notes.extend(sensors.notes_on(path, image.sensor))
    return tuple(found[id(image.sensor)] for image in images), tuple(notes)

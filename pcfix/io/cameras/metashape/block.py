"""The aligned images of a chunk: poses, lenses, and the way from the chunk to the world."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from pcfix.errors import PcfixWarning
from pcfix.io.cameras import checks
from pcfix.io.cameras.checks import damaged, note, number, numbers, text_of
from pcfix.io.cameras.metashape import sensors
from pcfix.io.cameras.metashape.documents import Chunk
from pcfix.io.crs import METRES, crs_text, is_local, parse_crs, shortened, unbound
from pcfix.model import Cameras, FloatArray, Lens

LOCAL = "local"


class Image(NamedTuple):
    """An image and the elements that speak of it; `component` is where its pose is at home."""

    id: str
    label: str
    element: Element
    sensor: Element | None
    component: str | None


class Block(NamedTuple):
    """The images with a pose, in the order of the file, and their matrices from chunk to world."""

    images: list[Image]
    places: list[FloatArray]
    cameras: Cameras


def read_block(chunk: Chunk) -> Block:
    """Read the images of a chunk.

    Left out are images that are not aligned, disabled (they took no part in the dense cloud), not
    of a central projection, or in a component without a place in the frame of the others.
    """
    path, element = chunk.path, chunk.element
    images = _images(element)
    poses = _poses(path, images)
    place_of, has_place = _places(path, element)
    kept, why = [], Counter[str]()
    for image in images:
        kind = "frame" if image.sensor is None else sensors.kind_of(image.sensor)
        if image.id not in poses:
            continue
        if image.element.get("enabled") == "false":
            why["aligned but disabled"] += 1
        elif kind not in sensors.PROJECTIONS:
            why[f"of a {kind} sensor, for which there is no lens"] += 1
        elif place_of(image) is None:
            why["in a component that has no transform to the frame of the others"] += 1
        else:
            kept.append(image)
    said = [f"{count} images are {reason}" for reason, count in why.items()]
    if not kept:
        chunk_name = element.get("label") or "without a name"
        rest = ", ".join([f"{len(images) - len(poses)} are not aligned", *said])
        raise checks.no_pose(path, f"of the {len(images)} images of chunk {chunk_name} {rest}")
    notes = [note(path, "cameras.left_out", f"{one}; left out.") for one in said]
    places = [place for image in kept if (place := place_of(image)) is not None]
    crs, project_crs, of_world = _world(path, element) if has_place else (LOCAL, None, ())
    in_world = np.array(places) @ np.array([poses[image.id] for image in kept])
    scales = np.cbrt(np.linalg.det(in_world[:, :3, :3]))[:, None, None]
    lenses: dict[Element, Lens] = {}
    for image in kept:
        if image.sensor is None:
            raise damaged(path, f"sensor {image.element.get('sensor_id')} is missing")
        if image.sensor not in lenses:
            lenses[image.sensor], of_lens = sensors.lens_of(path, image.sensor, image.label)
            notes += of_lens
    chosen = {image.id for image in kept}
    cameras = Cameras(
        labels=tuple(image.label for image in kept),
        centres=in_world[:, :3, 3],
        rotations=np.ascontiguousarray((in_world[:, :3, :3] / scales).transpose(0, 2, 1)),
        lenses=tuple(lenses[image.sensor] for image in kept if image.sensor is not None),
        crs=crs,
        project_crs=project_crs,
        unposed=tuple(image.label for image in images if image.id not in chosen),
        notes=(*notes, *of_world),
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
    aligned = [image for image in images if text_of(image.element, "transform")]
    labels = [image.label for image in aligned]
    rows = [
        numbers(path, f"image {image.label}, transform", image.element.findtext("transform"), 16)
        for image in aligned
    ]
    matrices = np.array(rows).reshape(-1, 4, 4)
    matrices[:, :3, :3] = checks.rotations(path, labels, matrices[:, :3, :3])
    masters = dict(zip((image.id for image in aligned), matrices, strict=True))
    poses = dict(masters)
    for image in images:
        master = masters.get(image.element.get("master_id") or "")
        if image.id not in masters and master is not None and image.sensor is not None:
            poses[image.id] = master @ sensors.offset_of(path, image.sensor)
    return poses


def _places(path: Path, chunk: Element) -> tuple[Callable[[Image], FloatArray | None], bool]:
    """Return the way of an image to the world (None: it has no place there), and if there is one.

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
    has_place = of_chunk is not None or any(place is not None for place in own.values())
    of_main = of_chunk if has_place else np.eye(4)

    def place_of(image: Image) -> FloatArray | None:
        is_main = image.component in (None, main) or image.component not in own
        component = own.get(image.component)
        return of_main if component is None and is_main else component

    return place_of, has_place


def _similarity(path: Path, element: Element | None) -> FloatArray | None:
    """Return the 4x4 matrix of a transform that is one matrix, or has up to three parts."""
    if element is None:
        return None
    where, matrix = "transform of the chunk", np.eye(4)
    scale, rotation, translation = map(element.findtext, ("scale", "rotation", "translation"))
    if (element.text or "").strip():
        matrix = numbers(path, where, element.text, 16).reshape(4, 4)
    elif scale is None and rotation is None and translation is None:
        return None
    if rotation is not None:
        matrix[:3, :3] = numbers(path, where, rotation, 9).reshape(3, 3)
    if translation is not None:
        matrix[:3, 3] = numbers(path, where, translation, 3)
    inside = float(np.cbrt(np.linalg.det(matrix[:3, :3]))) if scale is None else 1.0
    size = inside if scale is None else number(path, where, scale)
    if not size > 0.0:
        raise damaged(path, f"{where}: the scale {size:g} is not positive")
    matrix[:3, :3] = size * checks.rotations(path, [where], matrix[:3, :3] / inside)[0]
    return matrix


def _world(path: Path, chunk: Element) -> tuple[str, str | None, tuple[PcfixWarning, ...]]:
    """Return the frame that a chunk's transforms lead to, its CRS if another, and notes on them."""
    text = text_of(chunk, "reference")
    if not text or text.upper() == "LOCAL":
        return LOCAL, None, ()
    crs = parse_crs(text, str(path))
    if is_local(crs):
        unit = crs.axis_info[0].unit_name
        sentence = f"the local coordinates of the chunk are in {unit}, its transform in metres."
        said = note(path, "cameras.local_unit", sentence, unit=unit)
        return LOCAL, None, () if unit in METRES else (said,)
    if crs.geodetic_crs is None:
        remedy = "Set it again in Metashape's reference settings"
        raise checks.unsupported(path, f"the CRS {shortened(text)}, which has no datum,", remedy)
    base = unbound(crs.geodetic_crs).to_json_dict()
    axes = [
        {"name": f"Geocentric {a}", "abbreviation": a, "direction": f"geocentric{a}"}
        | {"unit": "metre"}
        for a in "XYZ"
    ]
    geocentric = {  # on the datum of the CRS, as PROJJSON
        **{key: base[key] for key in ("$schema", "name", "datum", "datum_ensemble") if key in base},
        "type": "GeodeticCRS",
        "coordinate_system": {"subtype": "Cartesian", "axis": axes},
    }
    frame = crs_text(type(crs).from_json_dict(geocentric))
    return frame, frame if crs.is_geocentric else text, ()

"""COLMAP's sparse models, as text or binary.

A model is a folder with ``cameras``, ``images`` and ``points3D``, all ``.bin`` or all ``.txt``;
from COLMAP 3.12 on with ``rigs`` and ``frames`` too, which are not needed, as ``images`` has the
pose of every image in rigs also. Definition: https://colmap.github.io/format.html.

A pose is a unit quaternion, scalar first, and a translation, both world to camera, in OpenCV
axes: ``x_cam = R x + t``, so the projection centre is ``-R' t``. Pixels start at the upper left
corner of the upper left pixel. The world is that of the alignment, if there was one, often minus an
offset; the files do not tell, so the CRS is None, unless ``georeference.json`` of pcfix lies beside
them (``crs``, ``offset_m``, ``written_by``; see `place`): its offset is then added to centres and
tie points, and its CRS is theirs. Lenses are in `models`, priors of the positions in `priors`;
`writing` writes such models.

Images keep the order of the file. An image point belongs to the point in space whose identifier it
has, -1 for none; ``points3D`` lists the same as tracks.
"""

from __future__ import annotations

import re
from contextlib import suppress
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras import checks, tracks
from pcfix.io.cameras.colmap import binary, text
from pcfix.io.cameras.colmap.models import lens
from pcfix.io.cameras.colmap.place import read_place
from pcfix.io.cameras.colmap.priors import read_priors
from pcfix.model import Cameras, Lens, TiePoints

if TYPE_CHECKING:
    from pathlib import Path
    from types import ModuleType

    from pcfix.io.cameras.colmap.models import Camera
    from pcfix.io.cameras.colmap.parts import Image
    from pcfix.io.cameras.formats import Source
    from pcfix.model import IntArray

SOFTWARE = "COLMAP"
_PART = re.compile(r"(cameras|images|points3D|rigs|frames)\.(bin|txt)")
_CAMERA_LINE = re.compile(r"^\s*\d+\s+[A-Z][A-Z_0-9]+(\s+\S+){2}", re.MULTILINE)


class Model(NamedTuple):
    """Where a model lies; `others` counts further ones beside it."""

    folder: Path
    suffix: str
    others: int = 0

    @property
    def form(self) -> ModuleType:
        """The module that reads it."""
        return binary if self.suffix == "bin" else text

    def part(self, name: str) -> Path:
        """Return the path of one of its files."""
        return self.folder / f"{name}.{self.suffix}"


def recognises(source: Source) -> bool:
    """Whether it is a model, one of its files, or a folder above that has one."""
    with suppress(OSError):
        return _find(source.path) is not None
    return False


def read(source: Source) -> Cameras:
    """Read the poses of registered images and their lenses."""
    model = _model(source)
    cameras = model.form.read_cameras(model.part("cameras"))
    images: list[Image] = model.form.read_images(model.part("images"), points=False)
    posed = [image for image in images if image.posed]
    path = model.part("images")
    if not posed:
        raise InputError(f"{path}: has no image with a pose; give the model of another folder.")
    poses = np.array([image.pose for image in posed])
    rotations = np.array([checks.quaternion(path, i.name, np.array(i.pose[:4])) for i in posed])
    labels = tuple(image.name for image in posed)
    gnss, notes = read_priors(model.folder, labels)
    place = read_place(model.folder)
    if place is not None and gnss is not None and gnss.crs is None:
        gnss = None  # of the model that the database made, which this one may not be
    centres = -np.einsum("kji,kj->ki", rotations, poses[:, 4:])
    return Cameras(
        labels=labels,
        centres=centres if place is None else centres + place.offset_m,
        rotations=rotations,
        lenses=_lenses(model, cameras, posed),
        crs=None if place is None else place.crs,
        notes=(*_others(model), *notes),
        gnss=gnss,
        unposed=tuple(image.name for image in images if not image.posed),
        source=SOFTWARE,
    )


def tie_points(source: Source, cameras: Cameras) -> TiePoints:
    """Read the points in space and where the images saw them."""
    model = _model(source)
    path = model.part("points3D")
    if not path.is_file():
        raise InputError(f"{path}: there is no such file, so there are no tie points.")
    points = model.form.read_points(path)
    images = [i for i in model.form.read_images(model.part("images"), points=True) if i.posed]
    if not len(points.identifiers) or not any(len(image.points) for image in images):
        raise InputError(f"{path}: the model has no points that its images saw; no tie points.")
    seen = np.concatenate([image.points for image in images])
    camera = np.repeat(np.arange(len(cameras)), [len(image.points) for image in images])
    row = _rows_of(points.identifiers, seen)
    known = row >= 0
    xy = np.concatenate([image.xy for image in images])[known]
    place = read_place(model.folder)
    xyz = points.xyz if place is None else points.xyz + place.offset_m
    return tracks.tie_points(xyz, row[known], camera[known], xy)


def _rows_of(identifiers: IntArray, wanted: IntArray) -> IntArray:
    """Return the row of each wanted identifier, -1 where there is none."""
    order = np.argsort(identifiers)
    by_identifier = np.argsort(wanted)  # a search in rising order is far quicker
    place = np.empty(len(wanted), np.int64)
    place[by_identifier] = np.searchsorted(identifiers[order], wanted[by_identifier])
    row = order[np.minimum(place, len(order) - 1)]
    return np.where(identifiers[row] == wanted, row, -1)


def _lenses(model: Model, cameras: dict[int, Camera], images: list[Image]) -> tuple[Lens, ...]:
    made: dict[int, Lens] = {}
    for image in images:
        if image.camera not in cameras:
            raise InputError(
                f"{model.part('images')}: image {image.name}: its camera {image.camera} is not in"
                f" {model.part('cameras').name}; export the model again."
            )
        if image.camera not in made:
            camera = cameras[image.camera]
            made[image.camera] = lens(model.part("cameras"), image.camera, camera)
    return tuple(made[image.camera] for image in images)


def _others(model: Model) -> tuple[str, ...]:
    if not model.others:
        return ()
    return (
        f"{model.folder}: is the largest of {model.others + 1} models of the block, which are not"
        " tied to each other; the images of the others are left out.",
    )


def _model(source: Source) -> Model:
    found = _find(source.path)
    if found is None:
        raise InputError(f"{source.path}: has no COLMAP model.")
    return found


def _find(path: Path) -> Model | None:
    """Return the model in a folder, in its ``sparse`` or, of several, the largest there."""
    if not path.is_dir():
        part = _PART.fullmatch(path.name)
        return _in_folder(path.parent, part[2]) if part else None
    for folder in (path, path / "sparse"):
        found = _in_folder(folder, "bin") or _in_folder(folder, "txt")
        if found or not folder.is_dir():
            return found
        numbered = [p for p in folder.iterdir() if p.name.isdecimal()]
        models = [m for p in numbered if (m := _in_folder(p, "bin") or _in_folder(p, "txt"))]
        if models:
            models.sort(key=lambda m: (-m.part("images").stat().st_size, m.folder.name))
            return models[0]._replace(others=len(models) - 1)
    return None


def _in_folder(folder: Path, suffix: str) -> Model | None:
    model = Model(folder, suffix)
    cameras, images = model.part("cameras"), model.part("images")
    if not (cameras.is_file() and images.is_file()):
        return None
    if suffix == "txt":
        with cameras.open(encoding="utf-8-sig", errors="replace") as stream:
            if not _CAMERA_LINE.search(stream.read(4096)):
                return None
    return model

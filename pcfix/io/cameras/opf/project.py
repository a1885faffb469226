"""The project file: its items, their files, and the way into its CRS."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras import checks
from pcfix.io.cameras.checks import json_number, load_json, mapping, vector
from pcfix.io.crs import crs_text, parse_crs, plan_unit
from pcfix.model import FloatArray

FORMAT = "application/opf-{}+json"
PROJECT = FORMAT.format("project")
Part = dict[str, Any]
"""An object of a JSON file."""


class Project(NamedTuple):
    """The list of items of a project, and what wrote it."""

    path: Path
    items: list[Part]
    generator: tuple[str, ...]

    def files(self, kind: str, form: str) -> list[Path]:
        """Return the files of a format that items of a kind have."""
        return [
            self.path.parent / unquote(text_of(self.path, resource, "uri"))
            for item in self.items
            if item.get("type") == kind
            for resource in objects(self.path, item, "resources")
            if resource.get("format") == form
        ]

    def part(self, kind: str, form: str, *, needed: bool = True) -> tuple[Path, Part]:
        """Return the one file of a format and what it holds; nothing where it is not needed."""
        found = self.files(kind, FORMAT.format(form))
        if not found and not needed:
            return self.path, {}
        if len(found) != 1:
            raise InputError(
                f"{self.path}: has {len(found)} files of {form.replace('-', ' ')} instead of one;"
                " export the project again after one calibration."
            )
        if not found[0].is_file():
            raise InputError(f"{found[0]}: is missing; keep all files of the project together.")
        return found[0], mapping(found[0], "the file", load_json(found[0]))


def open_project(path: Path) -> Project:
    """Read the project that a path is, that lies in a folder, or that a part belongs to."""
    if path.is_dir():
        found = sorted(path.glob("*.opf"))
    else:
        content = mapping(path, "the file", load_json(path))
        if content.get("format") == PROJECT:
            made = mapping(path, "generator", content.get("generator", {}))
            said = tuple(str(made[name]) for name in ("name", "version") if name in made)
            return Project(path, objects(path, content, "items"), said)
        above = path.resolve().parent
        found = [*sorted(above.glob("*.opf")), *sorted(above.parent.glob("*.opf"))]
    if len(found) != 1 or found[0] == path:
        raise InputError(
            f"{path}: belongs to an OPF project, of which {len(found)} are there; give the one"
            " (.opf) that goes with the cloud."
        )
    return open_project(found[0])


def objects(path: Path, of: Part, name: str) -> list[Part]:
    """Return a list of objects; empty where there is none."""
    values = of.get(name, [])
    if not isinstance(values, list):
        raise InputError(f"{path}: {name} is not a list; the file is damaged, export it again.")
    return [mapping(path, f"an entry of {name}", value) for value in values]


def text_of(path: Path, of: Part, name: str) -> str:
    """Return a text by its name."""
    text = of.get(name)
    if not isinstance(text, str):
        raise InputError(f"{path}: {name} is not a text but {text!r:.60}; export it again.")
    return text


def id_of(path: Path, of: Part, name: str = "id") -> int:
    """Return a number by which a camera or sensor is known."""
    value = of.get(name)
    if not isinstance(value, int):
        raise InputError(f"{path}: the {name} {value!r:.60} is not a whole number; export again.")
    return value


def image_names(project: Project) -> dict[int, str]:
    """Return the names of the images by their ids; of a page of a file with its number."""
    names = {}
    for path in project.files("camera_list", FORMAT.format("camera-list")):
        if path.is_file():
            for camera in objects(path, mapping(path, "the file", load_json(path)), "cameras"):
                name = text_of(path, camera, "uri").replace("\\", "/").rpartition("/")[2]
                names[id_of(path, camera)] = unquote(name.removesuffix("#page=0"))
    return names


class Frame(NamedTuple):
    """The way from the processing CRS to coordinates east, north, up of the project's."""

    crs: str
    project_crs: str | None
    shift: FloatArray
    scale: FloatArray
    notes: tuple[str, ...] = ()

    def enter(self, xyz: FloatArray) -> FloatArray:
        """Return points (n, 3) in the CRS of the project."""
        return np.asarray((xyz - self.shift) / self.scale)


def frame_of(project: Project) -> Frame:
    """Read the scene reference frame."""
    path, scene = project.part("scene_reference_frame", "scene-reference-frame", needed=False)
    if not scene:  # the frame of the processing is arbitrary
        return Frame("local", None, np.zeros(3), np.ones(3))
    given = mapping(path, "crs", scene.get("crs"))
    way = mapping(path, "base_to_canonical", scene.get("base_to_canonical"))
    shift, scale = (vector(path, name, way.get(name), 3) for name in ("shift", "scale"))
    if not (scale > 0.0).all():
        raise InputError(f"{path}: scale {scale.tolist()} must be positive; export it again.")
    if way.get("swap_xy"):
        scale = scale[[1, 0, 2]]  # positions are east, north already, scales in the CRS's order
    said = checks.crs(path, text_of(path, given, "definition"))
    crs, unit = (said, 1.0) if said == "local" else with_heights(said, str(path))
    geoid = given.get("geoid_height")
    notes: tuple[str, ...] = ()
    if geoid is not None and json_number(path, "geoid_height", geoid):
        notes = (
            f"{path}: its heights are above a constant geoid, {geoid:g} m over the ellipsoid, and"
            " taken for those that its CRS names.",
        )
    project_crs = None if crs == said else said
    return Frame(crs, project_crs, shift, scale / [1.0, 1.0, unit], notes)


def with_heights(text: str, name: str) -> tuple[str, float]:
    """Return a CRS, ellipsoidal heights in metres added if need be, and metres in what was one."""
    crs = parse_crs(text, name)
    if len(crs.axis_info) != 2:
        return text, 1.0
    return crs_text(crs.to_3d()), 1.0 if crs.is_geographic else plan_unit(crs)[1]

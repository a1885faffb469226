"""The files of an OpenDroneMap project, wherever in it the user points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from pcfix.errors import InputError
from pcfix.io.cameras.odm.crs import named_crs

if TYPE_CHECKING:
    from pathlib import Path

SHOTS = "shots.geojson"
RECONSTRUCTION = "reconstruction.json"
TRANSFORMATION = "geocoords_transformation.txt"
TOPOCENTRIC = "reconstruction.topocentric.json"

_FOLDERS = ("", "opensfm", "odm_georeferencing", "odm_georeferencing_25d", "odm_report")
_LINK_BYTES = 400


@dataclass(frozen=True)
class Project:
    """A project folder and the file in it that has the poses.

    Attributes
    ----------
    root : Path
    poses : Path or None
        shots.geojson or a reconstruction; None where there is neither.
    """

    root: Path
    poses: Path | None

    def find(self, name: str) -> Path | None:
        """Return a file of this name beside the poses or in the project's own folders."""
        folders = [self.poses.parent] if self.poses else []
        folders += [self.root / folder for folder in _FOLDERS]
        for folder in folders:
            if (folder / name).is_file():
                return _followed(folder / name, self.root)
        return None

    def crs(self) -> str | None:
        """Return the projected CRS that the project names."""
        for name in ("proj.txt", "coords.txt", "odm_georeferencing_model_geo.txt"):
            path = self.find(name)
            if path is not None:
                return named_crs(path)
        return None


def locate(path: Path) -> Project:
    """Return the project that a file or folder belongs to.

    A file is taken as it is; of a folder its reconstruction, or else its shots.geojson.
    """
    folder = path if path.is_dir() else path.parent
    root = folder
    if root.name == "undistorted":
        root = root.parent
    if root.name in _FOLDERS[1:]:
        root = root.parent
    if not path.is_dir():
        return Project(root, path)
    places = [folder / RECONSTRUCTION, root / "opensfm" / RECONSTRUCTION]
    places += [folder / SHOTS, root / "odm_report" / SHOTS]
    return Project(root, next((place for place in places if place.is_file()), None))


def whole_file(project: Project) -> Path:
    """Return the file with the poses, followed where it is a link kept as text.

    Raises
    ------
    InputError
        If the link leads out of the project or to nothing.
    """
    if project.poses is None:
        raise InputError(f"{project.root}: has neither opensfm/{RECONSTRUCTION} nor {SHOTS}.")
    found = _followed(project.poses, project.root)
    if found is None:
        raise InputError(
            f"{project.poses}: is only a link to '{_link(project.poses)}', which is not in this"
            " project; give the file itself."
        )
    return found


def _followed(path: Path, root: Path) -> Path | None:
    """Return the file that a link kept as text (git does so) leads to, inside the project."""
    link = _link(path)
    if link is None:
        return path
    target = (path.parent / link).resolve()
    if not target.is_file() or not target.is_relative_to(root.resolve()):
        return None
    return None if _link(target) else target


def _link(path: Path) -> str | None:
    """Return the path that a file consists of; None for any other file."""
    if path.stat().st_size > _LINK_BYTES:
        return None
    text = path.read_bytes().decode("utf-8", errors="replace").strip()
    is_path = "/" in text and text.rsplit(".", 1)[-1] == path.suffix[1:]
    return text if is_path and not set(text) & set('{}[]"\n\0') else None

"""The files of one Pix4D project, whichever of them the user named."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from pcfix.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from pcfix.io.cameras.formats import Source

PARAMETERS = "calibrated_camera_parameters.txt"
EXTERNAL = "calibrated_external_camera_parameters.txt"
GEOGRAPHIC = "calibrated_external_camera_parameters_wgs84.txt"
CALIBRATION = "pix4d_calibrated_internal_camera_parameters.cam"


@dataclass(frozen=True)
class Files:
    """What there is of a project; None where there is no such file."""

    parameters: Path | None
    external: Path | None
    calibration: Path | None
    offset: Path | None
    wkt: Path | None
    bingo: Path | None
    ties: Path | None
    gcps: Path | None
    project: Path | None


def first_line(text: str) -> str:
    """Return the first line of a text."""
    return text.lstrip().partition("\n")[0]


def is_project(source: Source) -> bool:
    """Whether a file is a Pix4D project (.p4d)."""
    return b"<pix4uav" in source.head


def read_text(path: Path) -> str:
    """Return the text of a file; bytes that are not UTF-8 can only be in names."""
    data = path.read_bytes()
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def holds_tables(root: Path) -> bool:
    """Whether a folder, or one in which a project keeps its tables, holds one."""
    try:
        return any(
            _prefix(path.name, PARAMETERS, EXTERNAL) is not None
            for folder in _folders(root)
            for path in folder.iterdir()
        )
    except OSError:
        return False


def find(source: Source) -> Files | None:
    """Return the files of the project that a folder holds, or that a file belongs to.

    Raises
    ------
    InputError
        If a folder holds several projects.
    """
    path = source.path
    if is_project(source):
        return _in_folders(path.with_suffix(""), path)
    if path.is_dir():
        return _in_folders(path, None)
    return _of_file(source)


def _of_file(source: Source) -> Files:
    """Return a table and what lies beside it under the same project name."""
    path = source.path
    prefix = _prefix(path.name, PARAMETERS, EXTERNAL, GEOGRAPHIC) or ""
    files = _named(path.parent, prefix)
    columns = first_line(source.text).lower().split()
    if columns[:1] == ["filename"]:
        return replace(files, parameters=path)
    if columns[1:2] == ["x"]:
        return replace(files, external=path)
    return files


def _in_folders(root: Path, project: Path | None) -> Files | None:
    for folder in _folders(root):
        prefixes = {
            prefix
            for path in folder.iterdir()
            if (prefix := _prefix(path.name, PARAMETERS, EXTERNAL)) is not None
        }
        if len(prefixes) > 1:
            raise InputError(
                f"{folder}: holds the tables of several projects"
                f" ({', '.join(sorted(prefixes))}); give one of the files instead."
            )
        if prefixes:
            files = _named(folder, prefixes.pop())
            return files if project is None else replace(files, project=project)
    return None


def _folders(root: Path) -> Iterator[Path]:
    """Give the folders in which a project may have its tables."""
    if root.is_dir():
        yield root
        for pattern in ("params", "1_initial/params", "*/params", "*/1_initial/params"):
            yield from sorted(path for path in root.glob(pattern) if path.is_dir())


def _prefix(name: str, *endings: str) -> str | None:
    """Return what precedes one of the endings in a name, the name of the project."""
    for ending in endings:
        if name == ending:
            return ""
        if name.endswith("_" + ending):
            return name.removesuffix(ending)
    return None


def _named(folder: Path, prefix: str) -> Files:
    def existing(name: str) -> Path | None:
        path = folder / (prefix + name)
        return path if path.is_file() else None

    return Files(
        parameters=existing(PARAMETERS),
        external=existing(EXTERNAL),
        calibration=existing(CALIBRATION),
        offset=existing("offset.xyz"),
        wkt=existing("wkt.prj"),
        bingo=existing("tp_bingo.txt"),
        ties=existing("tp_pix4d.txt"),
        gcps=existing("measured_estimated_gcps_position.txt"),
        project=_project(folder, prefix.rstrip("_")),
    )


def _project(params: Path, name: str) -> Path | None:
    """Return the project file, which lies beside the folder of the project or in it."""
    root = params.resolve().parent.parent
    for path in (root.parent / f"{root.name}.p4d", root / f"{name}.p4d"):
        if path.is_file():
            return path
    return None

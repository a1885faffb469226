"""What an adjustment writes: a folder with the model, camera files, figures and a report."""

from __future__ import annotations

import json
import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.adjust.gather import LEAST_VIEWS, taken
from pcfix.errors import InputError, SettingError
from pcfix.io.cameras.colmap.writing import write_colmap
from pcfix.io.cameras.opensfm.models import write_opensfm
from pcfix.io.cameras.table.sensor import write_table
from pcfix.model import TiePoints, Views

if TYPE_CHECKING:
    from collections.abc import Callable

    from pcfix.adjust.result import Adjusted

SUMMARY = "adjustment.json"


def checked_folder(folder: Path, overwrite: bool, inputs: list[Any]) -> Path:
    """Return a folder that may be written.

    Raises
    ------
    SettingError
        If it exists and is not an earlier adjustment that may be replaced.
    """
    if any(folder.exists() and Path(one).exists() and folder.samefile(one) for one in inputs):
        raise SettingError(f"{folder}: output and model are the same; give another folder.")
    if folder.exists() and not folder.is_dir():
        raise SettingError(f"{folder}: is a file; give a folder.")
    if folder.is_dir() and any(folder.iterdir()):
        if not overwrite:
            raise SettingError(f"{folder}: the output exists; add --overwrite to replace it.")
        if not (folder / SUMMARY).is_file():
            raise SettingError(
                f"{folder}: holds other files than an adjustment's; give an empty or new folder."
            )
    if not folder.resolve().parent.is_dir():
        raise SettingError(f"{folder}: the folder {folder.parent} does not exist; make it first.")
    return folder


def write_adjustment(folder: Path, found: Adjusted, model: str, *, overwrite: bool) -> None:
    """Write an adjusted block: model, camera files, summary, report; all or nothing."""
    from pcfix.report.adjustment import adjustment_dict, adjustment_page, before_of

    before = before_of(found)
    parent = folder.resolve().parent
    draft = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", suffix=".part", dir=parent))
    try:
        _write_models(draft, found)
        summary = {"model": model, **adjustment_dict(found, before)}
        text = json.dumps(summary, indent=2, allow_nan=False)
        (draft / SUMMARY).write_text(text + "\n", "utf-8")
        (draft / "report.html").write_text(adjustment_page(found, before), "utf-8")
        draft.chmod(0o755)
        if folder.exists():
            shutil.rmtree(folder)
        draft.replace(folder)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror or error}).") from error
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def _write_models(folder: Path, found: Adjusted) -> None:
    """Write the model in each form that holds its lenses exactly."""
    ties = adjusted_ties(found)
    (folder / "opensfm").mkdir()
    writers: dict[str, Callable[[], object]] = {
        "colmap": lambda: write_colmap(
            folder / "colmap", found.cameras, ties, crs=found.cameras.crs
        ),
        "opensfm": lambda: write_opensfm(
            folder / "opensfm" / "reconstruction.json", found.cameras, ties
        ),
        "cameras.csv": lambda: write_table(folder, found.cameras),
    }
    failed = []
    for name, write in writers.items():
        try:
            write()
        except InputError as error:
            failed.append(str(error).replace(f"{folder}/", ""))
            if name != "cameras.csv":  # a table is a convenience for blocks of one plain lens
                found.notes.append(f"{name} is not written: {failed[-1]}")
    if not any((folder / "opensfm").iterdir()):
        (folder / "opensfm").rmdir()
    if len(failed) == len(writers):
        raise InputError("no form of camera file holds these lenses: " + " ".join(failed))


def adjusted_ties(found: Adjusted) -> TiePoints | None:
    """Return the adjusted tie points without outliers; None where points of the cloud stood in."""
    if found.source == "cloud":
        return None
    block = found.block
    m = len(block.xyz) - len(block.control_names)
    owner = block.owner
    kept = found.used & (owner < m)
    counts = np.bincount(owner[kept], minlength=m)[:m]
    start = np.concatenate([[0], np.cumsum(counts)])
    ties = TiePoints(found.xyz[:m], Views(start, block.camera[kept]), block.image_xy[kept])
    return taken(ties, np.flatnonzero(counts >= LEAST_VIEWS))

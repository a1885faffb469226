"""What a run is asked for, the files that it reads, and those that it writes."""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

from pcfix.errors import InputError, PcfixWarning, SettingError
from pcfix.flow.inputs import Inputs, paths_in, read_blocks
from pcfix.flow.maps import SURFACE
from pcfix.flow.next_steps import FOLDER
from pcfix.flow.record import VERSION, belonging, read_record
from pcfix.flow.surfaces import view_of
from pcfix.flow.tiles import HOW, RECORDS
from pcfix.io.clouds import is_cloud, own_water, reference_of
from pcfix.io.files import files_in
from pcfix.io.rasters import open_raster
from pcfix.io.tiles import Tiles, cloud_of, inputs_of, open_cloud, tiles_from, tiles_of
from pcfix.model import Cameras, WaterSurface
from pcfix.options.correct import CorrectOptions
from pcfix.options.declare import named, options_of
from pcfix.options.steps import DistanceOptions
from pcfix.options.survey import RunOptions
from pcfix.version import __version__
from pcfix.water.index import Water, with_index

CLOUDS = ("corrected", "cleaned")


class Request(RunOptions):
    """Everything that the results of a run depend on; ``run.json`` keeps it."""

    input: str | tuple[str, ...] = ""
    """The cloud; many files as `tiles_of` takes them."""

    @cached_property
    def source(self) -> Path | Tiles:
        """The cloud, in one file or many."""
        return tiles_of(self.input) or Path(str(self.input))

    @property
    def has_surface(self) -> bool:
        """Whether the reference has heights everywhere: not check points."""
        suffix = Path(str(self.reference)).suffix.lower()
        return is_cloud(self.surveyed) or suffix in (".tif", ".tiff")

    @cached_property
    def surveyed(self) -> Path | Tiles:
        """The reference, in one file or many."""
        return reference_of(self.reference or "")

    def check(self) -> None:
        """Refuse options that exclude each other."""
        wrong = ""
        if self.adjust == "no" and self.only_to_adjust:
            wrong = f"{self.only_to_adjust[0]} is for an adjustment only. Remove it, or use auto."
        elif self.adjust == "yes" and self.why_not_adjust:
            wrong = f"{self.why_not_adjust}. Remove one of the two options."
        if wrong:
            wrong = f"--adjust {self.adjust}: {wrong}"
            raise SettingError("option.conflict", wrong, option="adjust", value=self.adjust)
        self.part(Inputs)
        with_index(self.part(RunOptions))

    @property
    def only_to_adjust(self) -> list[str]:
        """Options that were given and are for an adjustment only."""
        return [name for name in ("gcps", "gnss", "lens") if getattr(self, name) is not None]

    @property
    def why_not_adjust(self) -> str:
        """Why an adjustment is impossible with the other options; empty if it is possible."""
        if self.cameras is None:
            return "there are no cameras to adjust"
        if self.adjusted_from is not None:
            return "with adjusted-from the cameras are adjusted already"
        if self.tide is not None:
            return "a tide gives each image its own water level, and an adjustment has one"
        return ""

    def with_adjusted(self, folder: Path, step: dict[str, Any]) -> Request:
        """Return the request of the next steps: with the adjusted cameras, if there are any."""
        if not step["adjusted"]:
            return self
        return replace(
            self,
            cameras=str(folder / FOLDER / step["model"]),
            adjusted_from=self.cameras,
            adjust="no", gcps=None, gnss=None, lens=None,
        )  # fmt: skip

    def record(self) -> dict[str, Any]:
        """Return plain values, without what the results do not depend on."""
        values = self.as_dict()
        kept = {name: values[name] for name in values if name not in HOW}
        return {**kept, VERSION: __version__}

    @property
    def _named(self) -> list[Path]:
        """The files of the first step, but for the cloud and the water."""
        return paths_in(self, but=("water", "reference"))

    def files(self) -> dict[str, list[Path]]:
        """Return the input files, each of which exists, by the first step that reads them."""
        found = [*_files_of(self.source), *(one for path in self._named for one in files_in(path))]
        found += [Path(self.water)] if Path(self.water).is_file() else []
        compared = [] if self.reference is None else _files_of(self.surveyed)
        compared += [path for _, one in self.also for path in _files_of(cloud_of(one))]
        return {"adjust": found, "compare": compared}

    def watched(self, results: Path) -> dict[str, list[Path]]:
        """Return the input files with those that belong to them, but none in the results."""
        read = self.files()
        own = results.resolve()
        more = {one for path in self._named for one in belonging(path)}
        more = {one for one in more if own not in one.resolve().parents}
        return {**read, "adjust": list(dict.fromkeys([*read["adjust"], *sorted(more)]))}


def _files_of(cloud: Path | Tiles) -> list[Path]:
    return inputs_of(cloud) if isinstance(cloud, Tiles) else files_in(cloud)


_CORRECTION = {one.name for one in options_of(CorrectOptions)}.difference(
    ("input", "adjust", "index_formula"), Water._fields, (one.name for one in options_of(Inputs))
) - {"index"}
_LATER = {
    **{one.name: "compare" for one in options_of(DistanceOptions)},
    "reference": "compare", "resolution": "dsm", "project": "report", "date": "report",
}  # fmt: skip


def since(name: str) -> str:
    """Return the first step that an option of a request matters to."""
    if name in _CORRECTION:
        return "correct"
    return _LATER.get(name, "adjust")


def request_of(record: Path) -> Request:
    """Return what an earlier run was asked for, from its ``run.json``."""
    asked = dict(read_record(record)["request"])
    input = asked.pop("input", "")
    for name in ("index_from", VERSION):
        asked.pop(name, None)
    try:
        values = named(asked, options_of(RunOptions), str(record))
        return Request(input=tuple(input) if isinstance(input, list) else input, **values)
    except (SettingError, TypeError) as error:
        raise InputError(
            "run.record", f"{record}: is not the record of a run ({error}).", path=record
        ) from error


class Files:
    """The files that a run writes; of a cloud of many files a folder."""

    def __init__(self, folder: Path, source: Path | Tiles | None = None) -> None:
        self.folder = folder
        self._many = source.paths if isinstance(source, Tiles) else None
        ending = ".laz" if self._many is None else ""
        self.corrected, self.cleaned = (folder / f"{one}{ending}" for one in CLOUDS)
        self.surface, self.map = folder / SURFACE, folder / "map.gpkg"
        self.compare, self.report = folder / "compare", folder / "report.html"
        self.regression, self.dod = folder / "regression.json", self.compare / "dod.tif"

    def parts(self, target: Path) -> list[Path]:
        """Return the files of a cloud."""
        return [target] if self._many is None else [target / one.name for one in self._many]

    @property
    def resolution_m(self) -> float:
        """Side of the cells of the rasters, once they are there."""
        with open_raster(self.surface) as dsm:
            return float(dsm.res[0])

    @cached_property
    def corrected_cloud(self) -> Path | Tiles:
        """The corrected cloud, once it is there."""
        return self._cloud(self.corrected)

    @cached_property
    def cleaned_cloud(self) -> Path | Tiles:
        """The cleaned cloud, once it is there."""
        return self._cloud(self.cleaned)

    def _cloud(self, target: Path) -> Path | Tiles:
        with warnings.catch_warnings():  # they were shown for the inputs
            warnings.simplefilter("ignore", PcfixWarning)
            return target if self._many is None else tiles_from(str(target), self.parts(target))

    def remove_others(self) -> None:
        """Remove the clouds that an earlier run made of other files."""
        kept = {*self.parts(self.corrected), *self.parts(self.cleaned)}
        for one in CLOUDS:
            records = (self.folder / one / RECORDS).glob("*.la[sz].tally")
            made = {self.folder / one / path.stem: path for path in records}
            for path in {self.folder / f"{one}.laz", *made} - kept:
                path.unlink(missing_ok=True)
                made.get(path, path).unlink(missing_ok=True)


def inputs_of_run(request: Request) -> Inputs:
    """Return the inputs of the correction, without the view list."""
    return replace(request, views=None).part(Inputs)


def cameras_of(request: Request, files: Files) -> Cameras:
    """Return the cameras in the CRS of the cloud; notes were shown when it was corrected."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PcfixWarning)
        return read_blocks(inputs_of_run(request), view_of(files.corrected_cloud).crs).cameras


def water_of(request: Request, files: Files) -> WaterSurface:
    """Return the surface as the corrected cloud states it, else as it was asked for."""
    cloud = files.corrected_cloud
    with warnings.catch_warnings():  # they were shown when the cloud was corrected
        warnings.simplefilter("ignore", PcfixWarning)
        with open_cloud(cloud) as source:
            stated = own_water(source)
        return stated or inputs_of_run(request).surface(view_of(cloud)).surface

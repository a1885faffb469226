"""Photographs to photographs without water, several at a time, resumed where it stopped."""

from __future__ import annotations

import json
import tempfile
import time
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pcfix.errors import GeometryError, InputError, PcfixWarning, SettingError
from pcfix.flow.dsm import grid_dsm
from pcfix.flow.inputs import Inputs
from pcfix.flow.runner import Progress, check_summary, json_text, write_summary
from pcfix.io.crs import is_same, parse_crs
from pcfix.io.files import file_state, read_json, write_text
from pcfix.io.photographs import photographs_in, read_photograph, size_of, write_photograph
from pcfix.io.rasters import filled_heights, open_raster
from pcfix.io.water_rasters import rasters_of_images, read_water_raster
from pcfix.kernels import cores, threads
from pcfix.lens.imaging import unproject
from pcfix.model import Cameras, FloatArray, Lens, WaterDimension, WaterSurface
from pcfix.options.declare import File, taken
from pcfix.options.photos import PhotosOptions
from pcfix.photos.ground import Ground, ground_of
from pcfix.photos.mapping import Photo, Scene, exact, nodes_of, paper
from pcfix.photos.model import PhotosSummary
from pcfix.photos.resample import resample
from pcfix.version import __version__
from pcfix.water.index import index_of
from pcfix.water.surface import surface_above

RECORD = "pcfix-photos.json"
LEAST_STEP_PX = 8
GROUND_PIXELS_A_CELL = 2.0
COARSE_STEP_PX = 100
"""Between the rays that tell whether a photograph sees anything of the ground."""
MOST_BLACK = 0.2
"""Of a photograph; more is worth a warning."""
LENS_TOLERANCE = 0.005
"""Of the shape of a frame in millimetres against that of the photograph."""


def map_photos(
    images: File,
    out: File,
    *,
    options: PhotosOptions | None = None,
    progress: Progress | None = None,
    **keywords: Any,
) -> PhotosSummary:
    """Write every photograph as it would be without water; what ``pcfix photos`` runs.

    Parameters
    ----------
    images : path
        Folder of JPEG, TIFF or PNG files; names or stems are those of the camera file.
    out : path
        Folder, made where it is missing. Files keep their names, sizes, bands and metadata, so
        that the camera file needs no change. Photographs that an equal call has written already
        are left as they are.
    options : PhotosOptions, optional
        Or its attributes as keywords: cameras, dsm and water among them; see
        `pcfix.photos.mapping`.
    progress : callable, optional
        Called with (photographs done, photographs in all).

    Returns
    -------
    PhotosSummary

    Raises
    ------
    PcfixError
        With one sentence on what to mend; photographs that were finished stay.
    """
    given = taken(PhotosOptions, options, keywords, "map_photos")
    folder, target = Path(images), Path(out)
    if target.resolve() == folder.resolve():
        raise SettingError(f"{target}: is the folder of the photographs; give another one.")
    check_summary(given)
    started, paths = time.perf_counter(), photographs_in(folder)
    with threads(given.jobs), tempfile.TemporaryDirectory() as scratch:
        block = block_of(given, paths, Path(scratch))
        old = _begin(target, given, block, overwrite=given.overwrite)
        found = _all(block, target, old, given.mapping, progress)
    pixels = sum(one.pixels for one in found)
    black = sum(one.black for one in found) / max(pixels, 1)
    notes = (*block.notes, *_notes(found, given))
    for note in notes:
        warnings.warn(note, PcfixWarning, stacklevel=2)
    summary = PhotosSummary(
        images=len(block.photos), done_before=len(old), megapixels=round(1e-6 * pixels, 1),
        seconds=round(time.perf_counter() - started, 3),
        largest_shift_px=round(max((one.shift_px for one in found), default=0.0), 2),
        black_share=round(black, 5), mapping=given.mapping, dsm=str(given.dsm),
        water=str(block.scene.water), refractive_index=block.scene.refractive_index,
        spacing_px=block.step_px, notes=notes,
    )  # fmt: skip
    write_summary(given, asdict(summary))
    return summary


@dataclass(frozen=True, eq=False)
class Block:
    """Photographs with their poses, and what they see.

    Attributes
    ----------
    paths : tuple of path
    photos : tuple of Photo
        One for each path.
    scene : Scene
    step_px : int
        Between the nodes of the grid.
    notes : tuple of str
    crs : CRS, str or None
        Of the DSM, which all is in.
    gsd_m : float
        A pixel on the lowest ground, median of the photographs.
    waters : dict
        Rasters of the water of some photographs, by their stems.
    """

    paths: tuple[Path, ...]
    photos: tuple[Photo, ...]
    scene: Scene
    step_px: int
    notes: tuple[str, ...]
    crs: Any
    gsd_m: float
    waters: dict[str, Path]

    def scene_of(self, path: Path) -> Scene:
        """Return what a photograph sees, through its own water where that is known."""
        if path.stem not in self.waters:
            return self.scene
        return replace(self.scene, water=read_water_raster(self.waters[path.stem], self.crs))


def block_of(given: PhotosOptions, paths: list[Path], scratch: Path) -> Block:
    """Return what the options and a folder of photographs say together.

    Raises
    ------
    PcfixError
        If cameras and photographs, or cameras and ground, do not belong together.
    """
    inputs = given.part(Inputs)
    read = inputs.read()
    if read.rotations is None or read.lenses is None:
        raise InputError(f"{given.cameras}: photographs are mapped with angles and a lens of each.")
    heights, origin, crs, notes = _heights(given, read, scratch)
    cameras, _ = inputs.block(crs, read)
    mine, theirs, more = _matched(paths, cameras, str(given.cameras))
    surface = inputs.surface().surface
    if isinstance(surface, WaterDimension):
        raise SettingError(
            "water dim:NAME belongs to a cloud; give a level, plane, mesh or raster."
        )
    check_above(cameras.centres[theirs], surface, str(given.cameras))
    ground = ground_of(heights, *origin)
    index = index_of(given.index, given.index_formula)[0]
    rotations: Any = cameras.rotations
    photos = tuple(
        Photo(
            cameras.labels[row],
            cameras.centres[row],
            rotations[row],
            lens_of(path, cameras, row, size_of(path)),
        )
        for path, row in zip(mine, theirs, strict=True)
    )
    gsd = _ground_pixel_m(photos, ground)
    step = given.spacing or max(LEAST_STEP_PX, int(np.ceil(ground.cell_m / gsd)))
    scene, (waters, few) = Scene(ground, surface, index), _waters(given, mine)
    _check_seen(photos, ground, given)
    notes = (*_brought(given, read, crs), *notes, *more, *few)
    return Block(tuple(mine), photos, scene, step, notes, crs, gsd, waters)


def _brought(given: PhotosOptions, read: Cameras, crs: str | None) -> tuple[str, ...]:
    """Return a note where the cameras were in another CRS than the ground."""
    theirs = given.cameras_crs or read.crs
    if theirs is None or crs is None:
        return ()
    own, other = parse_crs(theirs, str(given.cameras)), parse_crs(crs, str(given.dsm))
    if is_same(own, other):
        return ()
    return (f"{given.cameras}: its cameras were brought from {own.name} to {other.name}.",)


def _check_seen(photos: tuple[Photo, ...], ground: Ground, given: PhotosOptions) -> None:
    """Refuse a ground that no photograph sees anything of."""
    for photo in photos:
        nodes, _ = nodes_of(photo.lens, COARSE_STEP_PX)
        rays = unproject(photo.lens, nodes) @ photo.rotation
        if np.isfinite(ground.hit(photo.centre, rays[np.isfinite(rays).all(axis=1)])).any():
            return
    raise GeometryError(
        f"{given.dsm}: none of the {len(photos)} photographs sees anything of it; check its CRS"
        f" against that of {given.cameras} (--cameras-crs, --cameras-offset)."
    )


def check_above(centres: FloatArray, water: WaterSurface, name: str) -> None:
    """Refuse cameras that do not stand above the water, where that is known."""
    under = surface_above(water, centres).height_m >= centres[:, 2]
    if under.any():
        raise GeometryError(
            f"{name}: {int(under.sum())} of {len(centres)} cameras do not stand above the water,"
            f" the lowest at {centres[:, 2].min():.1f} m; check the CRS and vertical datum of both."
        )


def _waters(given: PhotosOptions, paths: list[Path]) -> tuple[dict[str, Path], tuple[str, ...]]:
    """Return the rasters of the water that belong to photographs, and a note on the others."""
    if given.water_per_image is None:
        return {}, ()
    found, notes = rasters_of_images(given.water_per_image, [path.name for path in paths])
    return {paths[row].stem: path for row, path in found.items()}, notes


def _heights(
    given: PhotosOptions, read: Cameras, scratch: Path
) -> tuple[FloatArray, tuple[float, float, float], Any, tuple[str, ...]]:
    """Return the raster of heights, its left, top and cell, its CRS, and notes."""
    path = Path(given.dsm)
    if path.suffix.lower() in (".las", ".laz"):
        raster = scratch / "dsm.tif"
        grid_dsm(path, raster, resolution=given.resolution)
        path = raster
    elif given.resolution is not None:
        raise SettingError("resolution is of a cloud that is gridded; the DSM has its own.")
    with open_raster(path) as source:
        transform, tags = source.transform, source.tags()
        crs = None if source.crs is None else source.crs.to_wkt()
        height = filled_heights(source, fill=given.holes == "fill")
    square = abs(transform.a + transform.e) < 1e-6 * transform.a
    if not (square and transform.b == transform.d == 0.0):
        raise InputError(f"{path}: its cells are turned or not square; warp it to north up first.")
    origin = (transform.c, transform.f, transform.a)
    return height, origin, crs, _provenance(tags, given)


def _provenance(tags: dict[str, str], given: PhotosOptions) -> tuple[str, ...]:
    """Refuse a ground that is known to be the wrong one; say so where it is not known."""
    corrected = json.loads(tags.get("PCFIX", "{}")).get("corrected")
    exactly = given.mapping == "exact"
    if corrected and exactly:
        return ()
    if corrected:
        raise SettingError(
            f"{given.dsm}: is of a corrected cloud, and --mapping paper needs the bed as it"
            " appears; give the DSM of the cloud as it came, or --mapping exact."
        )
    kind = "the true bed, as 'pcfix correct' gives it" if exactly else "the bed as it appears"
    return (
        f"{given.dsm} does not say that it is of a cloud that pcfix corrected; --mapping"
        f" {given.mapping} takes it for {kind}.",
    )


def _matched(
    paths: list[Path], cameras: Cameras, name: str
) -> tuple[list[Path], list[int], tuple[str, ...]]:
    """Return the photographs that have a pose, its row for each, and notes on the others."""
    by_name: dict[str, int] = {}
    for row, label in enumerate(cameras.labels):
        for key in (Path(label).name.lower(), Path(label).stem.lower()):
            by_name.setdefault(key, row)
    rows = [by_name.get(p.name.lower(), by_name.get(p.stem.lower(), -1)) for p in paths]
    mine = [path for path, row in zip(paths, rows, strict=True) if row >= 0]
    lost = [path.name for path, row in zip(paths, rows, strict=True) if row < 0]
    if not mine:
        raise InputError(
            f"{name}: knows none of the photographs ({paths[0].name} ... against"
            f" {cameras.labels[0]} ...); give the folder whose files bear the names of the cameras."
        )
    notes = []
    if lost:
        notes.append(f"{len(lost)} photographs have no pose in {name} and are left out: {lost[0]}.")
    return mine, [row for row in rows if row >= 0], tuple(notes)


def lens_of(path: Path, cameras: Cameras, row: int, size: tuple[int, int]) -> Lens:
    """Return the lens in pixels of a photograph of so many columns and rows, which it must have."""
    columns, rows = size
    lenses: Any = cameras.lenses
    lens: Lens = lenses[row]
    if lens.unit == "px":
        if (columns, rows) != (round(lens.width), round(lens.height)):
            raise InputError(
                f"{path}: has {columns} x {rows} pixels, and the camera file says"
                f" {lens.width:g} x {lens.height:g}; give the photographs that were aligned."
            )
        return lens
    scale = columns / lens.width
    if abs(rows / lens.height / scale - 1.0) > LENS_TOLERANCE:
        raise InputError(
            f"{path}: has {columns} x {rows} pixels, and the frame of the camera file is"
            f" {lens.width:g} x {lens.height:g} mm, of another shape."
        )
    lengths = ("focal", "principal_x", "principal_y", "b1", "b2", "b3")
    scaled = {one: getattr(lens, one) * scale for one in lengths}
    return replace(lens, width=columns, height=rows, unit="px", **scaled)


def _ground_pixel_m(photos: tuple[Photo, ...], ground: Ground) -> float:
    low = float(np.nanmin(ground.height_m))
    sizes = [(photo.centre[2] - low) / photo.lens.focal for photo in photos]
    if not min(sizes) > 0.0:
        raise GeometryError(
            f"the cameras do not stand above the DSM, whose lowest height is {low:.1f} m; check"
            " its CRS and vertical datum."
        )
    return float(np.median(sizes))


def _begin(target: Path, given: PhotosOptions, block: Block, *, overwrite: bool) -> set[str]:
    """Return the names that an equal call has written, once its record stands in the folder."""
    target.mkdir(parents=True, exist_ok=True)
    asked = given.as_dict()
    for name in ("overwrite", "jobs", "summary"):
        asked.pop(name)
    files = [given.cameras, given.dsm, given.sensor, given.water]
    files += block.waters.values()
    states = [file_state(Path(f)) for f in files if f is not None and Path(str(f)).exists()]
    record = {"pcfix": __version__, "asked": asked, "files": states}
    place = target / RECORD
    there = {path.name for path in block.paths if (target / path.name).exists()}
    if there and not overwrite:
        if not place.exists() or read_json(place) != json.loads(json.dumps(record)):
            raise SettingError(
                f"{target / min(there)}: exists, and was not written by an equal call; add"
                " --overwrite to replace it, or give another folder."
            )
        return there
    write_text(place, json_text(record), overwrite=True)
    return set()


@dataclass(frozen=True)
class _Done:
    """One photograph that was written."""

    name: str
    pixels: int
    black: int
    shift_px: float


def _all(
    block: Block, target: Path, old: set[str], mapping: str, progress: Progress | None
) -> list[_Done]:
    """Map the photographs that are not there yet, as many at a time as there are threads."""
    todo = [pair for pair in zip(block.paths, block.photos, strict=True) if pair[0].name not in old]
    way = exact if mapping == "exact" else paper
    done: list[_Done] = []
    workers = max(1, min(cores(), len(todo)))
    with threads(1), ThreadPoolExecutor(workers) as pool:
        jobs = [pool.submit(_one, *pair, block, way, target) for pair in todo]
        try:
            for job in jobs:
                done.append(job.result())
                if progress is not None:
                    progress(len(old) + len(done), len(block.paths))
        finally:
            for job in jobs:
                job.cancel()
    return done


def _one(path: Path, photo: Photo, block: Block, way: Callable[..., Any], target: Path) -> _Done:
    shifts = way(photo, block.scene_of(path), block.step_px)
    found = resample(read_photograph(path), shifts)
    write_photograph(path, target / path.name, found.image, found.touched)
    pixels = found.touched.size
    shift = float(np.abs(shifts.shift_px).max())
    return _Done(path.name, pixels, round(found.black_share * pixels), shift)


def _notes(found: list[_Done], given: PhotosOptions) -> list[str]:
    """Return what is worth a warning of the photographs written."""
    poor = [one for one in found if one.black > MOST_BLACK * one.pixels]
    if not poor:
        return []
    worst = max(poor, key=lambda one: one.black / one.pixels)
    return [
        f"{len(poor)} photographs are black over more than {100 * MOST_BLACK:.0f} %, as"
        f" {given.dsm} does not cover what they see; {worst.name} over"
        f" {100 * worst.black / worst.pixels:.0f} %."
    ]

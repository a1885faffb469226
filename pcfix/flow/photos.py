"""Remove refraction from photographs, several at a time."""

from __future__ import annotations

import json
import time
import warnings
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from pcfix.errors import GeometryError, PcfixWarning, SettingError, bad_file
from pcfix.flow.dsm import grid_dsm
from pcfix.flow.inputs import Inputs
from pcfix.flow.runner import Progress, check_folder, check_summary, write_summary
from pcfix.io.clouds import is_cloud
from pcfix.io.files import check_output
from pcfix.io.photographs import photographs_in, read_photograph, size_of, write_photograph
from pcfix.io.rasters import filled_heights, open_raster
from pcfix.io.tables import match_labels
from pcfix.io.water import rasters_of_images, read_water_raster
from pcfix.model import Cameras, FloatArray, Lens, WaterDimension
from pcfix.options.declare import File, taken
from pcfix.options.steps import PhotosOptions
from pcfix.photos.mapping import Ground, Photo, Scene, exact, ground_seen, nodes_of, paper, resample
from pcfix.running import current, threads
from pcfix.sums import Figures
from pcfix.water.checks import check_above_water
from pcfix.water.index import index_of


def map_photos(
    images: File,
    out: File,
    *,
    options: PhotosOptions | None = None,
    progress: Progress | None = None,
    **keywords: Any,
) -> Figures:
    """Write every photograph as seen without water; ``pcfix photos``.

    Parameters
    ----------
    images : path
        Folder of JPEG, TIFF or PNG files, named as in the camera file.
    out : path
        Folder, created if needed. Files keep their names, sizes, bands and metadata, so the camera
        file needs no change.
    options, progress
        See `pcfix.correct_file`; progress is in images. After an error finished images stay.
    """
    started = time.perf_counter()
    given = taken(PhotosOptions, options, keywords, "map_photos")
    folder, target = Path(images), Path(out)
    check_summary(given)
    paths = photographs_in(folder)
    check_folder(target, paths)
    mapped = exact if given.mapping == "exact" else paper
    with threads(given.jobs), TemporaryDirectory() as scratch:
        block = block_of(given, paths, Path(scratch))
        target.mkdir(parents=True, exist_ok=True)
        for path in block.paths:
            check_output(target / path.name, overwrite=given.overwrite, inputs=paths)

        def write(path: Path, photo: Photo) -> tuple[int, int, float]:
            """Write a photograph; return its pixels, black pixels, and largest shift."""
            with threads(1):  # each photograph has a thread
                shifts = mapped(photo, block.scene_of(path), block.step_px)
            image, touched, black = resample(read_photograph(path), shifts)
            write_photograph(path, target / path.name, image, touched)
            return touched.size, black, float(np.abs(shifts.shift_px).max())

        found = list[tuple[int, int, float]]()
        with ThreadPoolExecutor(min(current().threads, len(block.paths))) as pool:
            for one in pool.map(write, block.paths, block.photos):
                found.append(one)
                if progress is not None:
                    progress(len(found), len(block.paths))
    pixels, black, largest = zip(*found, strict=True)
    return finished(
        given,
        started,
        block.notes,
        images=len(block.photos),
        megapixels=round(1e-6 * sum(pixels), 1),
        largest_shift_px=round(max(largest), 2),
        # of the pixels: without ground, occluded, or outside the original image
        black_share=round(sum(black) / sum(pixels), 5),
        mapping=given.mapping,
        dsm=str(given.dsm),
        water=str(block.scene.water),
        refractive_index=block.scene.refractive_index,
        spacing_px=block.step_px,
    )


def finished(given: Any, started: float, notes: Iterable[PcfixWarning], **figures: Any) -> Figures:
    """Return the summary of a command, show its notes as warnings, and write it to a file."""
    seconds = round(time.perf_counter() - started, 3)
    found = Figures(**figures, seconds=seconds, notes=list(notes))
    for note in notes:
        warnings.warn(note, stacklevel=3)
    write_summary(given, found.as_dict())
    return found


def check_kind(name: File, image: npt.NDArray[Any], first: npt.NDArray[Any]) -> None:
    """Check that an image has the bands and the type of the first one."""
    if image.shape[2] != first.shape[2] or image.dtype != first.dtype:
        sentence = (
            f"has {image.shape[2]} bands of {image.dtype}, but the first image {first.shape[2]} of"
            f" {first.dtype}. Give images of one kind."
        )
        raise bad_file(name, "photos.kind", sentence, bands=image.shape[2])


@dataclass(frozen=True, eq=False)
class PhotoBlock:
    """Photographs with their poses, and what they see."""

    paths: tuple[Path, ...]
    photos: tuple[Photo, ...]
    scene: Scene
    step_px: int  # between the nodes of the grid
    notes: tuple[PcfixWarning, ...]
    crs: Any  # CRS, str or None, of the DSM and of all coordinates
    gsd_m: float  # a pixel on the lowest ground, median of the images
    waters: dict[str, Path]  # water rasters of single images, by their stems

    def scene_of(self, path: Path) -> Scene:
        """Return the scene of an image, with its own water where that is known."""
        if path.stem not in self.waters:
            return self.scene
        return replace(self.scene, water=read_water_raster(self.waters[path.stem], self.crs))


def block_of(given: PhotosOptions, paths: list[Path], scratch: Path) -> PhotoBlock:
    """Read cameras, ground and water for a folder of photographs, and check that they match."""
    name, inputs = str(given.cameras), given.part(Inputs)
    read = inputs.read()
    if read.rotations is None or read.lenses is None:
        sentence = "has no angles or no lenses. Photographs need both for each image."
        raise bad_file(name, "cameras.incomplete", sentence)
    if given.resolution is not None and not is_cloud(Path(given.dsm)):
        sentence = "--resolution applies only to a cloud, but the DSM is a raster. Omit it."
        raise SettingError("option.no_use", sentence, option="resolution")
    heights, origin, crs, corrected = read_heights(given.dsm, given.resolution, scratch)
    if corrected and given.mapping == "paper":
        sentence = (
            f"{given.dsm}: is of a corrected cloud, but --mapping paper needs the apparent bed."
            " Give the DSM of the uncorrected cloud, or --mapping exact."
        )
        raise SettingError("dsm.corrected", sentence, path=given.dsm)
    notes = list[PcfixWarning]()
    cameras, _ = inputs.block(crs, read)
    row = match_labels([path.name for path in paths], cameras.labels, one_to_one=False)[0]
    lost = [path.name for path, one in zip(paths, row, strict=True) if one < 0]
    if len(lost) == len(paths):
        sentence = (
            f"has no pose for these photographs (first {lost[0]}; first pose"
            f" {cameras.labels[0]}). Give the folder whose files have the names in the camera file."
        )
        raise bad_file(name, "photos.no_pose", sentence, photograph=lost[0])
    if lost:
        words = f"{name}: {len(lost)} photographs have no pose and are ignored, such as {lost[0]}."
        notes.append(PcfixWarning("photos.no_pose", words, count=len(lost)))
    paths = [path for path, one in zip(paths, row, strict=True) if one >= 0]
    photos = [
        photo_of(path, cameras, one, size_of(path))
        for path, one in zip(paths, row[row >= 0], strict=True)
    ]
    surface = inputs.surface().surface
    if isinstance(surface, WaterDimension):
        sentence = "--water dim:NAME is for clouds. Give a level, plane, mesh or raster."
        raise SettingError("water.dimension", sentence, water=str(given.water))
    check_above_water(cameras, surface)
    ground, waters = Ground(heights, *origin), dict[str, Path]()
    if given.water_per_image is not None:
        found = rasters_of_images(given.water_per_image, [path.name for path in paths])
        waters = {paths[at].stem: path for at, path in found.items()}
    low = float(np.nanmin(ground.height_m))
    sizes = [(photo.centre[2] - low) / photo.lens.focal for photo in photos]
    if not min(sizes) > 0.0:
        sentence = (
            f"{name}: cameras are below the DSM, whose lowest height is {low:.1f} m. Check its CRS"
            " and vertical datum."
        )
        raise GeometryError("cameras.below_ground", sentence, path=name, lowest_m=low)
    scene = Scene(ground, surface, index_of(given.index, given.index_formula)[0])
    coarse = ((photo, nodes_of(photo.lens, 100)[0]) for photo in photos)
    if not any(ground_seen(photo, scene, nodes)[2].any() for photo, nodes in coarse):
        sentence = (
            f"{given.dsm}: is in none of the {len(photos)} photographs. Check its CRS and that of"
            f" {given.cameras} (--cameras-crs, --cameras-offset)."
        )
        raise GeometryError("cameras.no_overlap", sentence, path=given.dsm)
    gsd = float(np.median(sizes))
    step = max(8, int(np.ceil(ground.cell_m / gsd)))  # a cell of the ground, or 8 px
    return PhotoBlock(tuple(paths), tuple(photos), scene, step, tuple(notes), crs, gsd, waters)


def read_heights(
    dsm: File, resolution: float | None, scratch: Path
) -> tuple[FloatArray, tuple[float, float, float], str | None, bool]:
    """Read a DSM and fill its holes, or grid a cloud in a folder for temporary files.

    Returns the heights, shape (rows, columns); left, top and size of the cells; the CRS; and
    whether pcfix made it of a corrected cloud.
    """
    path = Path(dsm)
    if is_cloud(path):
        grid_dsm(path, scratch / "dsm.tif", resolution=resolution)
        path = scratch / "dsm.tif"
    with open_raster(path) as source:
        t, tags = source.transform, source.tags()
        crs = None if source.crs is None else source.crs.to_wkt()
        heights = filled_heights(source)
    if abs(t.a + t.e) >= 1e-6 * t.a or t.b or t.d:
        sentence = "its cells are rotated or not square. Warp it to north up first."
        raise bad_file(dsm, "raster.rotated", sentence)
    corrected = bool(json.loads(tags.get("PCFIX", "{}")).get("corrected"))
    return heights, (t.c, t.f, t.a), crs, corrected


def photo_of(path: Path, cameras: Cameras, row: int, size: tuple[int, int]) -> Photo:
    """Return an image of some columns and rows, with its pose and its lens in pixels.

    The cameras have angles and lenses; size or shape of the frame must match the image.
    """
    (columns, rows), lens = size, cast(tuple[Lens, ...], cameras.lenses)[row]
    scale = columns / lens.width
    if lens.unit == "px":
        matches = size == (round(lens.width), round(lens.height))
    else:
        matches = abs(rows / lens.height / scale - 1.0) <= 0.005  # the same shape
    if not matches:
        sentence = (
            f"has {columns} x {rows} pixels, but the camera file says {lens.width:g} x"
            f" {lens.height:g} {lens.unit}. Give the photographs that were aligned."
        )
        raise bad_file(path, "photos.size", sentence, size=size)
    if lens.unit != "px":
        lengths = ("focal", "principal_x", "principal_y", "b1", "b2", "b3")
        scaled = {one: getattr(lens, one) * scale for one in lengths}
        lens = replace(lens, width=columns, height=rows, unit="px", **scaled)
    rotation = cast(FloatArray, cameras.rotations)[row]
    return Photo(cameras.labels[row], cameras.centres[row], rotation, lens)

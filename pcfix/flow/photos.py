"""Remove refraction from photographs, several at a time, and rebuild the cloud from them in rounds.

A round is photographs without water, a cloud from them, and its DSM. This is the workflow of Fig 10
of Skarlatos & Agrafiotis 2018, until a DSM differs from the one before by less than a threshold (a
ground pixel). Here the mean difference under water counts, as single cells scatter by the noise of
the matcher. Each round starts from the original images and the DSM of the round before. With the
mapping ``exact`` and the true bed, one round is enough.
"""

import json
import shlex
import shutil
import time
import warnings
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from pcfix.errors import GeometryError, InputError, PcfixWarning, SettingError, bad_file
from pcfix.flow.dsm import grid_dsm
from pcfix.flow.inputs import Inputs
from pcfix.flow.runner import (
    Progress,
    check_folder,
    check_summary,
    json_text,
    key_of,
    write_summary,
)
from pcfix.io.clouds import is_cloud
from pcfix.io.files import check_output, read_json, run_logged, write_text
from pcfix.io.las.writing import write_points
from pcfix.io.photographs import (
    photographs_in,
    read_colours,
    read_photograph,
    size_of,
    write_photograph,
)
from pcfix.io.rasters import filled_heights, open_raster, place_of, read_masked, write_dod
from pcfix.io.tables import match_labels
from pcfix.io.water import rasters_of_images, read_water_raster
from pcfix.model import Cameras, FloatArray, Lens, WaterDimension
from pcfix.options.declare import File, taken
from pcfix.options.steps import PhotosOptions, RebuildOptions
from pcfix.photos.mapping import Ground, Photo, Scene, exact, ground_seen, nodes_of, paper, resample
from pcfix.photos.ortho import Picture, blank_in
from pcfix.photos.stereo import stereo_cloud
from pcfix.running import current, threads
from pcfix.sums import Figures
from pcfix.water.checks import check_above_water
from pcfix.water.index import index_of
from pcfix.water.surface import surface_above

RECORD = "pcfix-rebuild.json"
# Options that a later call may change and still resume.
COMMAND_ONLY = ("overwrite", "jobs", "summary", "rebuild", "until_gsd", "most_rounds")


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
        sentence = f"has {image.shape[2]} bands of {image.dtype}, unlike the first image. Omit it."
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
        sentence = f"{given.dsm}: is corrected. Give one of the apparent bed, or --mapping exact."
        raise SettingError("dsm.corrected", sentence, path=given.dsm)
    notes = list[PcfixWarning]()
    cameras, _ = inputs.block(crs, read)
    row = match_labels([path.name for path in paths], cameras.labels, one_to_one=False)[0]
    lost = [path.name for path, one in zip(paths, row, strict=True) if one < 0]
    if len(lost) == len(paths):
        sentence = f"has no pose for {lost[0]} or the others. Give the folder of its photographs."
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
        sentence = f"{name}: cameras are below the ground ({low:.1f} m). Check the vertical datum."
        raise GeometryError("cameras.below_ground", sentence, path=name, lowest_m=low)
    scene = Scene(ground, surface, index_of(given.index, given.index_formula)[0])
    coarse = ((photo, nodes_of(photo.lens, 100)[0]) for photo in photos)
    if not any(ground_seen(photo, scene, nodes)[2].any() for photo, nodes in coarse):
        sentence = f"{given.dsm}: is in none of the photographs. Check its CRS and --cameras-crs."
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


# Rounds


def rebuild_rounds(
    images: File,
    out: File,
    *,
    options: PhotosOptions | None = None,
    progress: Progress | None = None,
    say: Callable[[str], None] | None = None,
    **keywords: Any,
) -> Figures:
    """Rebuild the cloud in rounds; what ``pcfix photos --rebuild`` runs.

    Parameters
    ----------
    images : path
        Folder of photographs, as for `map_photos`.
    out : path
        Folder, created if needed. Each round writes ``images``, ``cloud.laz``, ``dsm.tif`` and
        ``difference.tif`` (from the DSM before) in a folder ``round1``, ``round2`` ... Rounds that
        an equal call has finished are skipped.
    options : PhotosOptions, optional
        Or its attributes as keywords, rebuild among them.
    progress : callable, optional
        Called with (photographs or pairs done, those in all).
    say : callable, optional
        Called with a line for each round.
    """
    started = time.perf_counter()
    given = taken(PhotosOptions, options, keywords, "rebuild_rounds")
    if given.rebuild is None:
        sentence = "--rebuild is missing. Give stereo, or a command."
        raise SettingError("option.missing", sentence, option="rebuild")
    paths, target = photographs_in(Path(images)), Path(out)
    check_summary(given)
    target.mkdir(parents=True, exist_ok=True)
    folders = list(target.glob("round[0-9]*"))
    while given.overwrite and folders:
        shutil.rmtree(folders.pop())
    place, key = target / RECORD, key_of("rebuild", given, ignored=COMMAND_ONLY)
    if folders and place.exists() and read_json(place) != {"key": key}:
        sentence = f"{target}: has rounds of another call. Add --overwrite to replace them."
        raise SettingError("output.exists", sentence, path=target)
    write_text(place, json_text({"key": key}), overwrite=True)
    if is_cloud(Path(given.dsm)):  # it is gridded to the folder
        raster = target / "dsm.tif"
        if not (folders and raster.exists()):
            grid_dsm(given.dsm, raster, resolution=given.resolution, overwrite=True)
        given = replace(given, dsm=raster, resolution=None)
    with threads(given.jobs), TemporaryDirectory() as scratch:
        block = block_of(given, paths, Path(scratch))
    threshold_m = round(given.until_gsd * block.gsd_m, 5)
    rounds, done_before = list[Figures](), 0
    # each round starts from the original images
    how = replace(given, resolution=None, summary=None, **RebuildOptions().as_dict())
    while len(rounds) < given.most_rounds and not (rounds and abs(rounds[-1].mean_m) < threshold_m):
        number, before = len(rounds) + 1, Path(rounds[-1].dsm if rounds else given.dsm)
        folder = target / f"round{number}"
        cloud, dsm = folder / "cloud.laz", folder / "dsm.tif"
        if dsm.exists():
            done_before += 1
        else:
            how = replace(how, dsm=before, overwrite=True)
            map_photos(images, folder / "images", options=how, progress=progress)
            with threads(given.jobs):
                _reconstruct(given, block, number, folder / "images", cloud, progress)
            grid_dsm(cloud, dsm, resolution=block.scene.ground.cell_m)
        one = _difference(block, cloud, dsm, before)
        rounds.append(one)
        if say is not None:
            say(
                f"Round {number}: the bed moved by {one.mean_m:+.3f} m (standard deviation"
                f" {one.sd_m:.3f} m), {100 * one.within_gsd:.0f} % of it by at most one pixel"
            )
    return finished(
        given,
        started,
        [],
        rounds=rounds,
        done_before=done_before,  # rounds that an earlier call finished
        converged=abs(rounds[-1].mean_m) < threshold_m,
        gsd_m=round(block.gsd_m, 5),
        threshold_m=threshold_m,
        mapping=given.mapping,
        rebuild=str(given.rebuild),
    )


def _reconstruct(
    given: PhotosOptions, block: PhotoBlock, number: int, images: Path, cloud: Path,
    progress: Progress | None,
) -> None:  # fmt: skip
    """Make the cloud of a round, by a program of the user's or by stereo pairs."""
    if given.rebuild == "stereo":
        import cv2

        @lru_cache(maxsize=16)
        def picture(row: int) -> Picture:
            pixels = read_colours(images / block.paths[row].name)
            grey = pixels[..., 0]
            if pixels.shape[2] >= 3:
                grey = cv2.cvtColor(np.ascontiguousarray(pixels[..., :3]), cv2.COLOR_RGB2GRAY)
            if grey.dtype == np.uint16:
                grey = (grey >> 8).astype(np.uint8)
            return Picture(np.ascontiguousarray(grey), blank=blank_in(pixels))

        xyz = stereo_cloud(block.photos, block.scene.ground, 2.0 * block.gsd_m, picture, progress)
        write_points(cloud, xyz, (block.crs, 0.001))
        return
    cloud.unlink(missing_ok=True)
    words = shlex.split(given.rebuild or "")
    for name, place in ("images", images), ("cameras", given.cameras), ("cloud", cloud):
        words = [word.replace(f"{{{name}}}", str(Path(place).resolve())) for word in words]
    log = cloud.with_name("rebuild.log")
    code, last = run_logged(words, log)
    if code or not cloud.exists():
        wrong = f"ended with code {code}" if code else f"wrote no {cloud}"
        raise InputError(
            "rebuild.failed",
            f"--rebuild {wrong} in round {number}: {' / '.join(last) or 'no message'} (see {log})."
            " Correct it and run the same command again; it resumes here.",
            exit_code=code, round=number, log=log,
        )  # fmt: skip


def _difference(block: PhotoBlock, cloud: Path, dsm: Path, before: Path) -> Figures:
    """Return by how much the DSM of a round differs from that before, under water."""
    raster = dsm.with_name("difference.tif")
    write_dod(dsm, before, raster)  # an error if they do not overlap
    with open_raster(raster) as source, open_raster(dsm) as heights:
        change, z, transform = read_masked(source), read_masked(heights), source.transform
    row, column = np.nonzero(np.isfinite(change))
    moved, z = change[row, column], z[row, column]
    x, y = place_of(transform, column + 0.5, row + 0.5)
    wet = surface_above(block.scene.water, np.column_stack([x, y, z])).height_m > z
    moved = moved[wet] if wet.any() else moved
    return Figures(
        cloud=str(cloud),
        dsm=str(dsm),
        # its DSM minus the one before, over submerged cells
        cells=len(moved),
        mean_m=round(float(moved.mean()), 5),
        sd_m=round(float(moved.std()), 5),
        within_gsd=round(float((np.abs(moved) <= block.gsd_m).mean()), 5),
    )

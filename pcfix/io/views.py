"""Read view lists, which say which cameras contributed to each point of a dense cloud.

Read a list with `read_views`, or make one of tie points with `track_views`. `ViewMatch` then gives
its cameras to the rows of a cloud, chunk by chunk.

COLMAP's stereo fusion writes ``fused.ply.vis`` next to ``fused.ply``. It is little-endian: a uint64
number of points; then for each point a uint32 number of images and their uint32 numbers, from 0
(COLMAP's source, mvs/fusion.cc and mvs/model.cc). The dense PLY of OpenMVS, and so of ODM, has two
lists at each vertex: ``view_indices``, image numbers from 0, and ``view_weights`` (OpenMVS's
source, libs/MVS/PointCloud.cpp). Both name the images whose depth maps were fused at the point.

An image number counts in the order of the dense matcher, which the list does not state. COLMAP
counts the registered images of its sparse model: in some versions in the order of ``images.bin`` or
``images.txt``, in others by ascending IMAGE_ID (``Reconstruction::RegImageIds``). OpenMVS counts as
its importer does, mostly in the order of ``images.txt``. So the two orders of a sparse model next
to the list are candidates, then that of the given cameras. The geometry decides: nearly every
listed camera must have the apparent point in its frame. With numbers off by one, a quarter of the
cameras of an ordinary block do not.

A row of the cloud gets the list of the same row if its position agrees to a fraction of the point
spacing, else the list of the nearest point within a tolerance. This is as strict, because on a real
dense cloud points 5 cm apart hardly have a camera in common. A list without positions is matched by
row number. Then the numbers of points must agree, and the geometry is tested at the first points.
"""

from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from pcfix.errors import InputError, PcfixWarning, bad_file
from pcfix.io.cameras.colmap import read_images
from pcfix.io.crs import Move
from pcfix.io.files import check_input
from pcfix.io.ply import Column, Element, positions, read_columns, read_header
from pcfix.io.tables import match_labels
from pcfix.lens.imaging import straight_images
from pcfix.model import Cameras, FloatArray, IntArray, TiePoints, Views
from pcfix.options.declare import File
from pcfix.sums import LEAST, SAME, Sums

_HEAD = 8
_IMAGES, _WEIGHTS = "view_indices", "view_weights"
_REMEDY = "Give COLMAP's fused.ply.vis or OpenMVS's dense PLY, as the software wrote it."
# Of listed cameras whose frame holds the point: 1.00 on a real dense cloud, 0.75 with image numbers
# off by one, 0.4 in a random order.
LEAST_SHARE = 0.95
MARGIN = 0.02  # of the frame's sides: other lens models or adjustments move an edge by less
SAMPLE_POINTS = 20_000


@dataclass(frozen=True, eq=False)
class ViewList:
    """The cameras that contributed to each of n points; `ViewMatch` gives them to a cloud's rows.

    `share_seen` of the listed cameras have the point in their frame; None before it is tested, or
    if the cameras have no frames. A match by position may be off by `tolerance_spacings`. That of a
    track is large: on a real block the nearest one holds 77 % of a dense point's images at any
    distance up to two spacings, as a tie point represents its surroundings.
    """

    path: Path
    what: str  # the kind of file
    listed: Views  # of n points; a camera is an int32, the file's number of the image
    xyz: FloatArray | None = None  # (n, 3), frame of the file, then of the cameras
    # rows of `Cameras` (-1 without one) that the numbers may mean, until geometry decides
    orders: tuple[IntArray, ...] = ()
    share_seen: float | None = None
    tolerance_spacings: float = 0.05

    def __len__(self) -> int:
        return len(self.listed.start) - 1

    @cached_property
    def spacing_m(self) -> float:
        """The median distance to the nearest neighbour around the middle of the file, metres."""
        if self.xyz is None or len(self.xyz) < 2:
            return 0.0
        away = np.abs(self.xyz[:, :2] - self.xyz[len(self.xyz) // 2, :2]).max(axis=1)
        near = min(SAMPLE_POINTS, len(self.xyz) - 1)
        box = self.xyz[away <= np.partition(away, near)[near]]
        distance = np.asarray(cKDTree(box).query(box[:SAMPLE_POINTS], k=2)[0])
        return float(np.median(distance[:, 1]))


def read_views(path: File, cameras: Cameras, *, to_cloud: Move | None = None) -> ViewList:
    """Read the view list of a dense cloud, for cameras in the cloud's frame.

    It is COLMAP's ``fused.ply.vis``, or the ``fused.ply`` next to it, or the dense PLY of OpenMVS.
    Images are counted as in a sparse model next to the list, or as the cameras are, whichever the
    geometry confirms. `to_cloud` takes positions, shape (n, 3), from the list's frame to the
    cloud's; None if they are the same.
    """
    found = check_input(path)
    with found.open("rb") as stream:
        is_ply = stream.read(3) == b"ply"
    vis = found.with_name(f"{found.name}.vis")
    if is_ply and vis.is_file() and not read_header(found).has(_IMAGES, lists=True):
        found, is_ply = vis, False
    views = _openmvs(found) if is_ply else _colmap(found)
    return _placed(replace(views, orders=image_orders(views, cameras)), cameras, to_cloud)


def track_views(
    path: Path, tie_points: TiePoints, cameras: Cameras, *, to_cloud: Move | None = None
) -> ViewList:
    """Make a view list of the tracks of a sparse model that was read from `path`.

    The tie points count the images as `cameras` does; for the others see `read_views`. Those that
    have a position are used, each of their cameras once.
    """
    rows = np.flatnonzero(np.isfinite(tie_points.xyz).all(axis=1))
    if rows.size == 0:
        sentence = "has no tie points with positions. Give another view list."
        raise bad_file(path, "views.no_positions", sentence)
    listed = tie_points.views.take(rows)
    row = np.repeat(np.arange(len(rows)), np.diff(listed.start))
    pairs = np.unique(np.column_stack([row, listed.camera]), axis=0)  # a track may name one twice
    start = np.concatenate([[0], np.cumsum(np.bincount(pairs[:, 0], minlength=len(rows)))])
    order = np.arange(len(cameras))
    views = ViewList(
        path, "tie points", Views(start, pairs[:, 1]), tie_points.xyz[rows], (order,),
        tolerance_spacings=2.0,
    )  # fmt: skip
    return _placed(views, cameras, to_cloud)


def _placed(views: ViewList, cameras: Cameras, to_cloud: Move | None) -> ViewList:
    """Return a list with positions in the cloud's frame, whose cameras see its points."""
    if views.xyz is None:
        return views
    xyz = views.xyz if to_cloud is None else to_cloud(views.xyz)
    return fitted(replace(views, xyz=xyz), cameras, xyz)


def _colmap(path: Path) -> ViewList:
    """Read ``fused.ply.vis``, and positions from the PLY file next to it, if it fits."""
    with path.open("rb") as stream:
        count = int.from_bytes(stream.read(_HEAD), "little")
    lists = Element(str(path), "lists", "<", count, {_IMAGES: ("u4", "u4")}, _HEAD)
    column = None
    with suppress(InputError):
        column = read_columns(path, lists, _IMAGES)[_IMAGES] if count else None
    if column is None or _HEAD + 4 * (count + len(column.items)) < path.stat().st_size:
        sentence = f"is no complete COLMAP view list of {count:,} points. {_REMEDY}"
        raise bad_file(path, "views.damaged", sentence, points=count)
    bare = path.with_suffix("")
    ply = bare if bare.suffix.lower() == ".ply" else bare.with_suffix(".ply")
    vertices = read_header(ply) if ply.is_file() else None
    fits = vertices is not None and vertices.records == count
    xyz = _positions(ply, vertices) if vertices and fits else None
    return ViewList(path, "COLMAP view list", _listed(path, column), xyz)


def _openmvs(path: Path) -> ViewList:
    """Read positions, view lists and, if there are any, weights."""
    vertices = read_header(path)
    if not vertices.has(_IMAGES, lists=True):
        raise bad_file(path, "views.no_lists", f"its points have no {_IMAGES}. {_REMEDY}")
    listed = _listed(path, read_columns(path, vertices, _IMAGES)[_IMAGES])
    xyz = _positions(path, vertices)
    if vertices.has(_WEIGHTS, lists=True):
        start, weight = read_columns(path, vertices, _WEIGHTS)[_WEIGHTS]
        is_positive = ((weight >= 0.0) & (weight < np.inf)).all()
        if not (np.array_equal(start, listed.start) and is_positive):
            sentence = f"its {_WEIGHTS} are not one positive number for each image. {_REMEDY}"
            raise bad_file(path, "views.weights", sentence)
        listed = replace(listed, weight=weight.astype(np.float32))
    return ViewList(path, "OpenMVS point cloud", listed, xyz)


def _positions(path: Path, vertices: Element) -> FloatArray:
    """Return the vertices of a PLY file, shape (n, 3)."""
    if vertices.records == 0 or not vertices.has(*"xyz"):
        raise bad_file(path, "views.no_positions", f"has no points with x, y and z. {_REMEDY}")
    xyz = positions(path, vertices)
    if not np.isfinite(xyz).all():
        sentence = "a vertex has no finite position. Export the points again."
        raise bad_file(path, "views.not_finite", sentence)
    return xyz


def _listed(path: Path, column: Column) -> Views:
    """Return the image numbers of each point as int32, if they are whole and not negative."""
    image: IntArray = column.items.astype(np.int32)
    wrong = np.flatnonzero((image < 0) | (image != column.items))
    if wrong.size:
        value = column.items[wrong[0]].item()
        sentence = f"names image {value}, which is not a whole number from 0 on. {_REMEDY}"
        raise bad_file(path, "views.image_number", sentence, value=value)
    return Views(column.start, image, kind="depth-maps")


def image_orders(raw: ViewList, cameras: Cameras) -> tuple[IntArray, ...]:
    """Return the orders that the image numbers may follow, the most likely first."""
    orders, folder = list[IntArray](), raw.path.parent
    places, names = (".", "sparse", "sparse/0"), ("images.bin", "images.txt")
    models = [folder / place / name for place in places for name in names]
    for model in filter(Path.is_file, models):
        with suppress(InputError):  # a damaged model is skipped
            images = read_images(model, points=False)
            for some in (images, sorted(images, key=lambda one: one.identifier)):
                orders.append(match_labels([one.name for one in some], cameras.labels)[0])
    orders.append(np.arange(len(cameras)))
    most = int(raw.listed.camera.max(initial=-1))
    fitting = [order for order in orders if most < len(order)]
    if not fitting:
        sentence = f"names image {most} (from 0), of {max(map(len, orders))} images. Put the sparse"
        sentence += " model next to the list."
        raise bad_file(raw.path, "views.image_number", sentence, value=most)
    known = [order for order in fitting if (order >= 0).any()]
    if not known:
        sentence = "none of its images is among the cameras. Give those of this block."
        raise bad_file(raw.path, "views.other_block", sentence)
    return tuple(known)


def fitted(views: ViewList, cameras: Cameras, xyz: FloatArray) -> ViewList:
    """Choose the order of images with which the listed cameras see the points.

    The apparent points, shape (m, 3), are the first of the list, in the frame of the cameras.
    """
    rows = np.arange(0, len(xyz), max(1, len(xyz) // SAMPLE_POINTS))
    some = views.listed.take(rows)
    points = np.repeat(xyz[rows], np.diff(some.start), axis=0)
    sizes = np.array([(lens.width, lens.height) for lens in cameras.lenses or ()])
    shares = []
    for order in views.orders if len(sizes) else ():  # without frames there is no test
        camera = order[some.camera]
        known = np.flatnonzero(camera >= 0)
        if len(known):
            size = sizes[camera[known]]
            image_xy = straight_images(points[known], camera[known], cameras)
            inside = (image_xy >= -MARGIN * size) & (image_xy <= (1.0 + MARGIN) * size)
            shares.append((float(np.mean(inside.all(axis=1))), order))
    if not shares:
        return replace(views, orders=views.orders[:1])
    share, best = max(shares, key=lambda pair: pair[0])
    if share < LEAST_SHARE:
        sentence = f"only {100 * share:.0f} % of the listed cameras have their point in the frame."
        sentence += " Put the sparse model next to the list, or give its offset (--cameras-offset)."
        raise bad_file(views.path, "views.other_images", sentence, share=share)
    return replace(views, orders=(best,), share_seen=share)


@dataclass(frozen=True, eq=False)
class ViewMatch:
    """A view list, read with some cameras, and the cloud whose points it gives cameras.

    The cloud has `points` points, whose coordinates are rounded to `step_m`, the scale of a LAS
    file. A list without positions must have as many.
    """

    view_list: ViewList
    cameras: Cameras
    points: int | None = None
    step_m: float = 0.0

    def __post_init__(self) -> None:
        """Check that the list can belong to the cloud."""
        listed, points = len(self.view_list), self.points
        if self.view_list.xyz is None and points != listed:
            sentence = f"has {listed:,} points, the cloud {points}. Put its PLY next to it."
            values = {"listed": listed, "points": points}
            raise bad_file(self.view_list.path, "views.other_points", sentence, **values)

    @property
    def tolerance_m(self) -> float | None:
        """How far a match by position may be off; None where rows are matched by number."""
        views = self.view_list
        return None if views.xyz is None else self._reach(views.tolerance_spacings)

    def _reach(self, spacings: float) -> float:
        """Return a share of the spacing, metres, or more where the cloud is rounded coarsely."""
        # three coordinates that are each off by half a step
        rounding_m = 1.01 * np.sqrt(3.0) * self.step_m / 2.0
        return float(max(rounding_m, spacings * self.view_list.spacing_m))

    @cached_property
    def _tree(self) -> Any:
        xyz: Any = self.view_list.xyz
        return cKDTree(xyz, balanced_tree=False, compact_nodes=False)

    def with_image_order(self, xyz: FloatArray) -> "ViewMatch":
        """Return the match with the order of the images that the cloud's first points show.

        A list that is matched by row number is refused if its cameras do not see them.
        """
        if self.view_list.xyz is not None:  # its positions decided it
            return self
        return replace(self, view_list=fitted(self.view_list, self.cameras, xyz))

    def views_of(self, xyz: FloatArray, first_row: int) -> "tuple[Views, ViewReport]":
        """Return the cameras of a chunk's points, and the counts of the matches.

        The points, shape (n, 3), are apparent ones in the frame of the cameras, from the cloud's
        `first_row` on. One without a match has no cameras.
        """
        views = self.view_list
        source = f"{views.what} {views.path}"
        report = ViewReport(source, len(views), views.share_seen, self.tolerance_m)
        own_row = np.arange(first_row, first_row + len(xyz))
        row = own_row if views.xyz is None else self._rows(xyz, own_row, views.xyz)
        matched = np.flatnonzero(row >= 0)
        report.by_row = int(np.count_nonzero(row == own_row))
        report.by_position = len(matched) - report.by_row
        report.unmatched = len(row) - len(matched)
        some = views.listed.take(row[matched])
        camera = views.orders[0][some.camera]
        posed = camera >= 0
        start = np.zeros(len(row) + 1, np.int64)
        start[matched + 1] = np.diff(np.concatenate([[0], np.cumsum(posed)])[some.start])
        weight = None if some.weight is None else some.weight[posed]
        report.entries, report.unposed_entries = int(posed.sum()), int((~posed).sum())
        return Views(np.cumsum(start), camera[posed], weight, some.kind), report

    def _rows(self, xyz: FloatArray, own_row: IntArray, listed: FloatArray) -> IntArray:
        """Return the list's row of points at some rows of the cloud, -1 for those without one."""
        row = np.where(own_row < len(listed), own_row, -1)
        # of one point, two positions are closer than 5 % of the spacing
        row[np.linalg.norm(listed[row] - xyz, axis=1) > self._reach(0.05)] = -1
        rest = np.flatnonzero(row < 0)
        if len(rest):
            reach = float(np.nextafter(self.tolerance_m or 0.0, np.inf))
            away, nearest = self._tree.query(xyz[rest], distance_upper_bound=reach, workers=-1)
            row[rest] = np.where(np.isfinite(away), nearest, -1)
        return row


@dataclass
class ViewReport(Sums):
    """Counts of the matches so far; by row, by position and unmatched are points of the cloud."""

    source: str = field(metadata=SAME)  # kind and path of the list
    list_points: int = field(metadata=SAME)
    share_seen: float | None = field(default=None, metadata=LEAST)  # see `ViewList`
    tolerance_m: float | None = field(default=None, metadata=SAME)  # of a match by position
    by_row: int = 0
    by_position: int = 0
    unmatched: int = 0
    entries: int = 0  # cameras of all lists that were matched
    unposed_entries: int = 0  # images without a pose, which are ignored

    def notes(self) -> list[PcfixWarning]:
        """Return notes on points without a list, on ignored images and on an untested order.

        Refuse a list that gave no point of the cloud a camera.
        """
        points = self.by_row + self.by_position + self.unmatched
        if points and self.entries == 0:
            sentence = f"{self.source}: has none of the cloud's {points:,} points. Give the"
            sentence += " list of this cloud, or the offset of its coordinates (--cameras-offset)."
            raise InputError("views.no_match", sentence, points=points, listed=self.list_points)
        found = dict[str, str]()
        if self.unmatched > 0.1 * points:
            found["views.unmatched"] = f"lacks {self.unmatched:,} of the cloud's {points:,} points."
        if self.share_seen is None and self.entries:
            found["views.order_untested"] = "the order of its images is untested: no camera frames."
        if self.unposed_entries:
            sentence = f"{self.unposed_entries:,} entries of images without a pose are ignored."
            found["views.unposed"] = sentence
        return [PcfixWarning(code, f"{self.source}: {one}") for code, one in found.items()]

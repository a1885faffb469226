"""Two models of one block: the cameras that a cloud was made with, and the adjusted ones."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pcfix.adjust.carry import Pair, pair_of, renumbered
from pcfix.errors import GeometryError, InputError, PcfixWarning, SettingError
from pcfix.io.cameras import takes_sensor
from pcfix.io.labels import match_labels
from pcfix.io.views import ViewList, ViewMatch, ViewReport
from pcfix.model import NO_CAMERAS, Cameras, FloatArray, IntArray, TiePoints, Views
from pcfix.sums import Sums

if TYPE_CHECKING:
    from pyproj import CRS

    from pcfix.flow.inputs import Inputs

LOCAL = "local"


def paired(old: Cameras, new: Cameras) -> Pair:
    """Match the images of two models in the cloud's CRS by their names.

    Raises
    ------
    GeometryError
        If `new` has images that `old` does not have, one name could be several, or the images
        have not the same shape.
    SettingError
        If one has no angles or no lenses.
    """
    for cameras, which in ((old, "adjusted-from"), (new, "cameras")):
        if cameras.rotations is None or cameras.lenses is None:
            raise SettingError(
                f"{which}: has no {'angles' if cameras.rotations is None else 'lens'}, without"
                " which a point has no place in the image; give the model itself, or --sensor."
            )
    return pair_of(old, new, _rows(old.labels, new.labels))


def _rows(old: tuple[str, ...], new: tuple[str, ...]) -> IntArray:
    """Return the row in the old labels of each new one."""
    if old == new:  # then even repeated names are clear
        return np.arange(len(new))
    if len(set(new)) < len(new):
        twice = next(label for label in new if new.count(label) > 1)
        raise GeometryError(
            f"cameras: there are several images {twice}, and adjusted-from has not the same images"
            " in the same order; give every image a name of its own."
        )
    row, unclear = match_labels(new, old)
    if unclear:
        raise GeometryError(
            f"adjusted-from: image {unclear[0]} could be several there; give every image a name of"
            " its own."
        )
    if (row < 0).any():
        unknown = [label for label, at in zip(new, row, strict=True) if at < 0]
        raise GeometryError(
            f"adjusted-from: has no image {unknown[0]}, which the cameras have"
            f" ({len(unknown)} of {len(new)} are unknown there; its first is {old[0]}); give the"
            " model that these cameras were adjusted from."
        )
    return row


class Blocks(NamedTuple):
    """What a correction has of cameras.

    cameras : the ones to correct with, `NO_CAMERAS` where none are given; views : the list of the
    cloud, where there is one; listed : the cameras that it counts, which made the cloud; pair :
    where the two are not the same.
    """

    cameras: Cameras
    views: ViewList | None
    listed: Cameras
    pair: Pair | None


def read_blocks(inputs: Inputs, cloud_crs: str | CRS | None) -> Blocks:
    """Return cameras in the cloud's CRS, and the view list, confirmed by those that made the cloud.

    Raises
    ------
    PcfixError
        If a file cannot be read or does not fit, or the two models are not of one block.
    """
    if not inputs.cameras:
        return Blocks(NO_CAMERAS, None, NO_CAMERAS, None)
    if inputs.adjusted_from is None:
        cameras, views = inputs.block(cloud_crs)
        return Blocks(cameras, views, cameras, None)
    old, new = told_apart(inputs)
    cameras, _ = new.block(cloud_crs)
    try:
        listed, views = old.block(cloud_crs)
    except InputError:
        _refuse_apart(replace(old, views=None).block(cloud_crs)[0], cameras)
        raise
    _refuse_apart(listed, cameras)
    return Blocks(cameras, views, listed, paired(listed, cameras))


def _refuse_apart(old: Cameras, new: Cameras) -> None:
    """Refuse two models that are apart, before the list of the cloud is blamed."""
    place = _rows(old.labels, new.labels)
    apart = float(np.median(np.linalg.norm(new.centres - old.centres[place], axis=1)))
    if apart > np.ptp(np.vstack([old.centres[place], new.centres]), axis=0).max() / 2.0:
        raise GeometryError(
            f"adjusted-from: its cameras stand {apart:,.0f} m from where the adjusted ones do;"
            " give the offset of the one that is shifted to the origin: --cameras-offset"
            " counts for the file that does not say where it lies."
        )


def told_apart(inputs: Inputs) -> tuple[Inputs, Inputs]:
    """Return the inputs with the old cameras and those with the new ones.

    A CRS and an offset of the cameras are of those of the two files that do not say where they
    lie themselves, or of both if both do. Where neither does, the offset is of those with which
    the two agree best.

    Raises
    ------
    PcfixError
        If a file cannot be read, or the views are tracks of the adjusted model.
    """
    _refuse_adjusted_tracks(inputs)
    made_with = inputs.cameras if inputs.adjusted_from is None else inputs.adjusted_from
    old = replace(inputs, cameras=made_with, adjusted_from=None)
    new = replace(inputs, views=None, adjusted_from=None)
    tables = [_takes_sensor(one) for one in (old, new)]
    if inputs.sensor is not None and any(tables):  # a model has the lens itself
        old, new = (
            one if takes else replace(one, sensor=None)
            for one, takes in zip((old, new), tables, strict=True)
        )
    if inputs.cameras_crs is None and inputs.cameras_offset is None:
        return old, new
    read = old.read(), new.read()
    tied = tuple(
        isinstance(given.cameras, Cameras) or cameras.crs not in (None, LOCAL)
        for given, cameras in zip((old, new), read, strict=True)
    )
    if any(tied) and not all(tied):
        plain = replace(old if tied[0] else new, cameras_crs=None, cameras_offset=None)
        return (plain, new) if tied[0] else (old, plain)
    if inputs.cameras_offset is not None and not any(tied):
        moves = _who_moves(*read, np.array(inputs.cameras_offset))
        old, new = (
            one if moved else replace(one, cameras_offset=None)
            for one, moved in zip((old, new), moves, strict=True)
        )
    return old, new


def _takes_sensor(inputs: Inputs) -> bool:
    return not isinstance(inputs.cameras, Cameras) and takes_sensor(inputs.cameras)


def _refuse_adjusted_tracks(inputs: Inputs) -> None:
    """Refuse the tracks of the adjusted model as views of the cloud."""
    given = (inputs.views, inputs.cameras, inputs.adjusted_from)
    views, cameras, old = (None if isinstance(one, Cameras) else one for one in given)
    if views is None or cameras is None or Path(views) != Path(cameras):
        return
    if old is None or Path(old) != Path(cameras):
        raise SettingError(
            f"views: the tie points of {cameras} are where the adjustment put them, not where the"
            " cloud has its points; give the model of adjusted-from, or the list of the cloud."
        )


def _who_moves(old: Cameras, new: Cameras, offset_m: FloatArray) -> tuple[bool, bool]:
    """Return whether an offset is for the old centres and for the new ones, shapes (k, 3)."""
    apart = new.centres - old.centres[_rows(old.labels, new.labels)]
    ways = {(True, True): apart, (True, False): apart - offset_m, (False, True): apart + offset_m}
    return min(ways, key=lambda way: float(np.median(np.linalg.norm(ways[way], axis=1))))


def old_tie_points(
    inputs: Inputs, pair: Pair, cloud_crs: str | CRS | None
) -> tuple[TiePoints | None, bool]:
    """Return tie points that count the rows of a pair, and whether they are the old model's.

    Those of the old model, where the old cameras have them, tell best which images the cloud was
    made with; else those of the new one.
    """
    old, new = told_apart(inputs)
    ties = old.tie_points(cloud_crs)
    if ties is None:
        return new.tie_points(cloud_crs), False
    views, entry = renumbered(ties.views, pair.row)
    return replace(ties, views=views, image_xy=ties.image_xy[entry]), True


class ListedViews(Sums):
    """The view list of a cloud, given to its points chunk by chunk; empty without a list."""

    added = ("report",)

    def __init__(
        self, views: ViewList | None, cameras: Cameras, points: int, step_m: float
    ) -> None:
        self.list, self._cameras, self._points, self._step_m = views, cameras, points, step_m
        self.restart()

    def _anew(self) -> ViewMatch | None:
        if self.list is None:
            return None
        return ViewMatch(self.list, self._cameras, points=self._points, step_m=self._step_m)

    def restart(self) -> None:
        """Go back to the first row of the cloud."""
        self._match = self._anew()

    def all_anew(self) -> Callable[[FloatArray, int], Views | None]:
        """Return the views of the whole cloud from its first row on, apart from the count here."""
        match = self._anew()
        return lambda xyz, row: None if match is None else match.for_chunk(xyz, row)

    def of(self, xyz: FloatArray, row: int) -> Views | None:
        """Return the views of a chunk, shape (n, 3), that begins at a row."""
        return None if self._match is None else self._match.for_chunk(xyz, row)

    @property
    def are_all(self) -> bool:
        """Whether every point of the cloud can have a list."""
        return self.list is None or (
            len(self.list) >= self._points and bool((np.diff(self.list.raw.start) > 0).all())
        )

    @property
    def report(self) -> ViewReport | None:
        """How the list fits so far."""
        return None if self._match is None else self._match.report

    @property
    def path(self) -> str | None:
        """The file of the list."""
        return None if self.list is None else str(self.list.raw.path)

    def check(self) -> None:
        """Refuse a list that does not belong to the cloud, and warn of one that hardly does."""
        if self.report is None:
            return
        self.report.check()
        for sentence in self.report.warnings():
            warnings.warn(sentence, PcfixWarning, stacklevel=3)

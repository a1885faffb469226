"""Two models of one block: the original cameras, which made a cloud, and the adjusted ones."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pcfix.adjust.transfer import Pair, pair_of, renumbered
from pcfix.errors import GeometryError, InputError, SettingError
from pcfix.io.cameras import takes_sensor
from pcfix.io.labels import match_labels
from pcfix.io.views import ViewList
from pcfix.model import NO_CAMERAS, Cameras, IntArray, TiePoints

if TYPE_CHECKING:
    from pyproj import CRS

    from pcfix.flow.inputs import Inputs

LOCAL = "local"


def paired(original: Cameras, adjusted: Cameras) -> Pair:
    """Match the images of two models in the cloud's CRS by their names."""
    for cameras, which in ((original, "adjusted-from"), (adjusted, "cameras")):
        if cameras.rotations is None or cameras.lenses is None:
            missing = "angles" if cameras.rotations is None else "lens"
            words = (
                f"--{which}: has no {missing}, without which points have no image. Give the model"
                " itself, or --sensor."
            )
            raise SettingError(f"cameras.no_{missing}", words, option=which)
    return pair_of(original, adjusted, _rows(original.labels, adjusted.labels))


def _rows(original: tuple[str, ...], adjusted: tuple[str, ...]) -> IntArray:
    """Return the row in the original labels of each adjusted one."""
    if original == adjusted:  # then even repeated names are unambiguous
        return np.arange(len(adjusted))
    row, unclear = match_labels(adjusted, original)
    repeated = [label for label, count in Counter(adjusted).items() if count > 1]
    if ambiguous := [*repeated, *unclear]:
        words = (
            f"--adjusted-from: image name {ambiguous[0]} is ambiguous. Give every image its own"
            " name."
        )
        raise GeometryError("adjusted_from.ambiguous", words, image=ambiguous[0])
    if (row < 0).any():
        unknown = [label for label, at in zip(adjusted, row, strict=True) if at < 0]
        words = (
            f"--adjusted-from: has no image {unknown[0]} ({len(unknown)} of {len(adjusted)} images"
            f" of the cameras are missing; its first is {original[0]}). Give the model from which"
            " the cameras were adjusted."
        )
        raise GeometryError("adjusted_from.no_image", words, image=unknown[0], missing=len(unknown))
    return row


class Blocks(NamedTuple):
    """The cameras of a correction.

    cameras : to correct with, `NO_CAMERAS` without any; views : the view list of the cloud, if
    there is one; listed : the cameras that it counts, which made the cloud; pair : both, if they
    differ.
    """

    cameras: Cameras
    views: ViewList | None
    listed: Cameras
    pair: Pair | None


def read_blocks(inputs: Inputs, cloud_crs: str | CRS | None) -> Blocks:
    """Return cameras in the cloud's CRS, and the view list, checked with the original cameras."""
    if not inputs.cameras:
        return Blocks(NO_CAMERAS, None, NO_CAMERAS, None)
    if inputs.adjusted_from is None:
        cameras, views = inputs.block(cloud_crs)
        return Blocks(cameras, views, cameras, None)
    original, adjusted = told_apart(inputs)
    cameras, _ = adjusted.block(cloud_crs)
    try:
        listed, views = original.block(cloud_crs)
    except InputError:  # a view list does not fit cameras in another place
        _refuse_apart(replace(original, views=None).block(cloud_crs)[0], cameras)
        raise
    _refuse_apart(listed, cameras)
    return Blocks(cameras, views, listed, paired(listed, cameras))


def _refuse_apart(original: Cameras, adjusted: Cameras) -> None:
    """Refuse two models in different places."""
    centres = original.centres[_rows(original.labels, adjusted.labels)]
    apart = float(np.median(np.linalg.norm(adjusted.centres - centres, axis=1)))
    if apart > np.ptp(np.vstack([centres, adjusted.centres]), axis=0).max() / 2.0:
        words = (
            f"--adjusted-from: its cameras are {apart:,.0f} m from the adjusted ones. Give the"
            " offset of the shifted one: --cameras-offset counts for the file that has no CRS."
        )
        raise GeometryError("adjusted_from.apart", words, apart_m=apart)


def told_apart(inputs: Inputs) -> tuple[Inputs, Inputs]:
    """Return the inputs with the original cameras and those with the adjusted ones.

    CRS and offset of the cameras are for the file that does not have its own place, or for both if
    both have one. If neither has, the offset is for that with which the two agree best.
    """
    _refuse_adjusted_tracks(inputs)
    source = inputs.cameras if inputs.adjusted_from is None else inputs.adjusted_from
    both = [
        replace(inputs, cameras=source, adjusted_from=None),
        replace(inputs, views=None, adjusted_from=None),
    ]
    tables = [not isinstance(one.cameras, Cameras) and takes_sensor(one.cameras) for one in both]
    if inputs.sensor is not None and any(tables):  # a model has its own lens
        both = _without(both, tables, sensor=None)
    if inputs.cameras_crs is None and inputs.cameras_offset is None:
        return both[0], both[1]
    original, adjusted = read = [one.read() for one in both]
    tied = [
        isinstance(given.cameras, Cameras) or cameras.crs not in (None, LOCAL)
        for given, cameras in zip(both, read, strict=True)
    ]
    if any(tied) and not all(tied):
        both = _without(both, [not one for one in tied], cameras_crs=None, cameras_offset=None)
    elif inputs.cameras_offset is not None and not any(tied):
        apart = adjusted.centres - original.centres[_rows(original.labels, adjusted.labels)]
        offset = np.array(inputs.cameras_offset)
        moves = {(True, True): apart, (True, False): apart - offset, (False, True): apart + offset}
        best = min(moves, key=lambda way: np.median(np.linalg.norm(moves[way], axis=1)))
        both = _without(both, best, cameras_offset=None)
    return both[0], both[1]


def _without(both: list[Inputs], kept: Sequence[bool], **changes: Any) -> list[Inputs]:
    """Return the inputs, changed where they are not kept."""
    return [one if keep else replace(one, **changes) for one, keep in zip(both, kept, strict=True)]


def _refuse_adjusted_tracks(inputs: Inputs) -> None:
    """Refuse the tracks of the adjusted model as views of the cloud."""
    given = (inputs.views, inputs.cameras, inputs.adjusted_from)
    views, cameras, original = (None if isinstance(one, Cameras) else one for one in given)
    if views is None or cameras is None or Path(views) != Path(cameras):
        return
    if original is None or Path(original) != Path(cameras):
        words = (
            f"--views: the tie points of {cameras} are adjusted ones, not those of the cloud. Give"
            " the model of --adjusted-from, or the view list of the cloud."
        )
        raise SettingError("views.adjusted", words, path=cameras)


def old_tie_points(
    inputs: Inputs, pair: Pair, cloud_crs: str | CRS | None
) -> tuple[TiePoints | None, bool]:
    """Return tie points with the rows of a pair, and whether they are the original model's.

    Those of the original model show best which images made the cloud; the others are second best.
    """
    original, adjusted = told_apart(inputs)
    ties = original.tie_points(cloud_crs)
    if ties is None:
        return adjusted.tie_points(cloud_crs), False
    views, entry = renumbered(ties.views, pair.row)
    return replace(ties, views=views, image_xy=ties.image_xy[entry]), True

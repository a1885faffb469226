"""Refractive bundle adjustment from files: one call for all doors."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from pcfix.flow.adjust_files import checked_folder, write_adjustment
from pcfix.flow.adjust_job import AdjustJob, AdjustSettings, Survey
from pcfix.flow.inputs import Inputs
from pcfix.flow.surfaces import view_of
from pcfix.io.files import check_input
from pcfix.model import WaterPlane

if TYPE_CHECKING:
    from collections.abc import Callable
    from os import PathLike

    from pcfix.adjust.problem import LogRow
    from pcfix.adjust.result import Adjusted
    from pcfix.flow.surfaces import WaterModel
    from pcfix.io.cameras.formats import Angles
    from pcfix.model import Cameras, GroundControl, WaterSurface
    from pcfix.options import ViewsAre
    from pcfix.port.shapes import Port

    AnyPath = str | PathLike[str]


def adjust_cameras(
    model: AnyPath | Cameras,
    out_dir: AnyPath | None = None,
    *,
    water: WaterSurface | float | AnyPath | None,
    cloud: AnyPath | None = None,
    gcps: AnyPath | GroundControl | None = None,
    gnss: AnyPath | None = None,
    lens: AnyPath | None = None,
    gcps_crs: str | None = None,
    gnss_crs: str | None = None,
    sensor: AnyPath | None = None,
    angles: Angles | None = None,
    cameras_crs: str | None = None,
    cameras_offset_m: tuple[float, float, float] | None = None,
    views: AnyPath | None = None,
    views_are: ViewsAre = "auto",
    water_mask: AnyPath | None = None,
    water_model: WaterModel = "auto",
    water_crs: str | None = None,
    port: Port | None = None,
    overwrite: bool = False,
    progress: Callable[[LogRow], None] | None = None,
    **settings: Any,
) -> Adjusted:
    """Adjust the poses of a block with the water in the light's way; ``pcfix adjust``.

    Parameters
    ----------
    model : path or Cameras
        See `pcfix.read_cameras`; with tie points, or together with the cloud that it made.
    out_dir : path, optional
        A new folder: the adjusted model as ``colmap/`` and ``opensfm/``, where one lens will do
        as ``cameras.csv``, ``adjustment.json`` and ``report.html``. Nothing is written without.
    water : float, str, path or WaterSurface
        See `pcfix.correct_file`. None with a `port`.
    cloud : path, optional
        LAS or LAZ, apparent. Some of its points stand for tie points where there are none.
    gcps : path, optional
        See `pcfix.io.ground_control.read_ground_control`.
    gnss : path, optional
        See `pcfix.io.gnss_positions.read_gnss`. Default: what the model has beside it.
    lens : path, optional
        A calibration, see `pcfix.io.cameras.table.sensor.read_sensor`; it is held fixed unless
        `settings` say otherwise.
    gcps_crs, gnss_crs : str, optional
        Of these, instead of what they say.
    views : path, optional
        View list of the cloud.
    sensor, angles, cameras_crs, cameras_offset_m, views_are, water_mask, water_model, water_crs
        See `pcfix.correct_file`.
    port : Port, optional
        A housing port instead of the water.
    overwrite : bool
        Replace a folder that an earlier adjustment wrote.
    progress : callable, optional
        Called with the `LogRow` of each step.
    **settings
        The attributes of `AdjustSettings`.

    Returns
    -------
    Adjusted

    Raises
    ------
    PcfixError
        If an input cannot be read or does not fit, the block has no datum, or the unknowns cannot
        be told apart. Nothing is written then.
    """
    how = AdjustSettings(**settings)
    inputs = Inputs(
        model, water, sensor=sensor, angles=angles, cameras_crs=cameras_crs,
        cameras_offset_m=cameras_offset_m, views=views, water_mask=water_mask,
        water_model=water_model, water_crs=water_crs, views_are=views_are, port=port,
    )  # fmt: skip
    target = None if out_dir is None else checked_folder(Path(out_dir), overwrite, inputs.paths())
    view = None if cloud is None else view_of(check_input(cloud))
    job = AdjustJob(inputs, how, view, Survey(gcps, gnss, lens, gcps_crs, gnss_crs))
    found = job.adjusted(progress)
    if target is not None:
        write_adjustment(target, found, str(model), overwrite=overwrite)
    return found


def next_step(
    found: Adjusted, model: str, out_dir: str, cloud: str | None, offset: str | None = None
) -> str:
    """Return the command that takes the cloud over; `offset` is that of the old cameras."""
    plane = found.water
    level = (
        f"{plane.a:.3f}" if isinstance(plane, WaterPlane) and plane.b == plane.c == 0.0 else "SPEC"
    )
    return (
        f"pcfix correct {cloud or 'CLOUD'} OUTPUT --cameras {out_dir}/colmap"
        f" --adjusted-from {model} --water {level}"
        + ("" if offset is None else f" --cameras-offset {offset}")
    )

"""Options that several commands share, said once.

A group is a dataclass whose fields are options. A command that is decorated with ``@takes(Group)``
has a first argument of that class, and on the command line all its fields.
"""

from __future__ import annotations

import inspect
from dataclasses import MISSING, Field, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_type_hints

import typer

from pcfix.cli.words import AngleWords, CameraSets, Matchers, Methods, OnOff, ViewKinds, WaterModels
from pcfix.options import DEFAULT_REFRACTIVE_INDEX, LEVEL_M, ErrorBudget, LabelSettings

if TYPE_CHECKING:
    from collections.abc import Callable

Group = TypeVar("Group")
Result = TypeVar("Result")


def takes(group: type[Group]) -> Callable[[Callable[..., Result]], Callable[..., Result]]:
    """Let a command take the fields of a group as options beside its own parameters."""

    def wrap(command: Callable[..., Result]) -> Callable[..., Result]:
        first, *own = inspect.signature(command, eval_str=True).parameters.values()
        types = get_type_hints(group, include_extras=True)
        shared = [_parameter(field, types[field.name]) for field in _fields(group)]
        names = [p.name for p in shared]

        def called(**given: Any) -> Result:
            chosen = group(**{name: given.pop(name) for name in names})
            return command(**{first.name: chosen}, **given)

        called.__name__, called.__doc__ = command.__name__, command.__doc__
        ordered = sorted([*shared, *own], key=lambda p: p.default is not p.empty)
        parameters = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in ordered]
        called.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        called.__annotations__ = {p.name: p.annotation for p in parameters}
        return called

    return wrap


def _fields(group: type) -> tuple[Field[Any], ...]:
    return fields(group)


def _parameter(field: Field[Any], annotation: Any) -> inspect.Parameter:
    default = inspect.Parameter.empty if field.default is MISSING else field.default
    return inspect.Parameter(
        field.name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation
    )


@dataclass(frozen=True)
class CameraWords:
    """How a camera file is to be read."""

    sensor: Annotated[
        Path | None,
        typer.Option(
            help="Interior orientation where the cameras have none: CSV focal,sensor_x,sensor_y"
            " in mm, or a Metashape calibration.",
            show_default="sensor.csv beside the cameras",
        ),
    ] = None
    cameras_crs: Annotated[
        str | None,
        typer.Option(
            help="CRS of the cameras, as EPSG:25830; 'local' takes the numbers as they are.",
            show_default="what their file says, else the cloud's",
        ),
    ] = None
    cameras_offset: Annotated[
        str | None,
        typer.Option(metavar="X,Y,Z", help="Added to the projection centres, m."),
    ] = None
    angles: Annotated[
        AngleWords | None,
        typer.Option(
            help="Which angles a table has, where its header cannot say: aircraft means pitch -90"
            " straight down.",
        ),
    ] = None

    def keywords(self) -> dict[str, Any]:
        """Return them as `pcfix.correct_file` takes them."""
        from pcfix.flow.inputs import offset_of

        return {
            "sensor": self.sensor,
            "angles": None if self.angles is None else self.angles.value,
            "cameras_crs": self.cameras_crs,
            "cameras_offset_m": offset_of(self.cameras_offset),
        }

    def plain(self) -> dict[str, Any]:
        """Return the words that were given, as a stage of PDAL takes them."""
        given = {f.name: getattr(self, f.name) for f in fields(self)}
        given = {f.name: given[f.name] for f in fields(self) if given[f.name] != f.default}
        return {
            name: getattr(value, "value", str(value) if isinstance(value, Path) else value)
            for name, value in given.items()
        }


@dataclass(frozen=True)
class WaterFitWords:
    """How a water surface is fitted to shoreline points."""

    water_model: Annotated[
        WaterModels,
        typer.Option(
            help="What is fitted to shoreline points: auto chooses among level, plane and along"
            " (tilted along the points, level across).",
        ),
    ] = WaterModels.auto
    water_crs: Annotated[
        str | None,
        typer.Option(help="CRS of the shoreline points.", show_default="what their file says"),
    ] = None

    def water_keywords(self) -> dict[str, Any]:
        """Return them as `pcfix.correct_file` takes them."""
        return {"water_model": self.water_model.value, "water_crs": self.water_crs}


@dataclass(frozen=True)
class LabelWords(WaterFitWords):
    """Which points below the surface are land all the same."""

    water_mask: Annotated[
        Path | None,
        typer.Option(
            help="Polygons (.gpkg, .shp, .geojson, .wkt) inside which points may be submerged.",
            show_default="everywhere",
        ),
    ] = None
    connected: Annotated[
        bool,
        typer.Option(
            "--connected/--no-connected",
            help="Leave out pools that are apart from the water; what was left out is reported.",
        ),
    ] = False
    least_pool: Annotated[
        float | None,
        typer.Option(
            help="With --connected: pools of at least this area stay in, m2.",
            show_default="a tenth of the largest water",
        ),
    ] = None
    respect_classes: Annotated[
        str | None,
        typer.Option(
            metavar="N,N,...",
            help="Points of these classes are never submerged, as 2,5,6 for ground, trees and"
            " buildings.",
            show_default="none",
        ),
    ] = None

    def label_settings(self, **more: Any) -> LabelSettings:
        """Return them as settings, with some more of these."""
        from pcfix.flow.inputs import classes_of

        return LabelSettings(
            connected=self.connected,
            least_pool_m2=self.least_pool,
            respect_classes=classes_of(self.respect_classes),
            **more,
        )


@dataclass(frozen=True)
class CorrectionWords(LabelWords, CameraWords):
    """How cameras are read, rays chosen, and points left out."""

    adjusted_from: Annotated[
        Path | None,
        typer.Option(
            help="The cameras that the cloud was made with, where --cameras are the same images"
            " adjusted since: first the whole cloud, land too, is taken from those to these.",
        ),
    ] = None
    views: Annotated[
        Path | None,
        typer.Option(
            help="Which cameras made each point: COLMAP's fused.ply.vis, the dense PLY of"
            " OpenMVS, or the camera file itself for the tracks of its tie points.",
        ),
    ] = None
    tide: Annotated[
        Path | None,
        typer.Option(help="CSV time,level_m: each image gets the water level of its time."),
    ] = None
    image_times: Annotated[
        Path | None,
        typer.Option(
            help="With --tide: CSV label,time, or the folder of the images.",
            show_default="what the camera file says",
        ),
    ] = None
    index: Annotated[
        str | None,
        typer.Option(
            help="Refractive index of the water relative to air: a number, fresh or sea.",
            show_default=str(DEFAULT_REFRACTIVE_INDEX),
        ),
    ] = None
    salinity: Annotated[
        float | None, typer.Option(help="Instead of --index, PSU.", show_default="35")
    ] = None
    temperature: Annotated[
        float | None, typer.Option(help="Of the water, degrees Celsius.", show_default="15")
    ] = None
    wavelength: Annotated[
        float | None, typer.Option(help="Of the light, micrometres.", show_default="0.53")
    ] = None
    max_angle: Annotated[
        float | None, typer.Option(help="Use rays up to this incidence angle, degrees.")
    ] = None
    max_cameras: Annotated[
        int | None, typer.Option(help="Use so many rays a point, the steepest.")
    ] = None
    method: Annotated[
        Methods, typer.Option(help="How the true point follows from the apparent one.")
    ] = Methods.snell
    camera_set: Annotated[
        CameraSets,
        typer.Option(
            help="Without --views: every camera whose frame holds the point, or a model of dense"
            " matching; auto: the model with --method consistent, else all.",
        ),
    ] = CameraSets.auto
    matcher: Annotated[
        Matchers,
        typer.Option(
            help="What that model makes a point of: fused depth maps (OpenMVS, COLMAP), or the"
            " median of stereo pairs (MicMac, SURE).",
        ),
    ] = Matchers.depth_maps
    views_are: Annotated[
        ViewKinds,
        typer.Option(
            help="Whether --views lists the images whose rays were intersected, or whose depth"
            " maps were averaged.",
        ),
    ] = ViewKinds.auto
    occlusion: Annotated[
        OnOff,
        typer.Option(
            help="Leave out cameras to which the cloud itself hides the point; auto: where there"
            " are obliques.",
        ),
    ] = OnOff.auto
    depth_factor: Annotated[
        float | None,
        typer.Option(help="With --method factor.", show_default="the refractive index"),
    ] = None
    check_depths: Annotated[
        Path | None,
        typer.Option(help="With --method regression: CSV x,y,depth of measured depths, m."),
    ] = None
    least_r2: Annotated[
        float,
        typer.Option("--least-r2", help="A regression with a lower r2 is refused."),
    ] = 0.5
    sigma_image: Annotated[
        float, typer.Option(help="Standard deviation of an image coordinate, px.")
    ] = ErrorBudget().image_px
    sigma_level: Annotated[
        float | None,
        typer.Option(
            help="Of the water level, m.", show_default=f"what its fit says, else {LEVEL_M:g}"
        ),
    ] = None
    sigma_tilt: Annotated[
        float, typer.Option(help="Of the slope of the water surface, degrees.")
    ] = ErrorBudget().tilt_deg
    sigma_index: Annotated[float, typer.Option(help="Of the refractive index.")] = (
        ErrorBudget().index
    )
    sigma_waves: Annotated[float, typer.Option(help="Of the slope of the waves, degrees.")] = (
        ErrorBudget().waves_deg
    )
    sigma_centre: Annotated[float, typer.Option(help="Of a projection centre, m.")] = (
        ErrorBudget().centre_m
    )
    sigma_attitude: Annotated[float, typer.Option(help="Of the attitude of an image, degrees.")] = (
        ErrorBudget().attitude_deg
    )

    def errors(self) -> ErrorBudget:
        """Return the standard deviations."""
        return ErrorBudget(
            self.sigma_image, self.sigma_level, self.sigma_tilt, self.sigma_index,
            self.sigma_waves, self.sigma_centre, self.sigma_attitude,
        )  # fmt: skip

    def refractive_index(self) -> float | str:
        """Return what `pcfix.correct_file` takes for it."""
        from pcfix.water.index import index_words

        return index_words(self.index, self.salinity, self.temperature, self.wavelength)

    def keywords(self) -> dict[str, Any]:
        """Return them as `pcfix.correct_file` takes them."""
        label = self.label_settings()
        return {
            **self.water_keywords(),
            "tide": self.tide,
            "image_times": self.image_times,
            "water_mask": self.water_mask,
            "connected": label.connected,
            "least_pool_m2": label.least_pool_m2,
            "respect_classes": label.respect_classes,
            **super().keywords(),
            "adjusted_from": self.adjusted_from,
            "views": self.views,
            "refractive_index": self.refractive_index(),
            "max_angle_deg": self.max_angle,
            "max_cameras": self.max_cameras,
            "method": self.method.value,
            "camera_set": self.camera_set.value,
            "matcher": self.matcher.value,
            "views_are": self.views_are.value,
            "occlusion": self.occlusion.value,
            "depth_factor": self.depth_factor,
            "check_depths": self.check_depths,
            "least_r2": self.least_r2,
            "errors": self.errors(),
        }

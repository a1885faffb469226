"""Show clouds before and after a correction, a reference, cameras and water in one view."""

import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pcfix.compare.match import gap_m, heights_at, near_in_plan
from pcfix.errors import InputError, SettingError, load_open3d
from pcfix.flow.inputs import Inputs
from pcfix.flow.surfaces import find_surface, view_of
from pcfix.grid.maps import DEPTH, DIFFERENCE, HEIGHT, UNCERTAINTY
from pcfix.io.clouds import check_same_crs, read_reference
from pcfix.io.files import check_input, check_output, write_bytes
from pcfix.io.las.columns import SHIFTS
from pcfix.io.las.source import LasSource, coordinates, metric_crs
from pcfix.model import FloatArray, WaterDimension, WaterSurface
from pcfix.options.declare import File, taken
from pcfix.options.steps import CompareRules, ViewerOptions
from pcfix.refract.tally import COVERAGE_95
from pcfix.report.page import limits_of, new_figure, png_of
from pcfix.water.surface import surface_above

if TYPE_CHECKING:
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure

WATER_CELLS = 40
SHOWN = ("WaterDepth", "SigmaZ", *SHIFTS)
LINE_COLOURS = {"water": (0.65, 0.82, 0.89), "cameras": (0.04, 0.37, 0.54)}
GREY = 0.72  # of points without a value, such as land where depths are shown
BEYOND_PERCENT = 2.0  # share of the values at either end that has the last colour
# Ramp, name, dimension and factor of the values, and what to do where no cloud has any.
COLOURS = {
    "depth": (DEPTH, "Depth below the water (m)", "WaterDepth", 1.0,
              "Give --water, or a cloud from 'pcfix correct'."),
    "shift": (HEIGHT, "Lowered by the correction (m)", "ShiftZ", -1.0,
              "Give a cloud from 'pcfix correct'."),
    "error": (DIFFERENCE, "Height above the reference (m)", "", 1.0,
              "Cloud and reference do not overlap."),
    "uncertainty": (UNCERTAINTY, "Uncertainty of Z at 95 % (m)", "SigmaZ", COVERAGE_95,
                    "Give a cloud from 'pcfix correct --dimensions all'."),
    "height": (HEIGHT, "Height (m)", "", 1.0, "Its heights are not numbers."),
}  # fmt: skip


class Shown(NamedTuple):
    """Some points of a cloud, the values of its dimensions by name, and the colours of the points.

    They are in the world frame until all clouds are moved to a common origin.
    """

    name: str
    xyz: FloatArray
    known: dict[str, FloatArray]
    rgb: FloatArray = np.empty((0, 3))


Lines = dict[str, FloatArray]  # axes of "cameras" and a grid of the "water", shape (k, 2, 3) each


def view_clouds(
    clouds: Sequence[File], *, options: ViewerOptions | None = None, **keywords: Any
) -> str:
    """Show clouds in space, in open3d's viewer or as a picture; ``pcfix view``.

    A corrected cloud with all its dimensions is also shown as it was before the correction.

    Parameters
    ----------
    clouds : sequence of path
        LAS or LAZ, in one CRS.
    options : ViewerOptions, optional
        Or its attributes as keywords: colour, reference, cameras, water, image and others.

    Returns
    -------
    str
        The clouds in the picture; empty after a window.
    """
    given = taken(ViewerOptions, options, keywords, "view_clouds")
    if not clouds:
        raise SettingError("cloud.missing", "There is no cloud to show. Give one or more.")
    if given.image is not None:
        check_output(given.image, overwrite=given.overwrite, inputs=clouds)
    if given.colour == "error" and given.reference is None:
        sentence = "--colour error is the height above a reference. Give --reference too."
        raise SettingError("option.missing", sentence, option="reference")
    paths = [check_input(cloud) for cloud in clouds]
    first, shown = view_of(paths[0]), list[Shown]()
    crs_of_all: Any = first.crs
    surface = None if given.water is None else find_surface(given.water, given, first).surface
    if isinstance(surface, WaterDimension):
        surface = None  # a dimension has no surface between its points
    for path in paths:
        some, crs = _read(path, given.points)
        check_same_crs(first.name, crs_of_all, str(path), crs)
        shown += some
    if given.reference is not None:
        target = read_reference(given.reference)
        check_same_crs(first.name, crs_of_all, target.name, target.crs)
        step = 1 + len(target.xyz) // given.points
        shown.append(Shown(f"reference {Path(target.name).name}", target.xyz[::step], {}))
    values = [_values(given.colour, one, surface, shown[-1].xyz) for one in shown]
    if not any(np.isfinite(one).any() for one in values):
        sentence = f"No cloud has values for --colour {given.colour}. {COLOURS[given.colour][-1]}"
        raise SettingError("view.no_values", sentence, colour=given.colour)
    scale = _scale_of(given.colour, np.concatenate(values))
    points = np.vstack([one.xyz for one in shown])
    low, high = points.min(axis=0), points.max(axis=0)
    lines = {} if surface is None else {"water": _grid(surface, low, high)}
    if given.cameras is not None:
        inputs = replace(given, water=0.0 if given.water is None else given.water).part(Inputs)
        cameras = inputs.block(first.crs)[0]
        # the lines along optical axes are short against the height above the clouds
        length = 0.06 * max(float(np.median(cameras.centres[:, 2])) - high[2], 1.0)
        axes = np.array([0.0, 0.0, -1.0]) if cameras.rotations is None else cameras.rotations[:, 2]
        lines["cameras"] = np.stack([cameras.centres, cameras.centres + length * axes], axis=1)
    # coordinates relative to the common centre
    ends = np.vstack([low, high, *(one.reshape(-1, 3) for one in lines.values())])
    origin = (ends.min(axis=0) + ends.max(axis=0)) / 2.0
    lines = {name: one - origin for name, one in lines.items()}
    for row, one in enumerate(values):
        rgb = scale.to_rgba(np.ma.masked_invalid(one))[:, :3]
        shown[row] = shown[row]._replace(xyz=shown[row].xyz - origin, rgb=rgb)
    if given.image is None:
        _show(shown, lines, f"pcfix view: {given.colour}")
        return ""
    picture = png_of(view_figure(shown, lines, scale, COLOURS[given.colour][1]))
    write_bytes(given.image, picture, overwrite=given.overwrite)
    return f"{given.image}: {', '.join(one.name for one in shown)} by {given.colour}"


def _read(path: Path, most: int) -> tuple[list[Shown], Any]:
    """Return a cloud, its apparent points if they are known, and its CRS."""
    with LasSource(path) as source:
        crs = metric_crs(source)
        names = [n for n in SHOWN if n in source.header.point_format.extra_dimension_names]
        step, row, parts = 1 + (len(source) - 1) // most, 0, list[FloatArray]()
        for points in source.chunks():
            some = points[np.arange(-row % step, len(points), step)]
            columns = [source.dimension(some, name) for name in names]
            parts.append(np.column_stack([coordinates(some), *columns]))
            row += len(points)
    if not parts:
        raise InputError("cloud.empty", f"{path}: has no points to show.", path=path)
    rows = np.vstack(parts)
    after = Shown(path.name, rows[:, :3], dict(zip(names, rows.T[3:], strict=True)))
    if not {*SHIFTS, "WaterDepth"} <= after.known.keys():
        return [after], crs
    shift = np.column_stack([after.known[name] for name in SHIFTS])
    depth = after.known["WaterDepth"]
    apparent = np.where(depth > 0.0, depth + shift[:, 2], 0.0)
    return [Shown(f"{path.name} before", after.xyz - shift, {"WaterDepth": apparent}), after], crs


def _values(
    colour: str, cloud: Shown, surface: WaterSurface | None, reference: FloatArray
) -> FloatArray:
    """Return the values for the colours of a cloud, NaN where unknown."""
    xyz, known = cloud.xyz, cloud.known
    if colour == "height":
        return xyz[:, 2]
    found = np.full(len(xyz), np.nan)
    if colour == "error":
        near = near_in_plan(xyz, reference, gap_m(reference))
        if xyz is not reference and near.any():
            k = min(CompareRules().neighbours, len(reference))
            found[near] = xyz[near, 2] - heights_at(xyz[near], reference, k)
        return found
    _, _, name, factor, _ = COLOURS[colour]
    if name in known:
        return np.where(known[name] != 0.0, factor * known[name], np.nan)
    if colour == "depth" and surface is not None:
        found = surface_above(surface, xyz).height_m - xyz[:, 2]
    return np.where(found > 0.0, found, np.nan)


def _grid(surface: WaterSurface, low: FloatArray, high: FloatArray) -> FloatArray:
    """Return the edges of cells of the water over the clouds, shape (k, 2, 3)."""
    sides = [np.linspace(low[axis], high[axis], WATER_CELLS + 1) for axis in (0, 1)]
    xyz = np.dstack([*np.meshgrid(*sides), np.zeros((WATER_CELLS + 1, WATER_CELLS + 1))])
    xyz[..., 2] = surface_above(surface, xyz.reshape(-1, 3)).height_m.reshape(xyz.shape[:2])
    grid_lines = (xyz[:, :-1], xyz[:, 1:]), (xyz[:-1], xyz[1:])  # east, north
    edges = np.vstack([np.stack(pair, axis=2).reshape(-1, 2, 3) for pair in grid_lines])
    return np.asarray(edges[np.isfinite(edges).all(axis=(1, 2))])


def _scale_of(what: str, values: FloatArray) -> "ScalarMappable":
    """Return the colour scale of values, NaN where unknown.

    Its ``to_rgba`` gives colours; those of NaN are grey.
    """
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    if what == "error":
        _, high = limits_of(np.abs(values), what, BEYOND_PERCENT)
        low = -high
    else:
        low, high = limits_of(values, what, BEYOND_PERCENT)
    ramp = colormaps[COLOURS[what][0]].with_extremes(bad=(GREY, GREY, GREY))
    return ScalarMappable(Normalize(low, high), ramp)


def _show(shown: list[Shown], lines: Lines, title: str) -> None:
    """Open open3d's viewer with a switch for each cloud, and return when it is closed."""
    on_x = sys.platform.startswith("linux")
    if on_x and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise SettingError(
            "view.no_screen", "There is no screen to open a window on. Give --image FILE.png."
        )
    o3d = load_open3d()
    points, things = o3d.utility.Vector3dVector, []
    for one in shown:
        cloud = o3d.geometry.PointCloud(points(one.xyz))
        cloud.colors = points(one.rgb)
        things.append({"name": one.name, "geometry": cloud})
    for name, edges in lines.items():
        ends = o3d.utility.Vector2iVector(np.arange(2 * len(edges)).reshape(-1, 2))
        line_set = o3d.geometry.LineSet(points(edges.reshape(-1, 3)), ends)
        line_set.paint_uniform_color(LINE_COLOURS[name])
        things.append({"name": name, "geometry": line_set})
    o3d.visualization.draw(
        things, title=title, show_ui=True, point_size=3, line_width=1, bg_color=(1.0, 1.0, 1.0, 1.0)
    )


def view_figure(shown: list[Shown], lines: Lines, scale: "ScalarMappable", label: str) -> "Figure":
    """Draw each cloud as dots with its name, side by side, and the scale of the colours."""
    width, grid = 0.8 + 6.4 * len(shown), {"ncols": len(shown), "squeeze": False}
    figure, axes = new_figure(width, 5.2, **grid, subplot_kw={"projection": "3d"})
    for panel, one in zip(axes[0], shown, strict=True):
        step = max(1, len(one.xyz) // 30_000)
        panel.set_title(one.name)
        panel.scatter(*one.xyz[::step].T, c=one.rgb[::step], s=1, depthshade=False)
        for kind, edges in lines.items():
            gaps = np.full((len(edges), 1, 3), np.nan)  # between the edges
            line = np.hstack([edges, gaps]).reshape(-1, 3)
            panel.plot(*line.T, color=LINE_COLOURS[kind], linewidth=0.5)
        panel.view_init(29.0, -119.0)  # degrees: from the south-west, from above
        panel.set_aspect("equal")
        panel.set(xlabel="East (m)", ylabel="North (m)", zlabel="Height (m)")
    figure.colorbar(scale, ax=list(axes[0]), label=label, shrink=0.8, extend="both")
    return figure

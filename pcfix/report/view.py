"""Clouds in space, in open3d's window or as a picture with one panel for each cloud."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.errors import SettingError
from pcfix.grid import colours
from pcfix.libraries import load_open3d
from pcfix.model import FloatArray, IntArray
from pcfix.report.page import new_figure

if TYPE_CHECKING:
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure

WATER_COLOUR = (0.29, 0.64, 0.78, 0.25)
CAMERA_COLOUR = (0.04, 0.37, 0.54)
AZIMUTH_DEG, ELEVATION_DEG = -119.0, 29.0
"""The view is from the south-west, from above."""
MOST_DOTS = 30_000
GREY = 0.72
"""Of points without a value, such as land where depths are shown."""
MOST_PERCENT = 98.0
RAMPS = {
    "depth": (colours.DEPTH, "Depth below the water (m)"),
    "shift": (colours.HEIGHT, "Lowered by the correction (m)"),
    "error": (colours.DIFFERENCE, "Height above the reference (m)"),
    "uncertainty": (colours.UNCERTAINTY, "Uncertainty of Z at 95 % (m)"),
    "height": (colours.HEIGHT, "Height (m)"),
}


@dataclass(frozen=True, eq=False)
class Scene3d:
    """Named clouds with their colours, frusta of cameras, and the water, metres from an origin.

    `lines` has the shape (m, 2, 3); `triangles` are rows of `water`.
    """

    names: list[str]
    xyz: list[FloatArray]
    rgb: list[FloatArray]
    lines: FloatArray
    water: FloatArray
    triangles: IntArray


def scale_of(what: str, values: FloatArray) -> ScalarMappable:
    """Return the colour scale of values, NaN where unknown; it leaves out 2 % at the ends.

    Its ``to_rgba`` gives colours; those of NaN are grey.
    """
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    known = values[np.isfinite(values)]
    if what == "error":
        high = max(float(np.percentile(np.abs(known), MOST_PERCENT)), 1e-3)
        low = -high
    else:
        low = float(np.percentile(known, 100.0 - MOST_PERCENT)) if what == "height" else 0.0
        high = max(float(np.percentile(known, MOST_PERCENT)), low + 1e-3)
    ramp = colormaps[RAMPS[what][0]].with_extremes(bad=(GREY, GREY, GREY))
    return ScalarMappable(Normalize(low, high), ramp)


def show(scene: Scene3d, title: str) -> None:
    """Open open3d's viewer with a switch for each cloud, and return when it is closed."""
    on_x = sys.platform.startswith("linux")
    if on_x and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise SettingError(
            "view.no_screen", "There is no screen to open a window on. Give --image FILE.png."
        )
    o3d = load_open3d()
    points, record = o3d.utility.Vector3dVector, o3d.visualization.rendering.MaterialRecord
    things = []

    def add(name: str, geometry: Any, shader: str, **look: Any) -> None:
        material = record()
        for key, value in {"shader": shader, **look}.items():
            setattr(material, key, value)
        things.append({"name": name, "geometry": geometry, "material": material})

    for name, xyz, rgb in zip(scene.names, scene.xyz, scene.rgb, strict=True):
        cloud = o3d.geometry.PointCloud(points(xyz))
        cloud.colors = points(rgb)
        add(name, cloud, "defaultUnlit", point_size=2.5)
    if len(scene.lines):
        ends = np.arange(2 * len(scene.lines)).reshape(-1, 2)
        pairs = o3d.utility.Vector2iVector(ends)
        lines = o3d.geometry.LineSet(points(scene.lines.reshape(-1, 3)), pairs)
        lines.paint_uniform_color(CAMERA_COLOUR)
        add("cameras", lines, "unlitLine", line_width=1.0)
    if len(scene.triangles):
        triangles = o3d.utility.Vector3iVector(scene.triangles)
        mesh = o3d.geometry.TriangleMesh(points(scene.water), triangles)
        mesh.compute_vertex_normals()  # without them, and with other shaders, open3d 0.20 crashes
        add("water", mesh, "defaultLitTransparency", base_color=WATER_COLOUR)
    o3d.visualization.draw(things, title=title, show_ui=True, bg_color=(1.0, 1.0, 1.0, 1.0))


def view_figure(scene: Scene3d, scale: ScalarMappable, what: str) -> Figure:
    """Draw each cloud as dots with its name, side by side, and the scale of the colours."""
    count = len(scene.names)
    figure, axes = new_figure(
        0.8 + 6.4 * count, 5.2, ncols=count, squeeze=False, subplot_kw={"projection": "3d"}
    )
    for panel, name, xyz, rgb in zip(axes[0], scene.names, scene.xyz, scene.rgb, strict=True):
        step = max(1, len(xyz) // MOST_DOTS)
        panel.set_title(name)
        panel.scatter(*xyz[::step].T, c=rgb[::step], s=1, depthshade=False)
        for line in scene.lines:
            panel.plot(*line.T, color=CAMERA_COLOUR, linewidth=0.5)
        if len(scene.triangles):
            x, y, z = scene.water.T
            panel.plot_trisurf(x, y, scene.triangles, z, color=WATER_COLOUR, linewidth=0)
        panel.view_init(ELEVATION_DEG, AZIMUTH_DEG)
        panel.set_aspect("equal")
        panel.set(xlabel="East (m)", ylabel="North (m)", zlabel="Height (m)")
    label = RAMPS[what][1]
    figure.colorbar(scale, ax=list(axes[0]), label=label, shrink=0.8, extend="both")
    return figure

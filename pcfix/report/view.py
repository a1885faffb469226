"""The picture of clouds in space: one panel a cloud, drawn by open3d or, without it, by dots."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pcfix.grid import colours
from pcfix.io.viewer import CAMERA_COLOUR, FROM, WATER_COLOUR, Scene3d
from pcfix.model import FloatArray
from pcfix.report.page import MOST_POINTS, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

GREY = 0.72
"""Of points without a value: land, where depths are shown."""
RAMPS = {
    "depth": (colours.DEPTH, "Depth below the water (m)"),
    "shift": (colours.HEIGHT, "Lowered by the correction (m)"),
    "error": (colours.DIFFERENCE, "Height above the reference (m)"),
    "uncertainty": (colours.UNCERTAINTY, "Uncertainty of Z at 95 % (m)"),
    "height": (colours.HEIGHT, "Height (m)"),
}
MOST_PERCENT = 98.0


class Scale(NamedTuple):
    """The values at both ends of a ramp, and what they are."""

    what: str
    low: float
    high: float

    @classmethod
    def of(cls, what: str, values: FloatArray) -> Scale:
        """Return the scale of values, NaN where there are none; few of them lie beyond it."""
        known = values[np.isfinite(values)]
        if what == "error":
            most = max(float(np.percentile(np.abs(known), MOST_PERCENT)), 1e-3)
            return cls(what, -most, most)
        low = float(np.percentile(known, 100.0 - MOST_PERCENT)) if what == "height" else 0.0
        return cls(what, low, max(float(np.percentile(known, MOST_PERCENT)), low + 1e-3))

    def colours(self, values: FloatArray) -> FloatArray:
        """Return the colour of each value, shape (n, 3); grey where it is NaN."""
        from matplotlib import colormaps

        known = np.isfinite(values)
        share = np.where(known, (values - self.low) / (self.high - self.low), 0.0)
        rgb = colormaps[RAMPS[self.what][0]](np.clip(share, 0.0, 1.0))[:, :3]
        rgb[~known] = GREY
        return np.asarray(rgb)


def view_figure(scene: Scene3d, images: list[FloatArray], scale: Scale) -> Figure:
    """Draw each cloud with its name, side by side, and the scale of the colours.

    `images` are those of the clouds; without any, thinned clouds are drawn as dots.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    count = len(scene.names)
    more: dict[str, Any] = {} if images else {"subplot_kw": {"projection": "3d"}}
    figure, axes = new_figure(0.8 + 6.4 * count, 5.2, ncols=count, squeeze=False, **more)
    for i, panel in enumerate(axes[0]):
        panel.set_title(scene.names[i])
        if images:
            panel.imshow(images[i])
            panel.set_axis_off()
        else:
            _draw_dots(panel, scene, i)
    ramp, label = RAMPS[scale.what]
    colour = ScalarMappable(Normalize(scale.low, scale.high), ramp)
    figure.colorbar(colour, ax=list(axes[0]), label=label, shrink=0.8, extend="both")
    return figure


def _draw_dots(axes: Any, scene: Scene3d, i: int) -> None:
    step = max(1, len(scene.xyz[i]) // MOST_POINTS)
    xyz = scene.xyz[i][::step]
    axes.scatter(*xyz.T, c=scene.rgb[i][::step], s=1, depthshade=False)
    for line in scene.lines:
        axes.plot(*line.T, color=CAMERA_COLOUR, linewidth=0.5)
    if len(scene.triangles):
        x, y, z = scene.water.T
        axes.plot_trisurf(x, y, scene.triangles, z, color=WATER_COLOUR, linewidth=0)
    elevation = float(np.degrees(np.arcsin(FROM[2])))
    axes.view_init(elevation, float(np.degrees(np.arctan2(FROM[1], FROM[0]))))
    axes.set_aspect("equal")
    axes.set(xlabel="East (m)", ylabel="North (m)", zlabel="Height (m)")

"""What a notebook shows of a run: the tiles of its page, and a small map."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from pcfix.grid.colours import DEPTH
from pcfix.report.page import Picture, Tile, environment, new_map


def overview(
    colours: npt.NDArray[np.uint8], extent_m: tuple[float, float, float, float], deepest_m: float
) -> Picture:
    """Return a map of the shaded bed.

    Parameters
    ----------
    colours : array, shape (rows, columns, 4)
        Red, green, blue and alpha.
    extent_m : tuple of float
        West, east, south and north.
    deepest_m : float
        What has the last colour.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    figure, axes = new_map(extent_m)
    axes.imshow(colours, extent=extent_m)
    ramp = ScalarMappable(Normalize(0.0, deepest_m), DEPTH)
    bar = figure.colorbar(ramp, ax=axes, label="Depth (m)", shrink=0.8, extend="max")
    bar.ax.invert_yaxis()
    alt = f"Map of the bed, shaded and in the colours of its depth, 0 to {deepest_m:.1f} m."
    return Picture("overview", "Depth", alt, figure)


def run_html(title: str, tiles: Sequence[Tile], place: str, picture: Picture) -> str:
    """Return a piece of HTML without scripts; `place` says what coordinates and heights are."""
    template = environment().get_template("notebook.html.j2")
    return template.render(title=title, tiles=tiles, place=place, picture=picture)

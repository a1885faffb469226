"""The colours of maps: one ramp for each kind of figure, in pictures, pages and GIS styles alike.

All are ramps of matplotlib that keep their order for colour-blind eyes and in print: depth is
light where it is shallow, and what is high in a difference is red.
"""

from __future__ import annotations

DEPTH = "YlGnBu"
HEIGHT = "cividis"
UNCERTAINTY = "OrRd"
RAYS = "Purples"
DIFFERENCE = "RdBu_r"


def stops_of(ramp: str, steps: int = 9) -> list[tuple[float, tuple[int, ...]]]:
    """Return shares of a ramp's way, 0 to 1, and their colours (red, green, blue; 0 to 255)."""
    from matplotlib import colormaps

    shares = [step / (steps - 1) for step in range(steps)]
    colours = colormaps[ramp](shares)[:, :3]
    return [
        (share, tuple(round(255 * part) for part in colour))
        for share, colour in zip(shares, colours.tolist(), strict=True)
    ]

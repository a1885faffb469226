"""How standard errors keep what they promise: a picture, scene by scene."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import norm

BOUNDS = tuple(np.round(np.arange(0.25, 3.01, 0.25), 2).tolist())
"""In standard errors."""


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Draw the share of points within so many standard errors over what a Gaussian has there."""
    from matplotlib.figure import Figure

    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    across = min(len(scenes), 4)
    figure = Figure(figsize=(4.2 * across, 4.2 * -(-len(scenes) // across)), layout="constrained")
    expected = 2.0 * norm.cdf(BOUNDS) - 1.0
    for place, scene in enumerate(scenes):
        axes = figure.add_subplot(-(-len(scenes) // across), across, place + 1)
        axes.plot([0, 1], [0, 1], color="0.6", lw=1)
        axes.axvline(0.95, color="0.8", lw=1)
        axes.axhspan(0.90, 0.98, color="0.92")
        for row in rows:
            if row["scene"] != scene or "within" not in row:
                continue
            strong = {"lw": 2.5, "zorder": 3} if row["method"] == "auto" else {"lw": 0.8}
            name = f"{row['method']}, {row['cameras'] or 'none'}"
            axes.plot(expected, row["within"], label=name, **strong)
        axes.set(title=scene, xlim=(0, 1), ylim=(0, 1), xlabel="promised", ylabel="found")
        axes.legend(fontsize=5, ncol=2, loc="lower right")
    figure.savefig(path, dpi=110)

"""The data of the map on the page: layers, shade and contours, packed for its script."""

from __future__ import annotations

import base64
import json
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from pcfix.grid.colours import HEIGHT, NO_LIGHT, hillshade, stops_of
from pcfix.grid.maps import Maps, contours, depth_interval, smoothed
from pcfix.model import FloatArray
from pcfix.sums import nice_step

_NO_DATA = -32768
_STEPS = 32_000
"""Of the 16 bits in which the page holds the values of its map."""
_SMALLEST_STEP = {"m": 0.001, "px": 0.001}
"""By unit; finer ones would only be noise that does not pack."""
_COLOURS = 64
_TICKS = 7
SMOOTH_CELLS = 1.5
"""Single cells are noisy: the shade is of a surface smoothed by this."""


@dataclass(frozen=True)
class Layer:
    """One choice of the map: values of cells, shape (rows, columns), NaN where unknown."""

    name: str
    unit: str
    values: FloatArray
    ramp: str = HEIGHT  # of `pcfix.grid.colours`
    plus_minus: str = ""  # name of the layer with the uncertainty of this one at 95 %
    is_centred: bool = False  # whether its colours are centred on zero
    has_contours: bool = False


def map_json(maps: Maps, layers: list[Layer]) -> str:
    """Return the data as JSON without "<", so that no text in it can end the script element.

    Layers are differences of 16-bit integers, compressed by zlib, in base 64.
    """
    west, _, _, north = maps.extent_m
    rows, columns = maps.height_m.shape
    shade = np.where(np.isfinite(maps.height_m), relief(maps.height_m, maps.cell_m) * 254.0, 0.0)
    data: dict[str, Any] = {
        "rows": rows,
        "columns": columns,
        "west": west,
        "north": north,
        "cell": maps.cell_m,
        "noData": _NO_DATA,
        "shade": _packed(shade),
        "layers": [_of_layer(layer) for layer in layers],
        "interval": 0,
        "contours": [],
    }
    for layer in layers:
        if layer.has_contours:  # lines whose places count from the corner of the map
            data["interval"] = interval = depth_interval(layer.values, maps.uncertainty_m)
            data["contours"] = [
                {"level": level, "line": np.round(place + 0.5, 1).ravel().tolist()}
                for level, place in contours(layer.values, interval)
            ]
    return json.dumps(data, allow_nan=False).replace("<", "\\u003c")


def relief(height_m: FloatArray, cell_m: float) -> FloatArray:
    """Return the shade of a surface lit from the north-west, 45 degrees up, 0 to 1."""
    smooth = np.pad(smoothed(height_m, SMOOTH_CELLS), 1, constant_values=np.nan)
    light = hillshade(smooth, cell_m, 315.0, 45.0)
    return np.where(light == NO_LIGHT, np.nan, (light - 1.0) / 254.0)


def _of_layer(layer: Layer) -> dict[str, Any]:
    """Return a layer; the range of its colours is round, and leaves out a percent at each end."""
    known = layer.values[np.isfinite(layer.values)]
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
    step = max((high - low) / _STEPS, _SMALLEST_STEP.get(layer.unit, 0.01))
    shown = np.percentile(known, [1.0, 99.0]) if known.size else np.array([0.0, 1.0])
    if layer.is_centred:
        shown = np.abs(shown).max() * np.array([-1.0, 1.0])
    tick = nice_step(max(float(shown[1] - shown[0]), 1e-3) / _TICKS)
    first = np.floor(shown[0] / tick)
    ticks = max(np.ceil(shown[1] / tick) - first, 1.0)
    whole = np.rint((layer.values - low) / step)
    return {
        "name": layer.name,
        "unit": layer.unit,
        "offset": low,
        "step": step,
        "low": float(first * tick),
        "high": float((first + ticks) * tick),
        "ticks": int(ticks),
        "colours": [colour for _, colour in stops_of(layer.ramp, _COLOURS)],
        "plusMinus": layer.plus_minus,
        "values": _packed(np.where(np.isfinite(whole), whole, _NO_DATA)),
    }


def _packed(whole: FloatArray) -> str:
    flat = whole.astype("<i2").ravel()
    steps = np.diff(flat, prepend=np.zeros(1, "<i2")).astype("<i2")
    return base64.b64encode(zlib.compress(steps.tobytes(), 9)).decode()

"""Styles for QGIS (QML) with the colours of the report, of rasters and of layers of a GeoPackage.

QGIS reads the style of a raster from the ``.qml`` file of its name, and those of a GeoPackage from
its table ``layer_styles``.

The files of the plugin of QGIS, packed as QGIS installs them.
"""

from __future__ import annotations

import io
import zipfile
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np

from pcfix.grid.colours import DEPTH, HEIGHT, RAYS, UNCERTAINTY, stops_of
from pcfix.io.rasters import preview
from pcfix.model import FloatArray

RAMPS = {"depth": DEPTH, "height": HEIGHT, "uncertainty": UNCERTAINTY, "RayCount": RAYS}
"""By the contents of a raster; anything else has that of heights."""
FROM_ZERO = ("depth", "uncertainty", "RayCount")
CUT = 0.5
"""Percent of the cells at either end that share the last colour, so that outliers do not count."""

_PAGE = """<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>
<qgis version="3.22" styleCategories="{categories}">
{body}
</qgis>
"""


def limits_of(values: FloatArray, what: str) -> tuple[float, float]:
    """Return the values for the first and the last colour of a map; NaN does not count."""
    known = values[np.isfinite(values)]
    if not known.size:
        return 0.0, 1.0
    low, high = (float(value) for value in np.percentile(known, (CUT, 100.0 - CUT)))
    low = 0.0 if what in FROM_ZERO else low
    return low, max(high, low + 1e-3)


def raster_style(path: Path, what: str) -> str:
    """Return the style of a raster of one band, by what it holds."""
    low, high = limits_of(preview(path)[0], what)
    items = []
    for share, colour in stops_of(RAMPS.get(what, HEIGHT)):
        value, code = low + share * (high - low), "".join(f"{part:02x}" for part in colour)
        item = f'     <item value="{value:.6g}" color="#{code}" alpha="255" label="{value:.2f}"/>'
        items.append(item)
    listed = "\n".join(items)
    body = f""" <pipe>
  <rasterrenderer type="singlebandpseudocolor" band="1" opacity="1" alphaBand="-1"
    classificationMin="{low:.6g}" classificationMax="{high:.6g}">
   <rasterTransparency/>
   <rastershader>
    <colorrampshader colorRampType="INTERPOLATED" classificationMode="1" clip="0"
      minimumValue="{low:.6g}" maximumValue="{high:.6g}">
{listed}
    </colorrampshader>
   </rastershader>
  </rasterrenderer>
 </pipe>
 <blendMode>0</blendMode>"""
    return _PAGE.format(categories="Symbology", body=body)


class Symbol(NamedTuple):
    """How the features of a layer look: of points the `size`, of lines the width, millimetres."""

    kind: str  # marker, line or fill
    colour: tuple[int, ...]
    size: float
    shape: str = "circle"


_LAYERS = {
    "marker": (
        "SimpleMarker",
        {"color": "{c},255", "name": "{shape}", "size": "{size}", "outline_color": "40,40,40,255"},
    ),
    "line": ("SimpleLine", {"line_color": "{c},255", "line_width": "{size}"}),
    "fill": (
        "SimpleFill",
        {"color": "{c},0", "style": "no", "outline_color": "{c},255", "outline_width": "{size}"},
    ),
}


def vector_style(symbols: dict[str, Symbol], attribute: str = "", label: str = "") -> str:
    """Return the style of a layer: one symbol, or one for each value of an attribute.

    The label is an expression of QGIS.
    """
    texts = []
    for row, one in enumerate(symbols.values()):
        kind, options = _LAYERS[one.kind]
        fields = {"c": ",".join(map(str, one.colour)), "shape": one.shape, "size": one.size}
        given = "".join(
            f'<Option type="QString" name="{key}" value={quoteattr(value.format(**fields))}/>'
            for key, value in options.items()
        )
        texts.append(
            f'<symbol type="{one.kind}" name="{row}" alpha="1"><layer class="{kind}" enabled="1">'
            f'<Option type="Map">{given}</Option></layer></symbol>'
        )
    drawn = "\n".join(texts)
    head, rows = 'type="singleSymbol"', ""
    if attribute:
        head = f'type="categorizedSymbol" attr={quoteattr(attribute)}'
        rows = "<categories>" + "".join(
            f'<category value={quoteattr(name)} symbol="{row}" label={quoteattr(name)}'
            ' render="true"/>'
            for row, name in enumerate(symbols)
        )
        rows += "</categories>"
    body = f" <renderer-v2 {head}>{rows}<symbols>\n{drawn}\n</symbols></renderer-v2>"
    if label:
        body += (
            f'\n <labeling type="simple"><settings><text-style fieldName={quoteattr(label)}'
            ' isExpression="1" fontSize="8" textColor="30,30,30,255"><text-buffer bufferDraw="1"'
            ' bufferSize="0.8" bufferColor="255,255,255,255"/></text-style>'
            '<placement placement="2" placementFlags="9"/></settings></labeling>'
        )
    return _PAGE.format(categories="Symbology|Labeling", body=body)


FOLDER = "pcfix"
_WHEN = (1980, 1, 1, 0, 0, 0)  # the same input gives the same bytes


def packed(table: str, version: str) -> bytes:
    """Return the plugin as a ZIP file, with a table of its commands as JSON."""
    stream = io.BytesIO()
    own = {
        one.name: one.read_text("utf-8")
        for one in files("pcfix.qgis").iterdir()
        if one.name.endswith((".py", ".txt"))
    }
    own["metadata.txt"] = own["metadata.txt"].replace("version=0.0", f"version={version}")
    own["commands.json"] = table
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as file:
        for name in sorted(own):
            file.writestr(zipfile.ZipInfo(f"{FOLDER}/{name}", _WHEN), own[name].encode())
    return stream.getvalue()

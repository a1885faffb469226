"""The files of the plugin of QGIS, packed as QGIS installs them."""

from __future__ import annotations

import io
import zipfile
from importlib.resources import files

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

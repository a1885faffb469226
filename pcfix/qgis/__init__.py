"""The plugin of QGIS: pcfix's commands as algorithms of its toolbox.

It runs under QGIS's own Python and calls the ``pcfix`` of an environment that the user names, so
that it imports QGIS and the standard library alone; `pcfix qgis-plugin` packs it.
"""

from typing import Any


def classFactory(iface: Any) -> Any:  # noqa: N802 (QGIS calls it so)
    """Return the plugin."""
    from .provider import Plugin

    return Plugin()

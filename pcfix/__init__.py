"""Refraction correction of through-water photogrammetric point clouds.

The public interface is in ``__init__.pyi``. A name is loaded when it is first used, so that
``import pcfix`` is quick.
"""

import ast
from importlib import import_module
from pkgutil import get_data
from typing import Any

# The module of each public name.
_HOME = {
    name.name: node.module
    for node in ast.parse(get_data("pcfix", "__init__.pyi") or b"").body
    if isinstance(node, ast.ImportFrom)
    for name in node.names
}

__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    """Load a public name from its module."""
    module = _HOME.get(name)
    if module is None:
        raise AttributeError(f"module 'pcfix' has no attribute '{name}'")
    return getattr(import_module(module), name)


def __dir__() -> list[str]:
    return sorted(_HOME)

"""The version of pcfix."""

__version__ = "0.1.0"

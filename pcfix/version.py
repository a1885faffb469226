"""The version of pcfix, apart from the front door, so that every room can say it."""

__version__ = "0.1.0"
